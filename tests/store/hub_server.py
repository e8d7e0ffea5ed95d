"""A Hub for tests, in memory: answers what the unmodified huggingface_hub asks for push and pull."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from huggingface_hub import constants

LFS_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".mcap", ".png")
TOKEN = "hf_NobodyMayEverReadThisToken"  # of `user`, who may do anything


@dataclass
class Repo:
    """Commits, each path -> (content, whether it is an LFS file), and what names them."""

    private: bool = False
    commits: dict[str, dict[str, tuple[bytes, bool]]] = field(default_factory=dict)
    heads: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, files: dict[str, tuple[bytes, bool]]) -> str:
        sha = secrets.token_hex(20)
        self.commits[sha], self.heads[branch] = files, sha
        return sha

    @property
    def files(self) -> dict[str, bytes]:
        """Content of the main branch, without the Hub's own."""
        files = self.commits[self.heads["main"]]
        return {path: data for path, (data, _) in files.items() if not path.startswith(".")}


class Refused(Exception):
    """Status, message and code of an answer."""


class Hub:
    """Repositories by name (`datasets/user/name`), and objects by sha256."""

    def __init__(self) -> None:
        self.repos: dict[str, Repo] = {}
        self.objects: dict[str, bytes] = {}
        self.change: Callable[[str, bytes], bytes] = lambda line, body: body  # of what goes out
        self.lock = threading.Lock()
        self.url = ""

    def answer(self, method: str, target: str, token: str | None, body: bytes) -> tuple[int, Any, dict[str, str]]:
        """Return status, content and headers."""
        for pattern, route in ROUTES.items():
            if found := re.fullmatch(pattern, f"{method} {unquote(urlsplit(target).path)}"):
                try:
                    if token not in (None, TOKEN):
                        raise Refused(401, "Invalid credentials in Authorization header", "")
                    given = found.groupdict()
                    if name := given.pop("name", None):
                        name = name if name.startswith(("models/", "datasets/")) else f"models/{name}"
                        given["repo"] = self.repos.get(name)
                        if given["repo"] is None or (given["repo"].private and token is None):
                            raise Refused(404, "Repository not found", "RepoNotFound")
                    if method in ("POST", "DELETE") and token is None:
                        raise Refused(401, "Invalid username or password.", "")
                    with self.lock:
                        made = route(self, body=body, **given)
                    return made if isinstance(made, tuple) else (200, made, {})
                except Refused as refused:
                    status, message, code = refused.args
                    return status, {"error": message}, {"X-Error-Message": message, "X-Error-Code": code}
        return 404, {"error": f"no such route: {method} {target}"}, {}


def find(repo: Repo, revision: str | None) -> str:
    named = {**dict(zip(repo.commits, repo.commits, strict=True)), **repo.tags, **repo.heads}
    if (sha := named.get(revision or "main")) is None:
        raise Refused(404, f"Invalid rev id: {revision}", "RevisionNotFound")
    return sha


