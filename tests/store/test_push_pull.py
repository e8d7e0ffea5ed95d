"""What is pulled is what was pushed; what has not changed does not travel.

Readers see one version or the other.
"""

import hashlib
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from manip_il.bridges.store.errors import RemoteError
from manip_il.bridges.store.manifest import MANIFEST_FILE
from manip_il.bridges.store.objects import Objects
from manip_il.bridges.store.transfer import open_remote, pull, push
from manip_il.data.dataset import Dataset
from manip_il.errors import FolderExistsError, ManipError

from ..learn.tiny_policies import write_checkpoint
from .conftest import DATASET, POLICY, SAMPLE, content, make_run
from .servers import Hub

open_quietly = partial(open_remote, quiet=True)


def test_a_run_comes_back_as_it_was_and_only_changes_travel(place: str, tmp_path: Path):
    run, got = make_run(tmp_path / "run"), tmp_path / "got"
    (run / ".hidden").write_text("left here")
    push(run, open_quietly(place))
    (run / ".hidden").unlink()
    pull(open_quietly(place), got)
    assert content(got) == content(run)
    (run / "same.json").write_text("[1]")
    (run / "more.json").write_text("[12]")
    (run / "empty.txt").unlink()
    plan = push(run, open_quietly(place))
    assert (plan.upload, plan.remove) == (["more.json", "same.json"], ["empty.txt"])
    with pytest.raises(FolderExistsError):
        pull(open_quietly(place), got)
    pull(open_quietly(place), got, overwrite=True)
    assert content(got) == content(run)
    assert not list(tmp_path.glob(".got*"))


def test_a_reader_of_the_version_before_finishes_while_a_new_one_is_pushed(
    place: str, tmp_path: Path
):
    push(make_run(tmp_path / "a", 1), open_quietly(place))
    reader = open_quietly(place)
    old = reader.read()
    push(make_run(tmp_path / "b", 2), open_quietly(place))
    reader.read = lambda: old
    pull(reader, tmp_path / "got")
    assert content(tmp_path / "got") == content(tmp_path / "a")


def test_of_two_pushes_one_wins_and_the_other_is_told(place: str, tmp_path: Path):
    runs = [make_run(tmp_path / name, seed) for seed, name in enumerate("abc")]
    push(runs[0], open_quietly(place))
    late = open_quietly(place)
    read, answers = late.read, iter([late.read()])
    push(runs[1], open_quietly(place))
    late.read = lambda: next(answers, None) or read()
    with pytest.raises(RemoteError, match="push again"):
        push(runs[2], late)
    pull(open_quietly(place), tmp_path / "got")
    assert content(tmp_path / "got") == content(runs[1])


def test_s3_itself_refuses_a_manifest_that_replaces_another_than_was_read(
    bucket: str, tmp_path: Path, monkeypatch
):
    remote = Objects("s3", bucket, quiet=True)
    push(make_run(tmp_path / "run"), remote)
    found = remote.read()
    older = replace(found, version='"an older tag"', files={})
    answers = iter([older, found])
    monkeypatch.setattr(remote, "read", lambda: next(answers))
    with pytest.raises(RemoteError, match="changed by another push"):
        remote._switch(older, older.version)


def test_a_push_removes_nothing_from_a_store(tmp_path: Path):
    store, run = tmp_path / "store", make_run(tmp_path / "run")
    (store / "objects").mkdir(parents=True)
    (store / "objects" / ".DS_Store").write_bytes(b"of others")
    for text in ("one", "two", "three"):
        (run / "new.txt").write_text(text)
        push(run, open_quietly(f"file://{store}"))
    assert {b"of others", b"one", b"two", b"three"} <= set(content(store).values())


@pytest.mark.parametrize("scheme", ["file", pytest.param("sftp", marks=pytest.mark.slow)])
def test_nothing_is_written_through_a_link_in_a_store(
    scheme: str, tmp_path: Path, monkeypatch, request
):
    run, store, mine = make_run(tmp_path / "run"), tmp_path / "store", tmp_path / "thesis.tex"
    url = f"file://{store}"
    if scheme == "sftp":
        server = request.getfixturevalue("sshd")
        monkeypatch.setenv("HOME", str(server.home))
        url = server.url(store)
    mine.write_text("years of work")
    sha256 = hashlib.sha256((run / "new.txt").read_bytes()).hexdigest()
    (store / "objects" / sha256[:2]).mkdir(parents=True)
    (store / "objects" / sha256[:2] / sha256).symlink_to(mine)
    with pytest.raises(RemoteError, match="is a link"):
        push(run, open_quietly(url))
    assert mine.read_text() == "years of work"
    (store / "objects" / sha256[:2] / sha256).unlink()
    (store / "objects" / sha256[:2]).rmdir()
    (tmp_path / "folder").mkdir()
    (store / "objects" / sha256[:2]).symlink_to(tmp_path / "folder")
    with pytest.raises(RemoteError, match="is a link"):
        push(run, open_quietly(url))
    assert not list((tmp_path / "folder").iterdir())


