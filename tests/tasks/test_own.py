"""A task from a file: it runs in every command that names its path, and never because data name
it.
"""

import pickle
import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import zstandard

import manip_il
from manip_il.cli.main import main
from manip_il.collect.edits import open_source
from manip_il.collect.job import RolloutJob
from manip_il.collect.ray_pool import run_there
from manip_il.errors import UnknownName, UsageError
from manip_il.robots import ROBOTS
from manip_il.sim.render import point_names
from manip_il.tasks import table
from manip_il.tasks.table import get_task
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..meshes import write_mesh

PAGE = Path(__file__).parents[2] / "docs" / "new-task.md"
TOUCH, RAISE = (block.split("```", 1)[0] for block in PAGE.read_text().split("```python\n")[1:])


@pytest.fixture
def touch(tmp_path) -> Path:
    path = tmp_path / "touch.py"
    path.write_text(TOUCH)
    return path


@pytest.mark.parametrize("robot", ["panda", "so101"])
@pytest.mark.parametrize("example", [TOUCH, RAISE])
def test_the_expert_solves_a_task_from_a_file(robot, example, tmp_path):
    (tmp_path / "own.py").write_text(example)
    episodes = RolloutJob(make_config(robot, str(tmp_path / "own.py")), hold=0).run(range(5))
    assert all(episode.success for episode in episodes)


FITTED = """
    tall = 0.1

    def fitted(self, robot):
        small = Touch()
        small.tall = 0.02
        return small
"""


def test_a_task_that_fits_itself_to_the_arm_is_that_task_throughout(tmp_path):
    (tmp_path / "own.py").write_text(TOUCH + FITTED)
    env = manip_il.make_env("panda", str(tmp_path / "own.py"))
    assert env.scene.task.tall == env._task.tall == 0.02


CYLINDER = """
from dataclasses import dataclass
from manip_il.task import ObjectShape, PickPlace

@dataclass(frozen=True)
class Tin(PickPlace):
    name: str = "tin"
    shape: ObjectShape = ObjectShape.parse("cylinder:0.04x0.06")
"""


def test_an_own_object_is_replaced_by_the_one_that_is_asked_for(tmp_path):
    (tmp_path / "own.py").write_text(CYLINDER)
    asked = {
        name: make_config("panda", str(tmp_path / "own.py"), object=name)
        for name in ("", "box:0.05", "sphere")
    }
    assert [one.object for one in asked.values()] == ["", "box:0.05", "sphere:0.05"]
    assert make_config("panda", str(tmp_path / "own.py"), object="cylinder:0.04x0.06") == asked[""]


def test_a_node_gets_the_files_of_task_and_mesh(tmp_path):
    (tmp_path / "own.py").write_text(CYLINDER)
    mesh = write_mesh("wedge", tmp_path)
    own = make_config("panda", str(tmp_path / "own.py"), object=f"mesh:{mesh}")
    tasks, meshes = ({path.name: path.read_bytes()} for path in (tmp_path / "own.py", mesh))
    job = RolloutJob(own, hold=0)
    [here] = list(job.run([5]))
    mesh.unlink()
    away = replace(job, env=replace(own, object=Path(f"mesh:{tmp_path / 'away' / mesh.name}")))
    answer = run_there(manip_il.__version__, away, (5,), None, None, tasks, meshes)
    [(there, _)] = pickle.loads(zstandard.decompress(answer))
    for name, column in here.without_pictures().columns.items():
        np.testing.assert_array_equal(there.columns[name], column)


def test_files_that_were_edited_since_they_were_read_are_refused(tmp_path, touch):
    arm = tmp_path / "arm.yaml"
    arm.write_bytes(ROBOTS["so101"].read_bytes())
    make_config(str(arm), str(touch))
    for file in (arm, touch):
        before = file.read_bytes()
        file.write_bytes(before + b"\n# edited\n")
        with pytest.raises(UsageError, match=f"{file.name} was edited"):
            make_config(str(arm), str(touch))
        file.write_bytes(before)


def test_a_number_is_no_point_of_the_scene(tmp_path):
    (tmp_path / "own.py").write_text(TOUCH.replace('"cube": cube,', '"cube": cube[2],'))
    assert "cube" not in point_names(scene_of("panda", tmp_path / "own.py"))


def test_gymnasium_and_python_take_the_path(touch):
    by_id = gymnasium.make("manip_il/Task-v0", task=str(touch)).unwrapped
    by_name = manip_il.make_env("panda", str(touch))
    observations = [env.reset(seed=3)[0]["environment_state"] for env in (by_id, by_name)]
    np.testing.assert_array_equal(*observations)
    assert by_name.task_description == "Touch the top of the cube."


