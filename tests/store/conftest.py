"""An empty place on every kind of remote, a Hub, and runs to push."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ..synthetic import make_episode, spec
from .servers import TOKEN, Hub, Sshd, hub_server, s3_server, sshd_server, talk_to

__all__ = ["make_episode", "spec"]  # fixtures
SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
DATASET, POLICY = "hf://datasets/user/demos", "hf://user/policy"


@pytest.fixture(scope="session")
def s3() -> Iterator[dict[str, str]]:
    with s3_server("bucket") as variables:
        yield variables


@pytest.fixture(scope="session")
def sshd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sshd]:
    with sshd_server(tmp_path_factory.mktemp("sshd")) as server:
        yield server


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A Hub that this process talks to."""
    with hub_server() as server:
        talk_to(server.url, monkeypatch.setattr)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield server


@pytest.fixture
def bucket(s3: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """A URL in an S3 where nothing is yet."""
    for name, value in s3.items():
        monkeypatch.setenv(name, value)
    return f"s3://bucket{tmp_path}"


SFTP = pytest.param("sftp", marks=[pytest.mark.slow, pytest.mark.system])


@pytest.fixture(params=["file", "s3", SFTP, "hub"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A URL where nothing is yet, on each kind of remote."""
    if request.param == "sftp":
        server: Sshd = request.getfixturevalue("sshd")
        monkeypatch.setenv("HOME", str(server.home))
        return server.url(tmp_path / "store" / "demos")
    if request.param == "hub":
        request.getfixturevalue("hub")
        return POLICY
    return (
        f"file://{tmp_path}/store" if request.param == "file" else request.getfixturevalue("bucket")
    )


def make_run(folder: Path, seed: int = 1, size: int = 20_000) -> Path:
    """A run as `train` leaves it, with random weights; equal files and an empty one."""
    rng, model = np.random.default_rng(seed), folder / "checkpoints" / "000004" / "pretrained_model"
    model.mkdir(parents=True)
    (folder / "checkpoints" / "last").symlink_to("000004")
    (folder / "README.md").write_text("# By hand\n")
    (folder / "config.yaml").write_text("# manip-il 0.1.0: resolved options (TrainOptions)\n")
    for name, data in {
        "same.json": b"{}",
        "copy.json": b"{}",
        "empty.txt": b"",
        "new.txt": rng.bytes(99),
    }.items():
        (folder / name).write_bytes(data)
    (model / "config.json").write_text(f'{{"type": "act", "seed": {seed}}}')
    (model / "model.safetensors").write_bytes(rng.bytes(size))
    return folder


def content(folder: Path) -> dict[str, object]:
    """Everything below: bytes of files, targets of links."""
    paths = {
        str(path.relative_to(folder)): path
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }
    return {
        name: os.readlink(path) if path.is_symlink() else path.read_bytes()
        for name, path in paths.items()
    }
