"""Servers on loopback: a Hub in memory, moto's S3, and Debian's sshd with nothing of the
machine's own.
"""

import base64
import getpass
import hashlib
import json
import logging
import os
import secrets
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import boto3
from flask import Flask, Response, abort, request
from huggingface_hub import constants
from moto.server import ThreadedMotoServer
from werkzeug.serving import make_server

TOKEN = "hf_NobodyMayEverReadThisToken"  # of `user`, who may do anything
LFS_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".mcap", ".png")
KEY, SECRET = "AKIATESTTESTTESTTEST", "a/secret/that+nobody/must/see"
Files = dict[str, bytes]


@dataclass
class Repo:
    """Commits, and what names them."""

    private: bool = False
    commits: dict[str, Files] = field(default_factory=dict)
    heads: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, files: Files) -> str:
        sha = secrets.token_hex(20)
        self.commits[sha], self.heads[branch] = files, sha
        return sha

    def find(self, revision: str) -> tuple[str, Files]:
        sha = {**dict.fromkeys(self.commits), **self.tags, **self.heads}.get(revision) or revision
        if sha not in self.commits:
            refuse(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return sha, self.commits[sha]


@dataclass
class Hub:
    """Repositories by name (`datasets/user/name`), and objects by sha256.

    change: of a body that goes out. headers: further ones of an answer. tokens: with which it was
    asked.
    """

    repos: dict[str, Repo] = field(default_factory=dict)
    objects: Files = field(default_factory=dict)
    change: Callable[[str, bytes], bytes] = lambda line, body: body
    headers: Callable[[str], dict[str, str]] = lambda line: {}
    tokens: list[str | None] = field(default_factory=list)
    url: str = ""


def refuse(status: int, message: str, code: str = "") -> None:
    headers = {"X-Error-Message": message, "X-Error-Code": code}
    abort(Response(json.dumps({"error": message}), status, headers))


def oid(path: str, data: bytes) -> str:
    """The hash by which the Hub names a file: of LFS, or of git."""
    git = hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False)
    return hashlib.sha256(data).hexdigest() if path.endswith(LFS_SUFFIXES) else git.hexdigest()