def test_what_is_written_of_it_has_its_name_and_hash_and_no_path(touch):
    config = make_config("panda", str(touch))
    before = env_fingerprint(config)
    assert env_spec(config).task == "touch"
    assert str(touch.parent) not in f"{env_spec(config)} {before}"
    other = touch.parent / "more" / "touch.py"
    other.parent.mkdir()
    other.write_text(TOUCH)
    assert env_fingerprint(make_config("panda", str(other))) == before
    changed = touch.parent / "changed" / "touch.py"
    changed.parent.mkdir()
    changed.write_text(f"{TOUCH}\n# more\n")
    differing = {
        key
        for key, value in env_fingerprint(make_config("panda", str(changed))).items()
        if value != before[key]
    }
    assert differing == {"task_sha256"}


def test_data_and_results_name_a_task_and_run_nothing(touch, tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.chdir(tmp_path)
    words = ["--dataset.num_episodes=2", "--dataset.root=data", "--workers=1"]
    assert main(["record", f"--task.type={touch}", *words]) == 0
    assert main(["data", "check", "data"]) == 0
    with pytest.raises(UnknownName, match=r"unknown task 'touch'.*the path of a Python file"):
        open_source(tmp_path / "data")
    caplog.clear()
    open_source(tmp_path / "data", task=touch)
    assert caplog.messages == []
    assert main(["eval", "--policy.type=expert", f"--task.type={touch}", "--eval.n_episodes=2", "--eval.films=0",
                 "--output_dir=e", "--workers=1"]) == 0  # fmt: skip
    capsys.readouterr()
    assert main(["eval", "e", "--replay=4000000"]) in (1, 2)
    assert "unknown task 'touch'" in capsys.readouterr().err
    assert main(["eval", "e", "--replay=4000000", f"--task.type={touch}"]) == 0


def test_a_policy_of_it_is_evaluated_by_its_path_without_a_warning(
    touch, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    words = [
        "--demonstrations=2",
        "--rounds=1",
        "--episodes_per_round=2",
        "--steps=20",
        "--policy.width=16",
        "--validation_episodes=2",
        "--env.horizon=40",
        "--workers=1",
        "--output_dir=run",
    ]
    assert main(["dagger", f"--task.type={touch}", *words]) == 0
    capsys.readouterr()
    last = [
        "--policy.path=run/best",
        "--eval.n_episodes=2",
        "--eval.films=0",
        "--workers=1",
        "--output_dir=e",
    ]
    assert main(["eval", *last]) == 2
    error = capsys.readouterr().err
    assert (error.count("\n"), "unknown task 'touch'" in error) == (1, True), error
    assert main(["eval", f"--task.type={touch}", "--env.horizon=40", *last]) == 0
    assert "differs" not in capsys.readouterr().err


MISTAKES = {
    "is not Python": ("def (", "cannot be run: SyntaxError"),
    "lacks a function": (
        TOUCH.replace("def observe(", "def observed("),
        "without an implementation for abstract method 'observe'",
    ),
    "another object": (
        TOUCH.replace('objects = ("cube",)', 'objects = ("cubes",)'),
        "unknown object of task touch 'cubes'",
    ),
    "one name": (
        TOUCH.replace("    def draw(", '    grasped = "cube"\n\n    def draw('),
        "unknown object of task touch 'c'",
    ),
    "observes two": (
        TOUCH.replace('"cube": cube,', '"cube": cube[:2],'),
        "cube has shape (2,); expected a number or (3,)",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_file_that_holds_no_task_is_one_line(case, tmp_path, capsys):
    content, says = MISTAKES[case]
    path = tmp_path / "own.py"
    path.write_text(content)
    words = [f"--task.type={path}", f"--output_dir={tmp_path / 'e'}"]
    assert main(["eval", "--policy.type=expert", *words]) == 2
    error = capsys.readouterr().err
    assert (error.count("\n"), says in error) == (1, True), error


@pytest.mark.parametrize("workers", [1, 2])
def test_a_bug_in_a_task_names_its_file_line_and_function(workers, tmp_path, capsys):
    path = tmp_path / "own.py"
    path.write_text(
        TOUCH.replace(
            "return math.dist(world.ee.position[:2]", "return math.dits(world.ee.position[:2]"
        )
    )
    words = [
        "--policy.type=expert",
        f"--task.type={path}",
        f"--output_dir={tmp_path / 'e'}",
        f"--workers={workers}",
    ]
    assert main(["eval", *words]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.search(
        r"own\.py, line \d+ \(beside\): AttributeError: module 'math' has no attribute 'dits'",
        error,
    )


def test_a_package_brings_names(touch, monkeypatch):
    cls = type(get_task(touch))

    class Entry:
        name, value = "touch", "my_lab.touch:Touch"

        def load(self) -> type:
            return cls

    monkeypatch.setattr(
        table, "entry_points", lambda group, name: [Entry()] if name == "touch" else []
    )
    table._named.cache_clear()
    assert get_task("touch").instruction == "Touch the top of the cube."
    with pytest.raises(UnknownName, match="the path of a Python file"):
        get_task("tuch")
    with pytest.raises(UsageError, match="does not exist"):
        get_task(Path("tuch.py"))