def git_id(data: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()


def create(hub: Hub, body: bytes) -> Any:
    asked = json.loads(body)
    kind, name = f"{asked.get('type') or 'model'}s", f"{asked.get('organization') or 'user'}/{asked['name']}"
    url = f"{hub.url}/{'datasets/' * (kind == 'datasets')}{name}"
    if f"{kind}/{name}" in hub.repos:
        return 409, {"error": "You already created this repo", "url": url}, {}
    repo = hub.repos[f"{kind}/{name}"] = Repo(asked.get("private") or asked.get("visibility") == "private")
    repo.commit("main", {".gitattributes": (b"*.parquet filter=lfs\n", False)})
    return {"url": url, "name": name}


def preupload(hub: Hub, body: bytes, repo: Repo, revision: str) -> Any:
    paths = [one["path"] for one in json.loads(body)["files"]]
    modes = {path: "lfs" if path.endswith(LFS_SUFFIXES) else "regular" for path in paths}
    return {"files": [{"path": path, "uploadMode": mode, "shouldIgnore": False} for path, mode in modes.items()]}


def lfs_batch(hub: Hub, body: bytes, repo: Repo) -> Any:
    objects = [{"oid": one["oid"], "size": one["size"]} for one in json.loads(body)["objects"]]
    for one in objects:
        if one["oid"] not in hub.objects:
            one["actions"] = {"upload": {"href": f"{hub.url}/lfs/{one['oid']}?X-Amz-Signature=of-an-upload"}}
    return {"transfer": "basic", "objects": objects}


def lfs_put(hub: Hub, body: bytes, oid: str) -> Any:
    assert hashlib.sha256(body).hexdigest() == oid
    hub.objects[oid] = body
    return b""


def commit(hub: Hub, body: bytes, repo: Repo, revision: str) -> Any:
    lines = [json.loads(line) for line in body.splitlines()]
    if revision not in repo.heads:
        raise Refused(404, f"Invalid rev id: {revision}", "RevisionNotFound")
    files = dict(repo.commits[repo.heads[revision]])
    for value in (line["value"] for line in lines if line["key"] != "header"):
        if "oid" in value:
            files[value["path"]] = (hub.objects[value["oid"]], True)
        elif "content" in value:
            files[value["path"]] = (base64.b64decode(value["content"]), False)
        else:
            del files[value["path"]]
    if lines[0]["value"].get("parentCommit") not in (None, repo.heads[revision]):
        raise Refused(412, "A commit has happened since. Please refresh and try again.", "")
    sha = repo.commit(revision, files)
    return {"commitUrl": f"{hub.url}/user/name/commit/{sha}", "commitOid": sha, "success": True}


def refs(hub: Hub, body: bytes, repo: Repo) -> Any:
    def listed(named: dict[str, str]) -> list[dict[str, str]]:
        return [{"name": name, "ref": name, "targetCommit": sha} for name, sha in named.items()]

    return {"branches": listed(repo.heads), "tags": listed(repo.tags), "converts": []}


def info(hub: Hub, body: bytes, repo: Repo, revision: str | None) -> Any:
    sha = find(repo, revision)
    siblings = [{"rfilename": path} for path in repo.commits[sha]]
    return {"_id": "0", "id": "user/name", "sha": sha, "private": repo.private, "siblings": siblings, "tags": []}


def tree(hub: Hub, body: bytes, repo: Repo, revision: str) -> Any:
    files = repo.commits[find(repo, revision)]
    found: list[dict[str, Any]] = [{"type": "directory", "path": "meta", "oid": "0" * 40, "size": 0}]
    for path, (data, is_lfs) in files.items():
        lfs = (
            {"lfs": {"oid": hashlib.sha256(data).hexdigest(), "size": len(data), "pointerSize": 130}} if is_lfs else {}
        )
        found.append({"type": "file", "path": path, "oid": git_id(data), "size": len(data), **lfs})
    return found


def resolve(hub: Hub, body: bytes, repo: Repo, revision: str, path: str) -> Any:
    sha = find(repo, revision)
    if path not in repo.commits[sha]:
        raise Refused(404, f"{path} does not exist on {revision}", "EntryNotFound")
    data, is_lfs = repo.commits[sha][path]
    etag = f'"{hashlib.sha256(data).hexdigest() if is_lfs else git_id(data)}"'
    linked = {"X-Linked-Etag": etag, "X-Linked-Size": str(len(data))} if is_lfs else {}
    return 200, data, {"ETag": etag, "X-Repo-Commit": sha, "Content-Type": "application/octet-stream", **linked}


_API, _REVISION = r"/api/(?P<name>(?:models|datasets)/[^/]+/[^/]+)", r"(?P<revision>[^/]+)"
_NAME = r"/(?P<name>(?:datasets/)?[^/]+/[^/]+?)"
ROUTES: dict[str, Any] = {
    r"POST /api/repos/create": create,
    r"POST /api/validate-yaml": lambda hub, body: {"errors": [], "warnings": []},
    rf"POST {_API}/preupload/{_REVISION}": preupload,
    rf"POST {_NAME}\.git/info/lfs/objects/batch": lfs_batch,
    r"PUT /lfs/(?P<oid>[0-9a-f]{64})": lfs_put,
    rf"POST {_API}/commit/{_REVISION}": commit,
    rf"GET {_API}/refs": refs,
    rf"POST {_API}/tag/{_REVISION}": lambda hub, body, repo, revision: repo.tags.update(
        {json.loads(body)["tag"]: find(repo, revision)}
    ),
    rf"DELETE {_API}/tag/{_REVISION}": lambda hub, body, repo, revision: str(repo.tags.pop(revision)),
    rf"POST {_API}/branch/{_REVISION}": lambda hub, body, repo, revision: repo.heads.setdefault(
        revision, repo.heads["main"]
    ),
    rf"GET {_API}(?:/revision/{_REVISION})?": info,
    rf"GET {_API}/tree/{_REVISION}": tree,
    rf"(?:GET|HEAD) {_NAME}/resolve/{_REVISION}/(?P<path>.+)": resolve,
}


@contextlib.contextmanager
def hub_server() -> Iterator[Hub]:
    """A Hub on a free port of loopback."""
    hub = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            token = self.headers.get("Authorization", "").removeprefix("Bearer ") or None
            status, content, headers = hub.answer(self.command, self.path, token, body)
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            data = hub.change(f"{self.command} {self.path}", data)
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(data))}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

        log_message: Any = lambda self, *words: None
        do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = handle_any  # noqa: N815

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()


def talk_to(url: str, set_attribute: Callable[[object, str, object], None] = setattr) -> None:
    """Have huggingface_hub in this process know no other Hub."""
    set_attribute(constants, "ENDPOINT", url)
    set_attribute(constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}")
    set_attribute(constants, "HF_HUB_DISABLE_XET", True)
    set_attribute(constants, "HF_HUB_OFFLINE", False)
    set_attribute(constants, "HF_TOKEN_PATH", "/no/token")


def clean_environment(hub: Hub, home: Path, token: str | None = None) -> dict[str, str]:
    """What a process needs in its environment to know no other Hub."""
    given = {"HF_TOKEN": token} if token else {}
    quiet = {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0"}
    return {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), **quiet, **given}
