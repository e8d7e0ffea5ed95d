"""Any LeRobot checkpoint is measured by one command, and a bad one is refused in one line before
the first step.
"""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.data.schema import STATE
from manip_il.evaluation.results import EvalResult
from manip_il.learn.checkpoint import META_FILE, Origin
from manip_il.sim.config import CameraConfig, Look
from manip_il.sim.env import ManipEnv
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..damage import edit_json
from ..learn.tiny_policies import edit_config, write_checkpoint
from .made_runs import make_policy

ENV = make_config("panda", "reach", horizon=8)
DIM = CameraConfig(("front",), 32, 32, Look(brightness=0.5))


def evaluate(policy: Path, folder: Path, *words: str) -> int:
    sizes = ["--eval.n_episodes=2", "--env.horizon=8", "--workers=1", "--eval.films=0"]
    return main(["eval", f"--policy.path={policy}", *sizes, f"--output_dir={folder}", *words])


@pytest.fixture
def act(tmp_path) -> Path:
    return make_policy(tmp_path / "policy", ENV)


@pytest.fixture
def seeing(tmp_path) -> Path:
    """A policy of the front camera in dim light."""
    spec = env_spec(ENV, DIM)
    meta = Origin.of(spec, env_fingerprint(ENV, DIM), observation="images", look=asdict(DIM.look))
    return write_checkpoint(tmp_path / "policy", "act", spec, "images", origin=meta)


@pytest.mark.gl
def test_a_policy_of_pictures_is_shown_them_in_its_own_light(seeing, tmp_path, capsys):
    assert evaluate(seeing, tmp_path / "e") == 0
    assert "warning" not in capsys.readouterr().err
    assert EvalResult.read(tmp_path / "e").fingerprint == env_fingerprint(ENV, DIM)


@pytest.mark.gl
def test_pictures_in_another_light_than_the_checkpoints_are_warned_of(seeing, tmp_path, capsys):
    edit_json(seeing / META_FILE, lambda meta: meta.update(look=None))
    assert evaluate(seeing, tmp_path / "e") == 0
    [line] = [
        line for line in capsys.readouterr().err.splitlines() if "cameras_sha256 differs" in line
    ]
    for fingerprint in (env_fingerprint(ENV, DIM), env_fingerprint(ENV, replace(DIM, look=Look()))):
        assert fingerprint["cameras_sha256"][:12] in line
    (seeing / META_FILE).unlink()
    assert (
        evaluate(
            seeing, tmp_path / "e", "--robot.type=panda", "--task.type=reach", "--overwrite=true"
        )
        == 0
    )
    assert "does not say which robot and task it is for" in capsys.readouterr().err


@pytest.mark.usefixtures("no_opengl")
def test_without_opengl_a_policy_of_pictures_is_refused_in_one_line(seeing, tmp_path, error):
    assert evaluate(seeing, tmp_path / "e") == 1
    assert "no OpenGL here" in error()


def feature(kind: str, *shape: int) -> dict[str, object]:
    return {"type": kind, "shape": list(shape)}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {
                "input_features": {
                    STATE: feature("STATE", 8),
                    "observation.images.belly": feature("VISUAL", 3, 32, 32),
                }
            },
            "unknown camera 'belly'; known: front, side, wrist",
        ),
        (
            {"output_features": {"action": feature("ACTION", 7)}},
            "the policy has 7, panda/reach has 8",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bad_checkpoint_is_one_line_before_the_first_step(
    change, words, act, tmp_path, monkeypatch, error
):
    monkeypatch.setattr(ManipEnv, "advance", None)
    edit_config(act, **change)
    assert evaluate(act, tmp_path / "e") in (1, 2)
    assert words in error()
    assert not (tmp_path / "e").exists()
