"""What the tests of the Hub share: a server, somebody who is logged in, a dataset, and folders to compare."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from huggingface_hub import constants

from manip_il.cli.push_pull import open_remote
from manip_il.data.dataset import Dataset
from manip_il.store.errors import Retry
from manip_il.store.pull import Pulled, pull
from manip_il.store.push import push
from manip_il.store.remote import MANIFEST_FILE, Published, RemoteUrl

from ..learn.tiny_policies import write_checkpoint
from .hub_server import Hub, hub_server
from .trees import unwatched

TOKEN = "hf_NobodyMayEverReadThisToken"
DATASET = "hf://datasets/user/demos"
POLICY = "hf://user/policy"
SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


@contextlib.contextmanager
def a_hub(folder: Path, token: str = TOKEN) -> Iterator[Hub]:
    """A Hub that this process talks to, with the token of `user`."""
    with hub_server(folder) as hub, pytest.MonkeyPatch.context() as patch:
        hub.add_token(TOKEN, "user")
        patch.setattr(constants, "ENDPOINT", hub.url)
        patch.setattr(constants, "HF_HUB_OFFLINE", False)
        patch.setattr(constants, "HF_TOKEN_PATH", str(folder / "no_token"))
        patch.setenv("HF_TOKEN", token)
        yield hub


def do_push(source: Path, url: str = DATASET, *, private: bool = False) -> Published:
    parsed = RemoteUrl.parse(url)
    published = push(source, parsed, open_remote(parsed, private=private), unwatched)[1]
    assert published is not None
    return published


def do_pull(target: Path, url: str = DATASET) -> Pulled:
    parsed = RemoteUrl.parse(url)
    return pull(parsed, open_remote(parsed), target, unwatched, retry=Retry(first=0.01))


def files_of_main(hub: Hub) -> dict[str, bytes]:
    """Path -> bytes of what a reader of the dataset's main branch sees."""
    files = hub.repo("datasets/user/demos").files
    return {path: data for path, data in files.items() if path not in (MANIFEST_FILE, ".gitattributes")}


def copy_sample(target: Path) -> Path:
    """The sample, to be changed."""
    shutil.copytree(SAMPLE, target)
    return target


def other_version(target: Path) -> Path:
    """A dataset that differs from the sample in every data file: its first seven episodes."""
    from manip_il.data.lerobot_write import write_dataset

    sample = Dataset.open(SAMPLE)
    episodes = list(sample.read_episodes())[:7]
    write_dataset(episodes, target, sample.spec, repo_id="local/sample", fingerprint=sample.fingerprint)
    return target


def make_policy(target: Path) -> Path:
    """A small ACT for the sample, as LeRobot writes it."""
    return write_checkpoint(target, "act", Dataset.open(SAMPLE).spec)
