"""A Hub for tests: answers what the unmodified huggingface_hub client asks for push and pull."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from .hub_repo import LFS_SUFFIXES, Repo, WrongParentError
from .wire import Answer, Wire

_API = r"/api/(?P<name>(?:models|datasets)/[^/]+/[^/]+)"
LFS_SECRET = "signature-of-an-upload"  # stands in signed URLs: nothing may print it


@dataclass(frozen=True)
class Token:
    """Whose it is and what it may do."""

    user: str
    write: bool = True


class Refused(Exception):
    """An answer that is an error."""

    def __init__(self, status: int, message: str, code: str = "", **more: Any):
        headers = {"X-Error-Message": message} | ({"X-Error-Code": code} if code else {})
        self.answer = Answer(status, {"error": message, **more}, headers)


class Hub(Wire):
    """Repositories, tokens and the routes."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.repos: dict[str, Repo] = {}
        self.tokens: dict[str, Token] = {}
        self.creating = threading.Lock()
        super().__init__()

    def add_token(self, token: str, user: str, *, write: bool = True) -> str:
        self.tokens[token] = Token(user, write)
        return token

    def repo(self, name: str) -> Repo:
        """The repository `datasets/user/name` or `models/user/name`."""
        return self.repos[name]

    def answer(self, method: str, path: str, query: str, headers: Any, body: bytes) -> Answer:
        for pattern, route in _ROUTES.items():
            if found := re.fullmatch(pattern, f"{method} {path}"):
                try:
                    return route(self, _Call(self, self._who(headers), query, body), **found.groupdict())
                except Refused as refused:
                    return refused.answer
        return Answer(404, {"error": f"no such route: {method} {path}"})

    def _who(self, headers: Any) -> Token | None:
        words = headers.get("Authorization", "").split()
        return self.tokens.get(words[1], Token("")) if len(words) == 2 else None