def hub_app(hub: Hub) -> Flask:
    """What the unmodified huggingface_hub asks for push and pull."""
    app, api = Flask("hub"), "/api/<any(models,datasets):kind>/<user>/<name>"

    @app.url_value_preprocessor
    def find_repo(endpoint: str | None, given: dict[str, Any] | None) -> None:
        token = request.headers.get("Authorization", "").removeprefix("Bearer ") or None
        hub.tokens.append(token)
        if token not in (None, TOKEN):
            refuse(401, f"Invalid credentials in Authorization header: {token}")
        if given and "user" in given:
            name = f"{given.pop('kind', 'models')}/{given.pop('user')}/{given.pop('name')}"
            given["repo"] = hub.repos.get(name)
            if given["repo"] is None or (given["repo"].private and token is None):
                refuse(404, "Repository not found", "RepoNotFound")

    @app.after_request
    def change(response: Response) -> Response:
        line = f"{request.method} {request.full_path}"
        if body := response.get_data():
            response.set_data(hub.change(line, body))
        response.headers.update(hub.headers(line))
        return response

    @app.post("/api/repos/create")
    def create() -> Any:
        asked = request.get_json()
        kind, name = (
            f"{asked.get('type') or 'model'}s",
            f"{asked.get('organization') or 'user'}/{asked['name']}",
        )
        about = {"url": f"{hub.url}/{'datasets/' * (kind == 'datasets')}{name}", "name": name}
        if f"{kind}/{name}" in hub.repos:
            return about | {"error": "You already created this repo"}, 409
        repo = hub.repos[f"{kind}/{name}"] = Repo(
            asked.get("private") or asked.get("visibility") == "private"
        )
        repo.commit("main", {".gitattributes": b"*.parquet filter=lfs\n"})
        return about

    @app.post("/api/validate-yaml")
    def validate() -> Any:
        return {"errors": [], "warnings": []}

    @app.post(f"{api}/preupload/<revision>")
    def preupload(repo: Repo, revision: str) -> Any:
        modes = {
            one["path"]: one["path"].endswith(LFS_SUFFIXES) for one in request.get_json()["files"]
        }
        return {"files": [{"path": path, "uploadMode": "lfs" if lfs else "regular", "shouldIgnore": False}
                          for path, lfs in modes.items()]}  # fmt: skip

    @app.post("/<user>/<name>.git/info/lfs/objects/batch")
    @app.post("/<any(datasets):kind>/<user>/<name>.git/info/lfs/objects/batch")
    def lfs_batch(repo: Repo) -> Any:
        objects = [
            {"oid": one["oid"], "size": one["size"]}
            for one in request.get_json(force=True)["objects"]
        ]
        for one in objects:
            if one["oid"] not in hub.objects:
                one["actions"] = {
                    "upload": {"href": f"{hub.url}/lfs/{one['oid']}?X-Amz-Signature=of-an-upload"}
                }
        return {"transfer": "basic", "objects": objects}

    @app.put("/lfs/<sha256>")
    def lfs_put(sha256: str) -> str:
        assert hashlib.sha256(request.get_data()).hexdigest() == sha256
        hub.objects[sha256] = request.get_data()
        return ""

    @app.post(f"{api}/commit/<revision>")
    def commit(repo: Repo, revision: str) -> Any:
        header, *lines = [json.loads(line)["value"] for line in request.get_data().splitlines()]
        files = dict(repo.find(revision)[1])
        for value in lines:
            if "oid" in value:
                files[value["path"]] = hub.objects[value["oid"]]
            elif "content" in value:
                files[value["path"]] = base64.b64decode(value["content"])
            else:
                del files[value["path"]]
        if header.get("parentCommit") not in (None, repo.heads[revision]):
            refuse(412, "A commit has happened since. Please refresh and try again.")
        sha = repo.commit(revision, files)
        return {"commitUrl": f"{hub.url}/user/name/commit/{sha}", "commitOid": sha, "success": True}

    @app.get(f"{api}/refs")
    def refs(repo: Repo) -> Any:
        named = {"branches": repo.heads, "tags": repo.tags, "converts": {}}
        return {kind: [{"name": name, "ref": name, "targetCommit": sha} for name, sha in ones.items()]
                for kind, ones in named.items()}  # fmt: skip

    @app.route(f"{api}/<any(tag,branch):what>/<revision>", methods=["POST", "DELETE"])
    def name_commit(repo: Repo, what: str, revision: str) -> Any:
        if request.method == "DELETE":
            del repo.tags[revision]
        elif what == "tag":
            repo.tags[request.get_json()["tag"]] = repo.find(revision)[0]
        else:
            repo.heads.setdefault(revision, repo.heads["main"])
        return {}

    @app.get(api)
    @app.get(f"{api}/revision/<revision>")
    def info(repo: Repo, revision: str = "main") -> Any:
        sha, files = repo.find(revision)
        siblings = [{"rfilename": path} for path in files]
        return {
            "_id": "0",
            "id": "user/name",
            "sha": sha,
            "private": repo.private,
            "siblings": siblings,
            "tags": [],
        }

    @app.get(f"{api}/tree/<revision>")
    def tree(repo: Repo, revision: str) -> Any:
        found: list[dict[str, Any]] = [
            {"type": "directory", "path": "meta", "oid": "0" * 40, "size": 0}
        ]
        for path, data in repo.find(revision)[1].items():
            one = {"oid": oid(path, data), "size": len(data)}
            lfs = {"lfs": {**one, "pointerSize": 130}} if path.endswith(LFS_SUFFIXES) else {}
            found.append({"type": "file", "path": path, **one, **lfs})
        return found

    @app.get("/<user>/<name>/resolve/<revision>/<path:path>")
    @app.get("/<any(datasets):kind>/<user>/<name>/resolve/<revision>/<path:path>")
    def resolve(repo: Repo, revision: str, path: str) -> Any:
        sha, files = repo.find(revision)
        if path not in files:
            refuse(404, f"{path} does not exist on {revision}", "EntryNotFound")
        etag = f'"{oid(path, files[path])}"'
        linked = (
            {"X-Linked-Etag": etag, "X-Linked-Size": str(len(files[path]))}
            if path.endswith(LFS_SUFFIXES)
            else {}
        )
        return files[path], {
            "ETag": etag,
            "X-Repo-Commit": sha,
            "Content-Type": "application/octet-stream",
            **linked,
        }

    return app


