"""Objects that are meshes: read from a file, grasped on any side that they rest on, named in
data without a path.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from manip_il import Expert
from manip_il.cli.main import main
from manip_il.collect.edits import open_source
from manip_il.collect.job import RolloutJob
from manip_il.errors import ManipError, UsageError
from manip_il.sim.rests import LEAST_ROOM
from manip_il.sim.shape import DENSITY, LIGHTEST, ObjectShape
from manip_il.sim.world import World
from manip_il.tasks.grasp import lie_of
from manip_il.worlds.ladder.world import make_env, scene_of
from manip_il.worlds.table import env_fingerprint, env_spec, make_config, stored_config
from tests.meshes import MESHES, write_mesh

OBJECT = "object"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    for name in MESHES:
        write_mesh(name, folder)
    return folder


def text(folder: Path, name: str) -> str:
    return f"mesh:{folder / name}.obj"


@pytest.mark.parametrize(
    ("name", "robot"), [*((name, "panda") for name in MESHES), ("mug", "so101"), ("angle", "so101")]
)
def test_the_expert_brings_it_to_its_goal(name, robot, folder):
    episodes = RolloutJob(make_config(robot, object=text(folder, name)), hold=0).run(
        range(3_000_000, 3_000_003)
    )
    assert all(episode.success for episode in episodes)


@pytest.mark.parametrize("task", ["lift", "carry"])
def test_other_tasks_take_it_too(task, folder):
    config = make_config("panda", task, object=text(folder, "mug"))
    episodes = RolloutJob(config, hold=0).run(range(3_000_000, 3_000_003))
    assert sum(episode.success for episode in episodes) >= 2


@pytest.mark.parametrize("ending", [".stl", ".obj", ".ascii.stl"])
def test_every_kind_of_file_is_the_same_solid(ending, tmp_path):
    path, solid = tmp_path / f"angle{ending}", MESHES["angle"]()
    solid.export(path, file_type="stl_ascii" if "ascii" in ending else None)
    shape = ObjectShape.parse(Path(f"mesh:{path}:0.05"))
    assert max(shape.lengths) == pytest.approx(0.05)
    assert shape.mass == pytest.approx(
        max(LIGHTEST, DENSITY * solid.volume * (0.05 / 0.07) ** 3), rel=1e-5
    )
    np.testing.assert_allclose(
        shape.mesh.vertices.min(axis=0), np.array((-0.0275, -0.0225, -0.0125)) / 1.4, atol=1e-6
    )


def test_the_model_has_its_mass_its_centre_of_mass_and_its_picture(folder):
    bottle = Path(text(folder, "bottle"))
    shape, scene = ObjectShape.parse(bottle), scene_of("panda", "pick_place", bottle)
    one, model = scene.objects[OBJECT], scene.model
    assert (
        model.body_mass[one.body]
        == pytest.approx(shape.mass)
        == pytest.approx(DENSITY * MESHES["bottle"]().volume)
    )
    np.testing.assert_allclose(model.body_ipos[one.body], 0, atol=1e-5)
    assert model.mesh_facenum[model.geom_dataid[one.geom]] == len(MESHES["bottle"]().faces)


def settled(world: World, quaternion: np.ndarray, seconds: float = 1.5) -> None:
    """Drop the object from 10 cm in an attitude, and wait."""
    world.place(OBJECT, np.array([0.45, 0.0, 0.1]), quaternion / np.linalg.norm(quaternion))
    world.update()
    for _ in range(round(seconds / world.model.opt.timestep)):
        mujoco.mj_step(world.model, world.data)
    world.update()


@pytest.mark.parametrize("name", [name for name in MESHES if name != "plate"])
def test_however_it_falls_it_rests_on_a_known_side_with_grasps(name, folder):
    env, rng = make_env("panda", object=text(folder, name)), np.random.default_rng(1)
    expert, world = Expert(env.scene), env.world
    for _ in range(4):
        env.reset(seed=0)
        settled(world, rng.normal(size=4))
        lie = lie_of(world, OBJECT)
        assert lie.tilt < 0.3 or not world.at_rest(OBJECT)  # or it still rocks
        assert lie.fits
        assert all(width <= world.gripper.most - LEAST_ROOM for _, width, _, _ in lie.grasps)
        assert expert.label(env.get_state()).valid


def test_a_side_that_is_too_wide_has_no_label_and_says_why(tmp_path):
    trimesh.creation.box((0.1, 0.03, 0.09)).export(tmp_path / "board.stl")
    env = make_env("panda", object=f"mesh:{tmp_path / 'board.stl'}")
    expert = Expert(env.scene)
    env.reset(seed=0)
    assert expert.label(env.get_state()).valid
    settled(env.world, np.array([1.0, 1.0, 0.0, 0.0]))
    label = expert.label(env.get_state())
    assert not label.valid
    assert "too low or too wide for the gripper" in label.reason


def test_data_have_its_name_and_hash_and_no_path(folder, tmp_path):
    config = make_config("panda", object=f"{text(folder, 'mug')}:0.06")
    before, spec = env_fingerprint(config), env_spec(config)
    assert spec.object.startswith("mesh:mug.obj#")
    assert spec.object.endswith(":0.06")
    assert str(folder) not in f"{spec} {before}"
    moved = tmp_path / "mug.obj"
    moved.write_bytes((folder / "mug.obj").read_bytes())
    assert env_fingerprint(make_config("panda", object=f"mesh:{moved}:0.06")) == before
    with pytest.raises(
        UsageError,
        match=r"name of the mesh was stored; give --task\.object=mesh:PATH/mug\.obj:0\.06",
    ):
        stored_config(spec)


def test_a_dataset_and_an_evaluation_of_it_are_used_with_its_file(
    folder, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    mesh, few = (
        text(folder, "bowl"),
        ["--workers=1", "--eval.n_episodes=2", "--eval.films=0", "--output_dir=e"],
    )
    words = ["--dataset.num_episodes=2", "--dataset.root=data", "--workers=1"]
    assert main(["record", f"--task.object={mesh}", *words]) == 0
    assert main(["data", "check", "data"]) == 0
    with pytest.raises(ManipError, match=r"give --task\.object=mesh:PATH/bowl\.obj"):
        open_source(tmp_path / "data")
    assert main(["data", "relabel", "data", f"--task.object={mesh}", "--workers=1"]) == 0
    other = f"--task.object={text(folder, 'mug')}"
    assert main(["data", "relabel", "data", other, "--workers=1", "--overwrite=true"]) == 1
    capsys.readouterr()
    assert main(["eval", "--policy.type=expert", f"--task.object={mesh}", *few]) == 0
    assert f"--task.object={mesh} --replay=" in capsys.readouterr().out
    assert main(["eval", "e", "--replay=4000000"]) in (1, 2)
    assert "--task.object=mesh:PATH/bowl.obj" in capsys.readouterr().err
    assert main(["eval", "e", "--replay=4000000", f"--task.object={mesh}"]) == 0


def open_box(path: Path) -> None:
    solid = trimesh.creation.box((0.05, 0.05, 0.05))
    solid.update_faces(np.arange(len(solid.faces)) > 1)
    solid.export(path)


MISTAKES = {
    "is not closed": (open_box, "own.obj", "own.obj is not closed"),
    "is too wide": (
        trimesh.creation.box((0.1, 0.09, 0.08)).export,
        "own.stl",
        "m wide, and the gripper of panda opens",
    ),
    "is too low as it rests": (
        trimesh.creation.box((0.06, 0.05, 0.008)).export,
        "own.stl",
        "rests 0.008 m high (0.012 m is the least",
    ),
    "has no triangles": (
        lambda path: path.write_text("o nothing\n"),
        "own.obj",
        "own.obj is empty",
    ),
    "is in millimetres": (
        trimesh.creation.box((50, 40, 30)).export,
        "own.stl",
        "is 50 m long; expected 0.02 to 0.2 m",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mesh_that_cannot_be_used_is_one_line(case, tmp_path, monkeypatch, capsys):
    write, name, says = MISTAKES[case]
    monkeypatch.chdir(tmp_path)
    write(tmp_path / name)
    assert main(["record", f"--task.object=mesh:{tmp_path / name}"]) == 2
    error = capsys.readouterr().err
    assert (error.count("\n"), says in error) == (1, True), error
