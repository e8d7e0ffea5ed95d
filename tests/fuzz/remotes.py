"""Targets of what servers answer: a good conversation with a Hub or an S3 store, of which one answer is changed."""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import boto3
import numpy as np
import pytest
from safetensors.numpy import save_file

from manip_il.store.pull import pull
from manip_il.store.push import push

from ..store.hub_use import POLICY, a_hub, do_pull, do_push
from ..store.s3 import KEY, SECRET, running_moto, running_proxy, variables
from ..store.trees import impatient, no_wait, unwatched, wait_little
from ..store.wire import Answer
from .target import Target
from .trees import damaged, mutate_json

STATUSES = (
    *(200, 201, 204, 206, 301, 302, 304, 307, 400, 401, 402, 403, 404, 408, 409, 412, 413, 416, 429, 500, 503, 507),
)
HEADERS = (
    *("ETag", "X-Repo-Commit", "X-Linked-Etag", "X-Linked-Size", "Content-Range", "Content-Type", "Retry-After"),
    *("Link", "Location", "X-Error-Message", "X-Error-Code", "Last-Modified", "Content-Encoding", "Accept-Ranges"),
    *("x-amz-version-id", "x-amz-request-id", "x-amz-checksum-sha256"),
)
VALUES = (
    *("", "x", "0", "-1", "9" * 400, "../x", '"../../x"', "bytes 0-9/3", "bytes */0", "gzip", "br", "a" * 20_000),
    *("http://127.0.0.1:9/x", '</x>; rel="next"', '<http://127.0.0.1:9/>; rel="next"', "NaN", "1e9", "text/html"),
    *("Thu, 99 Jan 9999", "\x1b[31mred", "0" * 40, f'"{64 * "0"}"', "RepoNotFound", "GatedRepo", "EntryNotFound"),
)


def mutate_script(rng: Random, data: bytes) -> bytes:
    """Which answers are changed, and how: `at`, the number of the first; `always`, those behind it too."""
    script = {"at": rng.randrange(json.loads(data)["answers"]), "seed": rng.randrange(2**32)}
    return json.dumps({**script, "always": rng.random() < 0.3}).encode()


@dataclass
class Script:
    """The changes of one conversation."""

    at: int
    seed: int
    always: bool
    answers: Iterator[int] = field(default_factory=itertools.count)

    @classmethod
    def read(cls, path: Path) -> Script:
        tree = json.loads(path.read_text())
        return cls(tree["at"], tree["seed"], tree["always"]) if "at" in tree else cls(-1, 0, False)

    def change(self, status: int, headers: dict[str, str], body: bytes) -> tuple[int, dict[str, str], bytes]:
        """What goes out in place of an answer."""
        number = next(self.answers)
        if self.at < 0 or number < self.at or (number > self.at and not self.always):
            return status, headers, body
        rng = Random(f"{self.seed}/{number}")
        choice = rng.randrange(8)
        if choice == 0:
            return rng.choice(STATUSES), headers, rng.choice((body, b"", b"<html>no</html>", b'{"error": ["x"]}'))
        if choice <= 2:
            name = rng.choice(HEADERS)
            return status, {**headers, name: rng.choice(VALUES)}, body
        if choice == 3 and headers:
            gone = rng.choice(list(headers))
            return status, {name: value for name, value in headers.items() if name != gone}, body
        return status, headers, _changed_body(rng, body)


def _changed_body(rng: Random, body: bytes) -> bytes:
    if body[:1] in (b"{", b"[") and rng.random() < 0.85:
        with contextlib.suppress(ValueError):
            return mutate_json(rng, body)
    return damaged(rng, body)


def make_small_policy(folder: Path) -> Path:
    """What is pushed and pulled: as few bytes as a policy has."""
    folder.mkdir(parents=True)
    feature = {"type": "STATE", "shape": [2]}
    config = {"type": "mlp", "input_features": {"observation.state": feature}, "output_features": {"action": feature}}
    (folder / "config.json").write_text(json.dumps(config))
    save_file({"w": np.zeros(3, np.float32)}, folder / "model.safetensors")
    (folder / "manip_il.json").write_text("{}")
    return folder


