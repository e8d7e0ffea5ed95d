"""The commands take a robot by the path of its YAML, in a folder."""

import json
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.data.dataset import Dataset

from ..robots.own import write
from .made_runs import run

REACH = ("--task.type=reach", "--workers=1")
SHORT = (
    "--demonstrations=2",
    "--episodes_per_round=1",
    "--rounds=1",
    "--validation_episodes=1",
    "--steps=2",
)


@pytest.mark.slow
@pytest.mark.gl
def test_it_is_recorded_learnt_evaluated_improved_and_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "arms").mkdir()
    write(tmp_path / "arms", "mine")
    monkeypatch.chdir(tmp_path)
    robot = "--robot.type=arms/mine.yaml"
    assert main(["record", robot, "--task.object=box:0.12", "--dataset.root=wide"]) == 2
    assert "the gripper of mine opens to" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == ["arms"]
    assert main(["record", robot, *REACH, "--dataset.num_episodes=2"]) == 0
    assert Dataset.open(Path("datasets/mine_reach")).spec.robot == "mine"
    assert run("train --dataset.root=datasets/mine_reach --steps=2 --output_dir=run") == 0
    assert "warning" not in capsys.readouterr().err
    words = [
        "eval",
        robot,
        *REACH,
        *["--policy.path=run", "--eval.n_episodes=1", "--eval.films=0", "--output_dir=test"],
    ]
    assert main(words) == 0
    assert json.loads(Path("test/eval.json").read_text())["robot"] == "mine"
    assert main(["dagger", robot, *REACH, *SHORT, "--output_dir=dagger"]) == 0
    assert (tmp_path / "dagger" / "best").is_dir()
    render = ["data", "render", "datasets/mine_reach", "seen", "--cameras=front"]
    assert main(render) == 2
    assert "unknown robot 'mine'" in capsys.readouterr().err
    assert main([*render, "--robot.type=panda"]) == 1
    assert "robot differs" in capsys.readouterr().err
    assert main([*render, robot]) == 0
    assert Dataset.open(Path("seen")).spec.cameras == ("front",)
