"""`manip-il data check`: one line a finding, a verdict, an exit code."""

import shutil
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.data import lerobot_layout as layout
from manip_il.data.build import build
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..damage import edit_json
from .made_runs import make_episode, run

ENV = make_config("panda", "reach", 20)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for seed in (1, 2):
        Journal(tmp_path / "d.journals", env_spec(ENV), env_fingerprint(ENV)).write(
            make_episode(env_spec(ENV), seed, 6)
        )
    build(tmp_path / "d.journals", tmp_path / "d")
    return tmp_path / "d"


def test_a_whole_dataset_exits_0_with_one_line(root, capsys):
    assert run(f"data check {root}") == 0
    assert capsys.readouterr().out == f"{root}: 2 episodes, 12 frames: whole; warnings: 0\n"


def test_an_error_exits_1_and_a_warning_0(root, capsys, monkeypatch):
    (root / layout.STATS).unlink()
    assert run(f"data check {root}") == 0
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == f"{root}: 2 episodes, 12 frames: whole; warnings: 1"
    )
    edit_json(root / layout.INFO, lambda info: info.update(total_tasks=3))
    for folder in (str(root), "."):  # the current folder is a name, too
        monkeypatch.chdir(root)
        assert main(["data", "check", folder]) == 1
        captured = capsys.readouterr()
        assert "error    meta/info.json: total_tasks: 3; expected 1\n" in captured.out
        remedy = f"try manip-il data repair {folder}"
        assert captured.err == f"manip-il: error: {folder}: errors: 1, warnings: 1; {remedy}\n"


def test_repair_exits_0_or_1_if_something_stays_wrong(root, capsys):
    edit_json(root / layout.INFO, lambda info: info.update(total_tasks=3))
    assert run(f"data repair {root}") == 0
    out = capsys.readouterr().out.splitlines()
    assert "repair   computed from the data: meta/info.json" in out
    assert out[-1] == f"{root}: 2 episodes, 12 frames: whole; warnings: 0"
    root.with_name("d.before-repair").rename(root.with_name("kept"))
    (root / layout.TASKS).unlink()
    assert run(f"data repair {root}") == 1
    assert "these cannot be repaired" in capsys.readouterr().err


def test_the_robots_joints_are_compared(root, capsys):
    edit_json(root / layout.OURS, lambda ours: ours["fingerprint"].update(model_sha256="0" * 64))
    assert run(f"data check {root}") == 0
    out = capsys.readouterr().out
    assert f"warning  meta/manip_il.json: model_sha256 differs: {root} has 000000000000" in out
    edit_json(root / layout.OURS, lambda ours: ours["spec"]["joint_names"].__setitem__(0, "elbow"))
    assert run(f"data check {root}") == 1
    assert "error    meta/manip_il.json: joint_names differs: " in capsys.readouterr().out


def test_two_datasets_become_one_with_the_episodes_of_both(root, capsys):
    other = shutil.copytree(root, root.with_name("other"))
    words = f"data merge {root} {other} --output={root.with_name('both')}".split()
    assert main(words) == 0
    assert Dataset.open(root.with_name("both")).info.episodes == 4
    assert main(words) == 2
    assert "already exists" in capsys.readouterr().err


def test_what_a_published_model_would_miss(root, capsys, tmp_path):
    edit_json(root / layout.STATS, lambda stats: stats["action"].pop("q99"))
    run(f"data check {root} --for=pi05")
    out = capsys.readouterr().out
    told = ("0 cameras", "action has no quantiles", "2 of the rarest task", "data annotate")
    assert not [text for text in told if text not in out]
    made = f"--task.type=reach --dataset.num_episodes=1 --dataset.root={tmp_path / 'fit'}"
    assert run(f"record --preset=pi05 {made} --image.width=64 --workers=1") == 0
    dataset = Dataset.open(tmp_path / "fit")
    assert (dataset.fps, dataset.spec.image_size) == (30, (224, 64))
    assert dataset.features["language_persistent"].dtype == "language"
    capsys.readouterr()
    assert run(f"data check {tmp_path / 'fit'} --for=smolvla") == 0
    lines = capsys.readouterr().out.splitlines()
    told = ("camera1, camera2", "224x64", "1 of the rarest task", "whole; warnings: 3")
    assert [text for text, line in zip(told, lines, strict=True) if text in line] == [*told]