class Conversation:
    """A server with one policy to pull, and room for another one to push."""

    def __init__(self, answers: int):
        self.answers = answers

    def make(self, folder: Path) -> None:
        make_small_policy(folder / "policy")
        (folder / "script.json").write_text(json.dumps({"answers": self.answers}))


class HubConversation(Conversation):
    """A Hub with one policy to pull, and room for another one to push."""

    @contextlib.contextmanager
    def around(self, folder: Path) -> Iterator[None]:
        with a_hub(folder / "hub") as hub, pytest.MonkeyPatch.context() as patch:
            wait_little(patch)  # huggingface_hub's own waits between tries cost seconds
            self._script, honest = Script(-1, 0, False), hub.answer
            do_push(make_small_policy(folder / "first"), POLICY)

            def answer(method: str, path: str, query: str, headers: Any, body: bytes) -> Answer:
                given = honest(method, path, query, headers, body)
                status, said, content = self._script.change(given.status, given.headers, given.content())
                return replace(given, status=status, headers=said, body=content)

            hub.answer = answer
            self._hub = hub
            yield

    def pull(self, folder: Path) -> None:
        self._script = Script.read(folder / "script.json")
        do_pull(folder / "pulled", POLICY)

    def push(self, folder: Path) -> None:
        self._script = Script.read(folder / "script.json")
        kept = {name: repo for name, repo in self._hub.repos.items() if name.endswith("/policy")}
        self._hub.repos.clear()
        self._hub.repos |= kept
        shutil.rmtree(self._hub.folder / "models" / "user" / "new", ignore_errors=True)
        do_push(folder / "policy", "hf://user/new")


class S3Conversation(Conversation):
    """A bucket with one policy to pull; each push goes to a folder of its own."""

    _pushes = 0

    @contextlib.contextmanager
    def around(self, folder: Path) -> Iterator[None]:
        with running_moto() as moto, running_proxy(moto) as proxy, mock.patch.dict("os.environ", variables(proxy.url)):
            client = boto3.client("s3", endpoint_url=moto, aws_access_key_id=KEY, aws_secret_access_key=SECRET)
            client.create_bucket(Bucket="fuzz")
            self._push_to("s3://fuzz/policy", make_small_policy(folder / "first"))
            self._script = Script(-1, 0, False)
            proxy.change = lambda status, headers, body: self._script.change(status, headers, body)
            yield

    def pull(self, folder: Path) -> None:
        self._script = Script.read(folder / "script.json")
        url, remote = impatient("s3://fuzz/policy")
        pull(url, remote, folder / "pulled", unwatched, retry=no_wait())

    def push(self, folder: Path) -> None:
        self._script, self._pushes = Script.read(folder / "script.json"), self._pushes + 1
        self._push_to(f"s3://fuzz/push-{self._pushes}", folder / "policy")

    def _push_to(self, url: str, source: Path) -> None:
        parsed, remote = impatient(url)
        push(source, parsed, remote, unwatched)


_PULL, _PUSH, _S3_PULL, _S3_PUSH = HubConversation(12), HubConversation(30), S3Conversation(10), S3Conversation(20)
TARGETS = (
    Target("hub pull", _PULL.make, "script.json", mutate_script, (_PULL.pull,), _PULL.around, share=0.5),
    Target("hub push", _PUSH.make, "script.json", mutate_script, (_PUSH.push,), _PUSH.around, share=0.5),
    Target("s3 pull", _S3_PULL.make, "script.json", mutate_script, (_S3_PULL.pull,), _S3_PULL.around, share=0.5),
    Target("s3 push", _S3_PUSH.make, "script.json", mutate_script, (_S3_PUSH.push,), _S3_PUSH.around, share=0.5),
)
