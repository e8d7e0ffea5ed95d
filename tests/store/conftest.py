"""Stores on this machine: moto, sshd, folders."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from ..synthetic import make_episode, offline, spec
from .hub_server import Hub
from .hub_use import a_hub, make_policy
from .s3 import Proxy, client_of, running_moto, running_proxy, variables
from .sshd import Sshd, running_sshd

__all__ = ["make_episode", "offline", "spec"]


@pytest.fixture(scope="session")
def moto() -> Iterator[str]:
    with running_moto() as endpoint:
        yield endpoint


@pytest.fixture(scope="session")
def sshd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sshd]:
    with running_sshd(tmp_path_factory.mktemp("sshd")) as server:
        yield server


@pytest.fixture
def bucket(moto: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """Name of an empty bucket; the environment says how to reach it."""
    for name, value in variables(moto).items():
        monkeypatch.setenv(name, value)
    name = f"b{abs(hash(request.node.nodeid)):x}"
    client_of(moto).create_bucket(Bucket=name)
    return name


@pytest.fixture
def proxy(bucket: str, moto: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Proxy]:
    """Between us and the bucket."""
    with running_proxy(moto) as running:
        monkeypatch.setenv("AWS_ENDPOINT_URL", running.url)
        yield running


def url_on(kind: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A URL where nothing is yet, on a kind of store."""
    if kind == "s3":
        return f"s3://{request.getfixturevalue('bucket')}/some/demos"
    if kind == "file":
        return f"file://{tmp_path}/store/demos"
    server: Sshd = request.getfixturevalue("sshd")
    monkeypatch.setenv("HOME", str(server.home))
    return server.url(tmp_path / "store" / "demos")


@pytest.fixture(params=["file", "s3", pytest.param("sftp", marks=pytest.mark.slow)])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A URL where nothing is yet, on each kind of store."""
    return url_on(request.param, request, tmp_path, monkeypatch)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    """A Hub that this process talks to."""
    with a_hub(tmp_path / "hub") as server:
        yield server


@pytest.fixture(scope="session")
def tiny_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small ACT, as LeRobot writes it."""
    return make_policy(tmp_path_factory.mktemp("policies") / "act")