@dataclass(frozen=True)
class _Call:
    hub: Hub
    who: Token | None
    query: str
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body)

    def user(self) -> Token:
        """Who asks; refused without a token, or with one that nobody was given."""
        if self.who is None:
            raise Refused(401, "Invalid username or password.")
        if not self.who.user:
            raise Refused(401, "Invalid credentials in Authorization header")
        return self.who

    def readable(self, name: str) -> Repo:
        if self.who is not None:
            self.user()
        repo = self.hub.repos.get(name)
        if repo is None or (repo.private and (self.who is None or self.who.user != repo.owner)):
            raise Refused(401 if self.who is None else 404, "Repository not found", "RepoNotFound")
        return repo

    def writable(self, name: str) -> Repo:
        user, repo = self.user(), self.readable(name)
        if not user.write or user.user != repo.owner:
            raise Refused(403, "you don't have the rights to write to this repository")
        return repo

    def at(self, repo: Repo, revision: str) -> str:
        commit = repo.find(revision)
        if commit is None:
            raise Refused(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return commit


def _create(hub: Hub, call: _Call) -> Answer:
    user, asked = call.user(), call.json()
    owner = asked.get("organization") or user.user
    kind = f"{asked.get('type') or 'model'}s"
    name = f"{owner}/{asked['name']}"
    if not user.write or owner != user.user:
        raise Refused(403, f"You don't have the rights to create a {kind[:-1]} under the namespace {owner}")
    url = f"{hub.url}/{'datasets/' if kind == 'datasets' else ''}{name}"
    private = asked.get("private") or asked.get("visibility") == "private"
    with hub.creating:
        if f"{kind}/{name}" in hub.repos:
            raise Refused(409, f"You already created this {kind[:-1]} repo", url=url)
        hub.repos[f"{kind}/{name}"] = Repo(hub.folder / kind / name, owner, bool(private))
    return Answer(200, {"url": url, "name": name})


def _validate_yaml(hub: Hub, call: _Call) -> Answer:
    header = re.match(r"---\n(.*?)\n---\n", call.json()["content"], re.DOTALL)
    try:
        if header is None or not isinstance(yaml.safe_load(header[1]), dict):
            raise ValueError("no metadata")
    except (ValueError, yaml.YAMLError) as error:
        return Answer(400, {"errors": [{"message": str(error)}], "warnings": []})
    return Answer(200, {"errors": [], "warnings": []})


def _preupload(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    repo = call.writable(name)
    tree = repo.tree(call.at(repo, revision))
    files: list[dict[str, Any]] = []
    for one in call.json()["files"]:
        mode = "lfs" if one["path"].endswith(LFS_SUFFIXES) or one["size"] > 10e6 else "regular"
        known = {"oid": tree[one["path"]].git_sha1} if one["path"] in tree else {}
        files.append({"path": one["path"], "uploadMode": mode, "shouldIgnore": False, **known})
    return Answer(200, {"files": files})


def _lfs_batch(hub: Hub, call: _Call, name: str) -> Answer:
    name = name if name.startswith("datasets/") else f"models/{name}"
    repo, objects = call.writable(name), []
    for one in call.json()["objects"]:
        entry = {"oid": one["oid"], "size": one["size"]}
        if not (repo.lfs / one["oid"]).exists():
            base = f"{hub.url}/lfs/{name}/{one['oid']}"
            entry["actions"] = {
                "upload": {"href": f"{base}?X-Amz-Signature={LFS_SECRET}"},
                "verify": {"href": f"{base}/verify"},
            }
        objects.append(entry)
    return Answer(200, {"transfer": "basic", "objects": objects})


def _lfs_put(hub: Hub, call: _Call, name: str, oid: str) -> Answer:
    if LFS_SECRET not in call.query:
        raise Refused(403, "not signed")
    if hashlib.sha256(call.body).hexdigest() != oid:
        raise Refused(400, "the sha256 of what arrived is another one")
    path = hub.repo(name).lfs / oid
    path.with_suffix(".part").write_bytes(call.body)
    path.with_suffix(".part").replace(path)
    return Answer()


def _lfs_verify(hub: Hub, call: _Call, name: str, oid: str) -> Answer:
    path = call.writable(name).lfs / oid
    if not path.exists() or path.stat().st_size != call.json()["size"]:
        raise Refused(404, "no such object")
    return Answer()


def _commit(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    repo = call.writable(name)
    lines = [json.loads(line) for line in call.body.splitlines()]
    values = {kind: [line["value"] for line in lines if line["key"] == kind] for kind in _KEYS}
    header = values["header"][0]
    if revision not in repo.refs("heads"):
        raise Refused(404, f"Invalid rev id: {revision}", "RevisionNotFound")
    tree = repo.tree(repo.refs("heads")[revision])
    for one in values["deletedFile"]:
        if one["path"] not in tree:
            raise Refused(404, "A file with this name doesn't exist", "EntryNotFound")
    for one in values["lfsFile"]:
        if not (repo.lfs / one["oid"]).exists():
            raise Refused(400, f"LFS pointer of {one['path']} points to a file that does not exist")
    files = {one["path"]: base64.b64decode(one["content"]) for one in values["file"]}
    lfs = {one["path"]: (one["oid"], one["size"]) for one in values["lfsFile"]}
    deleted = [one["path"] for one in values["deletedFile"]]
    try:
        oid = repo.commit(f"refs/heads/{revision}", header.get("parentCommit"), files, lfs, deleted, header["summary"])
    except WrongParentError:
        raise Refused(412, "A commit has happened since. Please refresh and try again.") from None
    return Answer(200, {"commitUrl": f"{hub.url}/{name}/commit/{oid}", "commitOid": oid, "success": True})


_KEYS = ("header", "file", "lfsFile", "deletedFile")


def _refs(hub: Hub, call: _Call, name: str) -> Answer:
    repo = call.readable(name)
    found = {
        word: [{"name": key, "ref": f"refs/{kind}/{key}", "targetCommit": sha} for key, sha in repo.refs(kind).items()]
        for word, kind in (("branches", "heads"), ("tags", "tags"))
    }
    return Answer(200, {**found, "converts": []})


def _tag(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    repo, tag = call.writable(name), call.json()["tag"]
    if tag in repo.refs("tags"):
        raise Refused(409, f"Tag {tag} already exists")
    repo.set_ref(f"refs/tags/{tag}", call.at(repo, revision))
    return Answer()


def _untag(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    repo = call.writable(name)
    if revision not in repo.refs("tags"):
        raise Refused(404, f"no tag {revision}", "RevisionNotFound")
    repo.set_ref(f"refs/tags/{revision}", None)
    return Answer()


def _branch(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    repo = call.writable(name)
    if revision in repo.refs("heads"):
        raise Refused(409, f"Branch {revision} already exists")
    repo.set_ref(f"refs/heads/{revision}", call.at(repo, call.json().get("startingPoint") or "main"))
    return Answer()


def _info(hub: Hub, call: _Call, name: str, revision: str | None) -> Answer:
    repo = call.readable(name)
    commit = call.at(repo, revision or "main")
    siblings = [{"rfilename": path} for path in repo.tree(commit)]
    about = {"_id": "0", "id": name.split("/", 1)[1], "sha": commit, "private": repo.private, "siblings": siblings}
    return Answer(200, {**about, "tags": [], "downloads": 0, "likes": 0, "disabled": False, "gated": False})


def _tree(hub: Hub, call: _Call, name: str, revision: str) -> Answer:
    """Every file, and the folders at the root, as a client that asks for all folders gets them."""
    repo = call.readable(name)
    files = repo.tree(call.at(repo, revision))
    assert "recursive=true" in call.query.lower()
    folders = sorted({path.partition("/")[0] for path in files if "/" in path})
    found = [{"type": "directory", "path": path, "oid": "0" * 40, "size": 0} for path in folders]
    for path, blob in files.items():
        lfs = {"lfs": {"oid": blob.oid, "size": blob.size, "pointerSize": 130}} if blob.oid else {}
        found.append({"type": "file", "path": path, "oid": blob.git_sha1, "size": blob.size, **lfs})
    return Answer(200, found)


def _resolve(hub: Hub, call: _Call, name: str, revision: str, path: str) -> Answer:
    name = name if name.startswith("datasets/") else f"models/{name}"
    repo = call.readable(name)
    commit = call.at(repo, revision)
    blob = repo.tree(commit).get(path)
    if blob is None:
        raise Refused(404, f"{path} does not exist on {revision}", "EntryNotFound")
    linked = {"X-Linked-Etag": f'"{blob.etag}"', "X-Linked-Size": str(blob.size)} if blob.oid else {}
    headers = {"ETag": f'"{blob.etag}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes", **linked}
    return Answer(200, repo.read(blob), {"Content-Type": "application/octet-stream", **headers})


_REVISION = r"(?P<revision>[^/]+)"
_REPO = r"/(?P<name>(?:datasets/)?[^/]+/[^/]+)"
_ROUTES: dict[str, Any] = {
    r"POST /api/repos/create": _create,
    r"POST /api/validate-yaml": _validate_yaml,
    rf"POST {_API}/preupload/{_REVISION}": _preupload,
    rf"POST {_REPO}\.git/info/lfs/objects/batch": _lfs_batch,
    r"PUT /lfs/(?P<name>[^/]+/[^/]+/[^/]+)/(?P<oid>[0-9a-f]{64})": _lfs_put,
    r"POST /lfs/(?P<name>[^/]+/[^/]+/[^/]+)/(?P<oid>[0-9a-f]{64})/verify": _lfs_verify,
    rf"POST {_API}/commit/{_REVISION}": _commit,
    rf"GET {_API}/refs": _refs,
    rf"POST {_API}/tag/{_REVISION}": _tag,
    rf"DELETE {_API}/tag/{_REVISION}": _untag,
    rf"POST {_API}/branch/{_REVISION}": _branch,
    rf"GET {_API}(?:/revision/{_REVISION})?": _info,
    rf"GET {_API}/tree/{_REVISION}": _tree,
    rf"(?:GET|HEAD) {_REPO}/resolve/{_REVISION}/(?P<path>.+)": _resolve,
}


@contextlib.contextmanager
def hub_server(folder: Path) -> Iterator[Hub]:
    """A Hub on a free port of loopback, its repositories under `folder`."""
    hub = Hub(folder)
    try:
        yield hub
    finally:
        hub.close()


def clean_environment(hub: Hub, home: Path, token: str | None = None) -> dict[str, str]:
    """What a process needs in its environment to know no other Hub than this one."""
    given = {"HF_TOKEN": token} if token else {}
    quiet = {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0"}
    return {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), **quiet, **given}
