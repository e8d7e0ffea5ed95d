"""A run on a Hub: LeRobot finds its policy at the root, and a pull gives back the run as it was."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from manip_il.store.cards import CARD
from manip_il.store.manifest import FileEntry, Manifest, policy_folder, without_root_copies
from manip_il.store.push import Scanned, scan, with_root_copies

from .hub_server import Hub
from .hub_use import POLICY, do_pull, do_push
from .trees import content

RUN = {
    "config.yaml": b"# manip-il\n",
    "checkpoints/000200/pretrained_model/config.json": b"old",
    "checkpoints/001000/pretrained_model/config.json": b"{}",
    "checkpoints/001000/pretrained_model/model.safetensors": b"weights",
    "checkpoints/001000/pretrained_model/README.md": b"its own card",
    "checkpoints/001000/training_state/optimizer_state.safetensors": b"state",
}


def manifest(files: dict[str, bytes]) -> Manifest:
    entries = (FileEntry(path, len(data), hashlib.sha256(data).hexdigest()) for path, data in files.items())
    return Manifest("policy", tuple(entries))


def copied(files: dict[str, bytes]) -> Scanned:
    return with_root_copies(Scanned(manifest(files), {path: Path(path) for path in files}))


@pytest.fixture
def run(tmp_path: Path, tiny_policy: Path) -> Path:
    """As DAgger leaves it: the best policy, and the same as a round's checkpoint."""
    folder = tmp_path / "run"
    for place in ("best", "round_00/policy/checkpoints/000200"):
        (folder / place / "pretrained_model").mkdir(parents=True)
        for file in tiny_policy.iterdir():
            (folder / place / "pretrained_model" / file.name).write_bytes(file.read_bytes())
    (folder / "round_00" / "policy" / "checkpoints" / "last").symlink_to("000200")
    (folder / "config.yaml").write_text("# manip-il 0.1.0: resolved options (DaggerOptions)\nseed: 3\n")
    return folder


@pytest.mark.parametrize(
    ("paths", "folder"),
    [
        (["config.json", "best/pretrained_model/config.json"], ""),
        (["best/pretrained_model/config.json", "checkpoints/7/pretrained_model/config.json"], "best/pretrained_model"),
        (
            ["checkpoints/900/pretrained_model/config.json", "checkpoints/1000/pretrained_model/config.json"],
            "checkpoints/1000/pretrained_model",
        ),
        (["round_00/policy/checkpoints/7/pretrained_model/config.json"], None),
        (["best/pretrained_model/model.safetensors"], None),
    ],
)
def test_the_folder_of_a_runs_policy(paths: list[str], folder: str | None):
    assert policy_folder(paths) == folder


def test_copies_are_of_the_newest_checkpoint_and_are_left_out_again():
    scanned = copied(RUN)
    new = scanned.manifest.by_path.keys() - RUN.keys()
    assert new == {"config.json", "model.safetensors"}
    assert scanned.local["config.json"] == Path("checkpoints/001000/pretrained_model/config.json")
    assert without_root_copies(scanned.manifest) == manifest(RUN)


@pytest.mark.parametrize(
    "files",
    [
        *({**RUN, name: b"its own"} for name in ("config.json", "Model.safetensors", "config.json/notes.txt")),
        {"config.json": b"{}", "model.safetensors": b"weights"},  # a policy without a run
    ],
)
def test_a_run_that_has_files_of_such_names_at_its_root_is_left_alone(files: dict[str, bytes]):
    assert copied(files).manifest == manifest(files) == without_root_copies(manifest(files))


@pytest.mark.parametrize("changed", ["config.json", "model.safetensors"])
def test_root_copies_that_are_not_the_policy_any_more_come_along(changed: str):
    files = {**RUN, "config.json": b"{}", "model.safetensors": b"weights", changed: b"edited on the website"}
    assert without_root_copies(manifest(files)) == manifest(files)


def test_a_pushed_run_has_its_policy_at_the_root_whose_bytes_travel_once(hub: Hub, run: Path, tiny_policy: Path):
    do_push(run, POLICY)
    repo = hub.repo("models/user/policy")
    for path, data in content(tiny_policy).items():
        assert repo.files[path] == repo.files[f"best/pretrained_model/{path}"] == data
    large = {hashlib.sha256(path.read_bytes()).hexdigest() for path in tiny_policy.glob("*.safetensors")}
    sent = [one.path.rpartition("/")[2] for one in hub.requests("^PUT ")]
    assert sorted(sent) == sorted(large)


def test_a_run_comes_back_as_it_was_however_often_it_goes_there(hub: Hub, run: Path, tmp_path: Path):
    first = do_push(run, POLICY)
    do_pull(tmp_path / "back", POLICY)
    back = content(tmp_path / "back")
    card = back.pop(CARD)
    assert back == content(run)
    assert back.pop("round_00/policy/checkpoints/last") == "000200"
    again = do_push(tmp_path / "back", POLICY)
    assert (again.token, again.uploaded, again.removed) == (first.token, 0, 0)
    assert b"lerobot-eval --policy.path=user/policy" in card
    assert scan(tmp_path / "back", "policy").manifest.size == sum(
        len(data) for data in back.values() if isinstance(data, bytes)
    ) + len(card)


def test_a_better_policy_replaces_the_copy_at_the_root(hub: Hub, run: Path, tmp_path: Path):
    do_push(run, POLICY)
    better = run / "best" / "pretrained_model" / "config.json"
    better.write_bytes(better.read_bytes() + b"\n")
    assert do_push(run, POLICY).uploaded == 2  # where it lies, and at the root
    assert hub.repo("models/user/policy").files["config.json"] == better.read_bytes()
    do_pull(tmp_path / "back", POLICY)
    assert not (tmp_path / "back" / "config.json").exists()
