"""Push and pull by the Hub's own client, against a Hub on loopback."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from huggingface_hub import HfApi, constants
from huggingface_hub.utils import logging as hub_logging

from manip_il.cli.push_pull import open_remote
from manip_il.errors import UsageError
from manip_il.store.cards import CARD, PICTURE
from manip_il.store.disk import git_digest
from manip_il.store.errors import ConflictError
from manip_il.store.hub_session import hub_session
from manip_il.store.push import check_source, push, scan
from manip_il.store.remote import MANIFEST_FILE, RemoteUrl

from .hub_server import Hub
from .hub_use import (
    DATASET,
    POLICY,
    SAMPLE,
    TOKEN,
    copy_sample,
    do_pull,
    do_push,
    other_version,
)
from .trees import content, wait_little
from .wire import Fault


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return other_version(tmp_path_factory.mktemp("other") / "demos")


@pytest.mark.parametrize("kind", ["dataset", "policy"])
def test_what_is_pushed_comes_back_byte_equal_and_a_datasets_tag_names_its_commit(
    kind: str, hub: Hub, tmp_path: Path, tiny_policy: Path
):
    source, url, made, name = {
        "dataset": (SAMPLE, DATASET, {CARD, PICTURE}, "datasets/user/demos"),
        "policy": (tiny_policy, POLICY, {CARD}, "models/user/policy"),
    }[kind]
    published = do_push(source, url)
    do_pull(tmp_path / "back", url)
    back, sent = content(tmp_path / "back"), content(source)
    assert {path: back[path] for path in sent} == sent
    assert set(back) - set(sent) == made
    assert published.uploaded == len(back)
    repo = hub.repo(name)
    assert repo.refs("heads")["main"] == published.token
    assert repo.refs("tags") == ({"v3.0": published.token} if kind == "dataset" else {})


def test_an_unchanged_dataset_makes_no_commit(hub: Hub):
    first = do_push(SAMPLE)
    received = hub.received()
    again = do_push(SAMPLE)
    assert again.token == first.token
    assert (again.uploaded, again.size, again.removed) == (0, 0, 0)
    assert hub.received() == received


def test_only_what_changed_travels_and_what_is_gone_is_deleted(hub: Hub, tmp_path: Path):
    source = copy_sample(tmp_path / "demos")
    notes = source / "notes"
    notes.mkdir()
    (notes / "old.txt").write_text("old")
    (notes / "kept.txt").write_text("kept" * 1000)
    do_push(source)
    (notes / "old.txt").unlink()
    (notes / "new.txt").write_bytes(b"n" * 5000)
    before = hub.received()
    published = do_push(source)
    repo = hub.repo("datasets/user/demos")
    tree = repo.tree(repo.refs("heads")["main"])
    assert (published.uploaded, published.size, published.removed) == (1, 5000, 1)
    assert {path for path in tree if path.startswith("notes")} == {"notes/kept.txt", "notes/new.txt"}
    listed = tree[MANIFEST_FILE].size
    assert hub.received() - before < 1.4 * (5000 + listed) + 1000  # base64 makes a third more of both
    assert ".gitattributes" in tree  # the Hub's own


def test_bytes_of_one_large_file_are_told_of_while_they_go(hub: Hub, tmp_path: Path, tiny_policy: Path):
    run = shutil.copytree(tiny_policy, tmp_path / "run")
    (run / "large.safetensors").write_bytes(bytes(10_000_000))
    hub.faults.append(Fault("^PUT ", cut=4_000_000))  # and none twice
    told: list[tuple[int, int]] = []

    @contextlib.contextmanager
    def watched(total: int, what: str) -> Iterator:
        yield lambda count: told.append((count, len(hub.requests("/commit/"))))
        assert sum(count for count, _ in told) == total

    url = RemoteUrl.parse(POLICY)
    push(run, url, open_remote(url), watched)
    assert max(count for count, _ in told) < 2_000_000
    assert sum(count for count, commits in told if not commits) > 10_000_000


def test_a_reader_of_the_old_commit_finishes_while_a_new_one_is_pushed(hub: Hub, tmp_path: Path, other: Path):
    do_push(SAMPLE)
    remote = open_remote(RemoteUrl.parse(DATASET))
    old = remote.read()
    do_push(other)
    for entry in old.manifest.files:
        with (tmp_path / "part").open("wb") as file:
            remote.fetch(old, entry, file, 0)
        if entry.path not in (CARD, PICTURE):
            assert (tmp_path / "part").read_bytes() == (SAMPLE / entry.path).read_bytes()


def test_readers_see_one_version_or_the_other(hub: Hub, tmp_path: Path, other: Path):
    do_push(SAMPLE)
    versions = []
    for source in (SAMPLE, other):
        do_push(source)
        do_pull(tmp_path / source.name)
        versions.append(content(tmp_path / source.name))
    stop, seen = threading.Event(), []

    def read() -> None:
        while not stop.is_set():
            remote = open_remote(RemoteUrl.parse(DATASET))
            seen.append({entry.path: entry.size for entry in remote.read().manifest.files})

    reader = threading.Thread(target=read)
    reader.start()
    for source in (SAMPLE, other, SAMPLE, other):
        do_push(source)
    stop.set()
    reader.join()
    sizes = [{path: len(content) for path, content in version.items()} for version in versions]
    assert len(seen) > 4
    assert all(one in sizes for one in seen)
    assert all(size in seen for size in sizes)


@pytest.mark.parametrize("faults", [[], [Fault("/commit/", cut=10)]], ids=["answered", "the answer is lost"])
def test_of_two_pushers_one_wins_and_the_other_is_told(
    faults: list[Fault], hub: Hub, other: Path, monkeypatch: pytest.MonkeyPatch
):
    wait_little(monkeypatch)
    do_push(SAMPLE)
    remote, url = open_remote(RemoteUrl.parse(DATASET)), RemoteUrl.parse(DATASET)
    before = remote.read()
    do_push(other)
    repo = hub.repo("datasets/user/demos")
    head = repo.refs("heads")["main"]
    scanned = scan(SAMPLE, check_source(SAMPLE, url))
    hub.faults = faults
    with pytest.raises(ConflictError, match="changed by another push"):
        remote.publish(scanned.local, scanned.manifest, before, lambda count: None)
    assert repo.refs("heads")["main"] == head == repo.refs("tags")["v3.0"]


def test_settings_of_the_client_hold_until_the_last_thread_is_done(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", False)
    level = hub_logging.get_verbosity()
    first, second = (hub_session("a repository", "http://127.0.0.1:1") for _ in range(2))
    first.__enter__()
    with second:
        first.__exit__(None, None, None)
        assert constants.HF_HUB_DISABLE_XET
        assert hub_logging.get_verbosity() == hub_logging.ERROR
    assert not constants.HF_HUB_DISABLE_XET
    assert hub_logging.get_verbosity() == level


def test_of_two_first_pushes_at_once_one_wins(hub: Hub, other: Path):
    url, results = RemoteUrl.parse(DATASET), []
    ready = threading.Barrier(2)

    def one(source: Path) -> None:
        remote, scanned = open_remote(url), scan(source, "dataset")
        before = remote.read()
        ready.wait()
        try:
            results.append(remote.publish(scanned.local, scanned.manifest, before, lambda count: None).token)
        except ConflictError:
            results.append("conflict")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, (SAMPLE, other)))
    repo = hub.repo("datasets/user/demos")
    head = repo.refs("heads")["main"]
    assert sorted(results) == sorted(["conflict", head])
    assert repo.refs("tags")["v3.0"] == head


def test_a_branch_is_made_and_leaves_main_and_its_tag_alone(hub: Hub, tmp_path: Path, other: Path):
    first = do_push(SAMPLE)
    second = do_push(other, f"{DATASET}@trial")
    repo = hub.repo("datasets/user/demos")
    assert repo.refs("heads") == {"main": first.token, "trial": second.token}
    assert repo.refs("tags") == {"v3.0": first.token}
    do_pull(tmp_path / "trial", f"{DATASET}@trial")
    do_pull(tmp_path / "old", f"{DATASET}@{first.token}")
    assert (tmp_path / "trial" / "meta" / "info.json").read_bytes() == (other / "meta" / "info.json").read_bytes()
    assert (tmp_path / "old" / "meta" / "info.json").read_bytes() == (SAMPLE / "meta" / "info.json").read_bytes()
    with pytest.raises(UsageError, match="not a branch"):
        do_push(SAMPLE, f"{DATASET}@v3.0")


def test_what_another_program_pushed_can_be_pulled_and_replaced(hub: Hub, tmp_path: Path):
    api = HfApi(endpoint=hub.url, token=TOKEN)
    api.create_repo("user/demos", repo_type="dataset")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        api.upload_folder(repo_id="user/demos", repo_type="dataset", folder_path=SAMPLE)
    do_pull(tmp_path / "back")
    assert content(tmp_path / "back") == content(SAMPLE)
    published = do_push(SAMPLE)
    assert published.uploaded == 2  # the card and its picture


def test_an_edit_on_the_website_is_seen_and_overruled_by_the_next_push(hub: Hub, tmp_path: Path):
    do_push(SAMPLE)
    repo = hub.repo("datasets/user/demos")
    head = repo.refs("heads")["main"]
    text = repo.files["meta/info.json"]
    edited = text.replace(b'"fps": 20', b'"fps": 21')  # the same size: only its hash tells
    assert edited != text
    repo.commit("refs/heads/main", head, {"meta/info.json": edited}, {}, [], "an edit")
    do_pull(tmp_path / "edited")
    assert (tmp_path / "edited" / "meta" / "info.json").read_bytes() == edited
    assert do_push(SAMPLE).uploaded == 1
    do_pull(tmp_path / "mended")
    assert (tmp_path / "mended" / "meta" / "info.json").read_bytes() == text


def test_the_id_of_a_file_is_gits():
    data = (SAMPLE / "meta" / "info.json").read_bytes()
    digest = git_digest(len(data))
    digest.update(data)
    said = subprocess.run(["git", "hash-object", "--stdin"], input=data, capture_output=True, check=True).stdout
    assert digest.hexdigest() == said.decode().strip()


def test_a_private_repository_is_private(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    do_push(SAMPLE, private=True)
    assert hub.repo("datasets/user/demos").private
    do_pull(tmp_path / "mine")
    monkeypatch.setenv("HF_TOKEN", hub.add_token("hf_SomebodyElsesToken", "else"))
    assert open_remote(RemoteUrl.parse(DATASET)).read() is None