@contextmanager
def hub_server() -> Iterator[Hub]:
    """A Hub on a free port."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    hub = Hub()
    server = make_server("127.0.0.1", 0, hub_app(hub), threaded=True)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield hub
    finally:
        server.shutdown()


def talk_to(url: str, set_attribute: Callable[[object, str, object], None] = setattr) -> None:
    """Have huggingface_hub in this process know no other Hub."""
    given = {
        "ENDPOINT": url,
        "HUGGINGFACE_CO_URL_TEMPLATE": url + "/{repo_id}/resolve/{revision}/{filename}",
    }
    more = {"HF_HUB_DISABLE_XET": True, "HF_HUB_OFFLINE": False, "HF_TOKEN_PATH": "/no/token"}
    # on a machine that does much else
    more |= dict.fromkeys(("HF_HUB_DOWNLOAD_TIMEOUT", "HF_HUB_ETAG_TIMEOUT"), 600)
    for name, value in (given | more).items():
        set_attribute(constants, name, value)


@contextmanager
def s3_server(bucket: str) -> Iterator[dict[str, str]]:
    """Moto with an empty bucket; the variables that every S3 program reads."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        endpoint = "http://{}:{}".format(*server.get_host_and_port())
        given = {
            "endpoint_url": endpoint,
            "aws_access_key_id": KEY,
            "aws_secret_access_key": SECRET,
        }
        boto3.client("s3", **given, region_name="us-east-1").create_bucket(Bucket=bucket)
        none = {"AWS_CONFIG_FILE": "/dev/null", "AWS_SHARED_CREDENTIALS_FILE": "/dev/null"}
        more = {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        yield {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET, **none, **more}
    finally:
        server.stop()


SSHD = "/usr/sbin/sshd"
SSHD_CONFIG = """\
ListenAddress 127.0.0.1
Port {port}
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/user_key.pub
PidFile none
StrictModes no
UsePAM no
Subsystem sftp internal-sftp
"""


@dataclass(frozen=True)
class Sshd:
    """A running server. home: what HOME must be for its key and its name to be known."""

    port: int
    home: Path

    def url(self, folder: Path) -> str:
        return f"sftp://{getpass.getuser()}@127.0.0.1:{self.port}{folder}"


@contextmanager
def sshd_server(folder: Path) -> Iterator[Sshd]:
    """Debian's, for one key."""
    if not Path(SSHD).is_file():
        raise RuntimeError(f"{SSHD} is missing: as root: .ci/system sshd")
    for name in ("host_key", "user_key"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True
        )
    # below those that the kernel gives to whoever asks for any
    port = 20_000 + os.getpid() % 10_000
    (folder / "sshd_config").write_text(SSHD_CONFIG.format(port=port, folder=folder))
    ssh = folder / "home" / ".ssh"
    ssh.mkdir(parents=True)
    kind, key, *_ = (folder / "host_key.pub").read_text().split()
    (ssh / "known_hosts").write_text(f"[127.0.0.1]:{port} {kind} {key}\n")
    (ssh / "config").write_text(f"Host 127.0.0.1\n  IdentityFile {folder}/user_key\n")
    with suppress(PermissionError):  # where it drops its rights to, if it is started as root
        Path("/run/sshd").mkdir(exist_ok=True)
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen([SSHD, "-D", "-e", "-f", str(folder / "sshd_config")], stderr=log)
    try:
        last = time.monotonic() + 600
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert server.poll() is None, (folder / "log").read_text(errors="replace")
            assert time.monotonic() < last
            time.sleep(0.05)
        yield Sshd(port, folder / "home")
    finally:
        server.terminate()
        server.wait(120)
