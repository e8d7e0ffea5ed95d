"""Shapes of objects as text, and what they weigh."""

import mujoco
import pytest

from manip_il.errors import UsageError
from manip_il.sim.shape import CUBE, LIGHTEST, ObjectShape
from manip_il.sim.world import World
from manip_il.tasks.table import get_task
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import make_config


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("box", (0.05, 0.05, 0.05)),
        ("box:0.03", (0.03, 0.03, 0.03)),
        ("any", (0.05, 0.05, 0.05)),
        ("any:0.03", (0.03, 0.03, 0.03)),
        ("box:0.06x0.03x0.02", (0.06, 0.03, 0.02)),
        ("cylinder:0.04", (0.04, 0.04, 0.04)),
        ("cylinder:0.04x0.08", (0.04, 0.04, 0.08)),
        ("sphere:0.06", (0.06, 0.06, 0.06)),
        ("capsule:0.04", (0.04, 0.04, 0.06)),
        ("capsule:0.03x0.1", (0.03, 0.03, 0.1)),
    ],
)
def test_a_text_means_lengths_along_the_shapes_own_axes(
    text: str, meant: tuple[float, float, float]
):
    assert ObjectShape.parse(text).lengths == pytest.approx(meant)
    assert ObjectShape.parse(str(ObjectShape.parse(text))) == ObjectShape.parse(text)


@pytest.mark.parametrize(
    "text", ["box:0.06x0.03x0.04", "cylinder:0.04x0.08", "sphere:0.06", "capsule:0.04x0.1"]
)
def test_the_model_has_the_lengths_and_the_mass(text: str):
    shape, scene = ObjectShape.parse(text), scene_of("panda", "pick_place", text)
    one = scene.objects["object"]
    assert World(scene).extents("object") == pytest.approx(shape.lengths)
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="solid").add_geom(
        type=scene.model.geom_type[one.geom], size=[*shape.size, 0, 0][:3], density=800
    )
    assert shape.mass == pytest.approx(spec.compile().body("solid").mass[0])
    assert scene.model.body_mass[one.body] == shape.mass >= LIGHTEST


def test_a_cube_of_5_cm_is_the_default():
    assert make_config(object="box:0.05") == make_config(object="box") == make_config()
    assert CUBE.mass == pytest.approx(0.1)


def test_what_is_wider_than_the_gripper_opens_is_refused_with_both_numbers():
    with pytest.raises(
        UsageError, match=r"'object' is 0.090 m wide, and the gripper of panda opens to 0.078 m"
    ):
        scene_of("panda", "pick_place", "sphere:0.09")
    # on its largest face, nothing narrower is left
    with pytest.raises(UsageError, match=r"0.080 m wide"):
        scene_of("panda", "lift", "box:0.08x0.1x0.02")


def test_a_task_with_objects_of_its_own_takes_no_other():
    with pytest.raises(UsageError, match=r"sphere:0[.]04, but the objects of stack are fixed"):
        make_config(task="stack", object="sphere:0.04")


def test_an_instruction_names_the_shape():
    assert (
        get_task("lift", "capsule:0.03").instruction
        == "Lift the capsule to the green goal above it."
    )
    assert get_task("lift", "any").instruction == "Lift the object to the green goal above it."
    assert get_task("lift", "box:0.03").instruction == get_task("lift").instruction