@pytest.mark.parametrize("url", [DATASET, POLICY])
def test_what_others_keep_in_a_repository_stays_and_a_card_that_was_edited_there(
    url: str, hub: Hub, tmp_path: Path
):
    source = tmp_path / "source"
    (
        shutil.copytree(SAMPLE, source)
        if url == DATASET
        else write_checkpoint(source, "act", Dataset.open(SAMPLE).spec)
    )
    (source / "notes.txt").write_text("ours")
    push(source, open_quietly(url))
    repo = hub.repos[url.removeprefix("hf://") if url == DATASET else "models/user/policy"]
    files = repo.find("main")[1]
    edited = {"README.md": files["README.md"] + b"Edited there.\n", "paper.pdf": b"of others"}
    repo.commit("main", {**files, **edited})
    for text in ("one", "two"):
        (source / "more.txt").write_text(text)
        (source / "notes.txt").unlink(missing_ok=True)
        push(source, open_quietly(url))
    after = repo.find("main")[1]
    assert edited.items() <= after.items()
    assert after["more.txt"] == b"two"
    assert "notes.txt" not in after


def test_a_dataset_replaces_that_of_another_program_without_what_is_beside_it(
    hub: Hub, tmp_path: Path
):
    push(SAMPLE, open_quietly(DATASET))
    repo = hub.repos["datasets/user/demos"]
    files = {path: data for path, data in repo.find("main")[1].items() if path != MANIFEST_FILE}
    repo.commit(
        "main", {**files, "data/chunk-000/file-001.parquet": b"PAR1", "paper.pdf": b"of others"}
    )
    demos = shutil.copytree(SAMPLE, tmp_path / "demos")
    (demos / "notes.txt").write_text("more")
    push(demos, open_quietly(DATASET))
    after = repo.find("main")[1]
    assert "paper.pdf" in after
    assert "data/chunk-000/file-001.parquet" not in after


def test_a_dataset_is_examined_before_its_push_and_links_are_not_followed(tmp_path: Path):
    broken = shutil.copytree(SAMPLE, tmp_path / "run" / "dataset")
    (broken / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1")
    (tmp_path / "run" / "config.yaml").write_text("")
    for folder in (broken, broken.parent):
        with pytest.raises(ManipError, match=r"is damaged and was not pushed.*manip-il data check"):
            push(folder, open_quietly(f"file://{tmp_path}/store"))
    shutil.rmtree(broken)
    (broken.parent / "secret.txt").symlink_to("/etc/passwd")
    with pytest.raises(RemoteError, match=r"secret\.txt is a link"):
        push(broken.parent, open_quietly(f"file://{tmp_path}/store"))
    assert not (tmp_path / "store").exists()


def test_a_hub_shows_lerobot_a_dataset_by_its_tag_and_a_runs_policy_at_the_root(
    hub: Hub, tmp_path: Path
):
    push(SAMPLE, open_quietly(DATASET))
    repo, more = hub.repos["datasets/user/demos"], shutil.copytree(SAMPLE, tmp_path / "demos")
    (more / "notes.txt").write_text("more")
    push(SAMPLE, open_quietly(f"{DATASET}@trial"))
    push(more, open_quietly(DATASET))
    assert repo.tags == {"v3.0": repo.heads["main"]}
    pull(open_quietly(DATASET, revision="trial"), tmp_path / "trial")
    assert not (tmp_path / "trial" / "notes.txt").exists()
    push(make_run(tmp_path / "run"), open_quietly(POLICY, private=True))
    files = hub.repos["models/user/policy"].find("main")[1]
    assert hub.repos["models/user/policy"].private
    assert files["config.json"] == files["checkpoints/000004/pretrained_model/config.json"]


def test_what_another_program_pushed_can_be_pulled_and_replaced(hub: Hub, tmp_path: Path):
    push(SAMPLE, open_quietly(DATASET))
    repo = hub.repos["datasets/user/demos"]
    files = repo.find("main")[1]
    edited = files["meta/info.json"].replace(b'"fps": 20', b'"fps": 21')  # of the same size
    repo.commit("main", {**files, "meta/info.json": edited})
    assert "meta/info.json" in push(SAMPLE, open_quietly(DATASET)).upload
    pull(open_quietly(DATASET), tmp_path / "got")
    assert {**content(tmp_path / "got"), **content(SAMPLE)} == content(tmp_path / "got")
