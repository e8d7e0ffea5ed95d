"""Where a model's files are found."""

from pathlib import Path
from typing import Any

import pytest

from manip_il.robots.robot import Robot, _warn
from manip_il.robots.spec import arm_spec
from manip_il.robots.table import get_robot

from .own import model_of, tree_of, write

MODEL = model_of()


def shaped(folder: Path, file: str, mesh: str, **more: Any) -> Robot:
    """An arm in a folder whose base has a mesh, `file` on the disk, `mesh` in the model."""
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    corners = ["v 0 0 0", "v .1 0 0", "v 0 .1 0", "v 0 0 .1"]
    triangles = ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
    (folder / file).write_text("\n".join([*corners, *triangles]))
    model = MODEL.replace("</asset>", f'<mesh name="foot" file="{mesh}"/></asset>')
    model = model.replace(
        '<body name="base">', '<body name="base"><geom type="mesh" mesh="foot" contype="0"/>'
    )
    for old, new in more.pop("text", {}).items():
        assert old in model
        model = model.replace(old, new)
    return get_robot(write(folder, tree=tree_of() | more, model=model))


PLACES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "beside the model": ("foot.obj", "foot.obj", {}),
    "in the model's folder of meshes": (
        "parts/foot.obj",
        "foot.obj",
        {"mend": {'angle="radian"': 'angle="radian" meshdir="parts"'}},
    ),
    "in the YAML's folder of meshes": ("parts/sub/foot.obj", "sub/foot.obj", {"meshes": "parts"}),
}


@pytest.mark.parametrize("place", PLACES)
def test_a_mesh_is_found_as_mujoco_finds_it(place: str, tmp_path: Path):
    file, mesh, said = PLACES[place]
    assert arm_spec(shaped(tmp_path, file, mesh, **said)).compile().nmeshvert == 4


def test_what_a_model_includes_is_found_where_the_yaml_says_and_what_lies_beside_it_does_not_matter(
    tmp_path: Path,
):
    parts = tmp_path / "parts"
    parts.mkdir()
    (parts / "look.xml").write_text(
        '<mujoco><asset><mesh name="foot" file="foot.obj"/></asset></mujoco>'
    )
    (parts / "LOOK.xml").write_text("what has the same name but for capitals")
    include = {'<mesh name="foot" file="foot.obj"/></asset>': '</asset><include file="look.xml"/>'}
    robot = shaped(tmp_path, "parts/foot.obj", "foot.obj", includes="parts", text=include)
    assert arm_spec(robot).compile().nmeshvert == 4
    (parts / "foot.obj").rename(tmp_path / "foot.obj")
    again = write(
        tmp_path,
        "again",
        tree=tree_of() | {"includes": "parts", "meshes": "."},
        model=(tmp_path / "own.xml").read_text(),
    )
    assert arm_spec(get_robot(again)).compile().nmeshvert == 4


def with_shoe(folder: Path) -> Robot:
    """An arm whose model attaches another, with a mesh and with physics options of its own."""
    foot = '<asset><mesh name="foot" file="foot.obj"/></asset>'
    body = (
        '<worldbody><body name="shoe"><geom type="mesh" mesh="foot"'
        ' contype="0"/></body></worldbody>'
    )
    (folder / "shoe.xml").write_text(
        f'<mujoco model="shoe"><option timestep="0.001"/>{foot}{body}</mujoco>'
    )
    attach = {
        "</asset>": '<model name="shoe" file="shoe.xml"/></asset>',
        '<body name="base">': '<body name="base"><attach model="shoe" body="shoe" prefix="own_"/>',
    }
    return shaped(folder, "parts/foot.obj", "foot.obj", meshes="parts", text=attach)


def test_a_model_that_is_attached_is_found_beside_the_one_that_attaches_it(tmp_path: Path):
    assert arm_spec(with_shoe(tmp_path)).compile().nmeshvert == 8


def test_a_conflict_of_attached_models_is_said_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    recwarn: pytest.WarningsRecorder,
):
    monkeypatch.chdir(tmp_path)
    _warn.cache_clear()
    robot = with_shoe(tmp_path)
    for _ in range(3):
        arm_spec(robot).compile()
    assert capfd.readouterr().err.count("'shoe'") == 1
    assert not recwarn.list
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
