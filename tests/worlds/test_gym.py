"""A world of one's own: what its class gives works, and what it does not give is said in one line."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import manip_il
from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.rounds import round_scenes
from manip_il.cli.main import main
from manip_il.collect.edits import EditTarget, open_source, relabel_dataset
from manip_il.collect.job import RolloutJob
from manip_il.collect.ray_pool import run_there
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.gym.environment import GymEnv
from manip_il.worlds.table import env_spec, make_config, make_env, make_expert

PAGE = Path(__file__).parents[2] / "docs" / "new-env.md"
REACHER = PAGE.read_text().split("```python\n")[1].split("```", 1)[0]
# a point on a line, which no simulator restores; its expert goes to the middle
POINT = """
import gymnasium
import numpy as np
import manip_il

class Line(gymnasium.Env):
    metadata = {"render_fps": 10}
    observation_space = gymnasium.spaces.Box(-9, 9, (1,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(-3, 3, 1)
        return self.at, {}
    def step(self, action):
        self.at = self.at + action
        return self.at, 0.0, bool(abs(self.at) > 8), False, {"success": abs(self.at[0]) < 0.5}

class Point(manip_il.GymWorld):
    horizon = 20
    def make(self):
        return Line()
    def act(self, env, seen):
        return np.clip(-seen, -1, 1)
"""
STATE = """
    def state(self, env):
        return env.at
    def restore(self, env, state):
        env.at = state.copy()
"""
RECURRENT = """
    recurrent = True
    def reset(self, env, seed):
        self.asked = 0
        return super().reset(env, seed)
    def act(self, env, seen):
        self.asked += 1
        return np.clip(-seen, -1, 1) / self.asked
"""


def config(folder: Path, text: str, name: str = "own.py") -> EnvConfig:
    path = folder / name
    path.write_text(text)
    return make_config(str(path))


@pytest.mark.parametrize("text", [REACHER, POINT, POINT + STATE, POINT + RECURRENT])
def test_the_contract_is_checked_and_kept(tmp_path, text, capsys):
    config(tmp_path, text)
    assert main(["env", "check", str(tmp_path / "own.py"), "--episodes=20", "--quiet"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert all(line.startswith("ok ") for line in said)
    assert [line[4:].partition(":")[0] for line in said] == [
        "starts",
        "states",
        "labels",
        "expert",
        "time",
    ]


def test_a_world_is_recorded_learnt_and_measured(tmp_path):
    env = config(tmp_path, REACHER)
    dataset = manip_il.record(tmp_path / "demos", env, 10, workers=1)
    spec = manip_il.Dataset.open(tmp_path / "demos").spec
    assert (spec.robot, spec.action_meaning, spec.fps) == (
        "reacher",
        "action of the environment",
        50,
    )
    assert (len(spec.observed_names), len(spec.joint_names)) == (6, 2)
    assert dataset
    manip_il.train(tmp_path / "demos", tmp_path / "fit", policy={"width": 64}, steps=300)
    found = manip_il.evaluate(tmp_path / "fit", env, 10)
    assert len(found.episodes) == 10


def test_stored_states_get_the_labels_that_they_had(tmp_path):
    env = config(tmp_path, REACHER)
    manip_il.record(tmp_path / "demos", env, 3, workers=1)
    with pytest.raises(
        UsageError, match=r"unknown robot 'reacher'.*the path of a YAML or of a world"
    ):
        open_source(tmp_path / "demos")
    source = open_source(tmp_path / "demos", robot=env.robot)
    relabel_dataset(source, EditTarget(tmp_path / "again", 1))
    demos, again = (
        Dataset.open(tmp_path / name).columns(["action"]) for name in ("demos", "again")
    )
    np.testing.assert_allclose(again["action"], demos["action"], rtol=0, atol=1e-3)


def test_states_that_cannot_be_restored_are_recorded_but_not_labelled_again(tmp_path):
    env = config(tmp_path, POINT)
    manip_il.record(tmp_path / "demos", env, 3, workers=1)
    with pytest.raises(UsageError, match=r"^point cannot be restored; record again"):
        open_source(tmp_path / "demos", robot=env.robot)
    assert env_spec(config(tmp_path, POINT + STATE, "other.py")).can == ("restored",)


def test_an_expert_with_memory_is_asked_once_in_every_step(tmp_path):
    env = config(tmp_path, POINT + RECURRENT)
    manip_il.record(tmp_path / "demos", env, 3, workers=1)
    info = json.loads((tmp_path / "demos" / "meta" / "manip_il.json").read_text())
    assert info["spec"]["expert"] == "recurrent"
    one = make_env(env)
    one.start(0)
    labels = [one.label(), one.label()] if isinstance(one, GymEnv) else []
    assert labels[0] is labels[1]
    with pytest.raises(UsageError, match="keeps memory"):
        make_expert(env).label(one.get_state())


def test_a_ray_node_gets_the_file(tmp_path):
    env = config(tmp_path, POINT)
    away = RolloutJob(replace(env, robot=Path("elsewhere/own.py")))
    files = {"own.py": POINT.encode()}
    assert run_there(manip_il.__version__, away, (5,), None, files, None, None)


def test_the_environment_ends_an_episode(tmp_path):
    env = make_env(config(tmp_path, POINT))
    env.start(1)
    ended = [env.step(np.array([1.0])).ended for _ in range(15)]
    assert ended.index(True) > 3
    assert not any(ended[: ended.index(True)])


def test_pictures_are_of_the_state_alone(tmp_path):
    cameras = CameraConfig(("render",), 32, 48)
    env, other = (make_env(config(tmp_path, REACHER), cameras) for _ in range(2))
    env.start(3)
    for _ in range(5):
        env.step(env.actions.high)
    other.start(4)
    other.set_state(env.get_state())
    one, two = (each.observe().images["render"] for each in (env, other))
    assert one.shape == (32, 48, 3)
    assert np.array_equal(one, two)
    other.start(4)
    assert not np.array_equal(one, other.observe().images["render"])


def test_dagger_from_pictures_draws_the_states_as_visited(tmp_path):
    env, cameras = config(tmp_path, REACHER), CameraConfig(("render",), 32, 48)
    manip_il.record(tmp_path / "demos", env, 1, workers=1)
    run = RunConfig(env, fit=FitConfig(policy={"type": "cnn"}), cameras=cameras, redraw=12)
    assert not round_scenes(run, [tmp_path / "demos"]).anew


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("def make", "def made"), r"own\.py: class Point has no `make`"),
        (("Box(-1, 1, (1,))", "Discrete(2)"), r"\(make\): actions are Discrete\(2\); expected"),
        (("    horizon = 20\n", ""), r"^point has no horizon; give its class one, in .*own\.py$"),
        (
            ("np.clip(-seen, -1, 1)", "np.zeros(3)"),
            r"own\.py, line 22 \(act\): .*expected 1 finite numbers$",
        ),
        (("np.clip(-seen, -1, 1)", "1 / 0"), r"own\.py, line 23 \(act\): ZeroDivisionError"),
        (("import numpy", "import numpyy"), r"own\.py, line 3 \(<module>\): ModuleNotFoundError"),
        (
            ("return Line()", "return None"),
            r"own\.py, line 20 \(make\): returned None; expected a gym",
        ),
        (
            ("return self.at, {}", "return 'x', {}"),
            r"own\.py \(Point has no observe\): agent_pos is 'x'; expected finite numbers$",
        ),
        (("def act", "def _act"), r"own\.py: class Point has no `act`"),
        (("class Point", "class _Point"), r"own\.py: none; expected one subclass of manip_il\.Gym"),
        (("    horizon", "    names = {'action': ('a', 'b')}\n    horizon"), r"are 2; expected 1$"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, change, said, capsys):
    (tmp_path / "own.py").write_text(POINT.replace(*change))
    assert main(["env", "check", str(tmp_path / "own.py"), "--episodes=1", "--quiet"]) != 0
    [line] = capsys.readouterr().err.splitlines()
    assert re.search(said, line.removeprefix("manip-il: error: ")), line


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (POINT.replace("self.np_random", "np.random.default_rng()"), "starts, labels"),
        (POINT + STATE.replace("return env.at", "return env.at + 1"), "states"),
        (
            POINT.replace("np.clip(-seen, -1, 1)", "np.random.default_rng().uniform(-1, 1, 1)"),
            "labels",
        ),
    ],
)
def test_what_breaks_the_contract_is_found(tmp_path, text, what, capsys):
    (tmp_path / "own.py").write_text(text)
    assert main(["env", "check", str(tmp_path / "own.py"), "--episodes=0", "--quiet"]) == 1
    captured = capsys.readouterr()
    assert captured.err.endswith(f"does not keep the contract: {what}\n")
    assert any(
        line.startswith(f"NOT {what.partition(',')[0]}: ") for line in captured.out.splitlines()
    )


def test_an_expert_that_raises_in_a_worker_is_told_by_file_and_line(tmp_path, capsys):
    text = POINT.replace("return np.clip", "return [][0] if seen > 0 else np.clip")
    (tmp_path / "own.py").write_text(text)
    demos = f"--dataset.root={tmp_path / 'demos'}"
    given = [f"--env.type={tmp_path / 'own.py'}", demos, "--workers=2", "--quiet"]
    assert main(["record", *given]) == 1
    [line] = capsys.readouterr().err.splitlines()
    assert re.search(r"own\.py, line 23 \(act\): IndexError.*--resume=true$", line)


def test_worlds_are_not_varied(tmp_path, capsys):
    (tmp_path / "own.py").write_text(POINT)
    assert main(["record", f"--env.type={tmp_path / 'own.py'}", "--vary=dynamics"]) == 2
    assert "point cannot be varied; leave out --vary" in capsys.readouterr().err


def test_in_python_a_world_is_made_by_its_file(tmp_path):
    (tmp_path / "own.py").write_text(POINT)
    env = cast("Any", manip_il.make_env(str(tmp_path / "own.py"), horizon=5))
    env.start(1)
    assert not env.step(env.label().action).ended
    assert env.spec.horizon == 5


def test_what_is_drawn_when_an_environment_is_made_does_not_matter(tmp_path, capsys):
    """Such as a place that every start replaces."""
    made = "    def make(self):\n        env = gymnasium.make"
    text = REACHER.replace("    def make(self):\n        return gymnasium.make", made)
    first = "\n        env.unwrapped.first = np.random.rand()\n        return env\n"
    text = text.replace('"rgb_array")\n', f'"rgb_array"){first}', 1)
    (tmp_path / "own.py").write_text(text)
    assert main(["env", "check", str(tmp_path / "own.py"), "--episodes=0", "--quiet"]) == 0
    assert "NOT" not in capsys.readouterr().out


def test_a_world_without_a_task_of_that_name_lists_its_own():
    with pytest.raises(ManipError, match=r"unknown task of metaworld 'push-v2'.*push-v3"):
        make_config("metaworld", "push-v2")
