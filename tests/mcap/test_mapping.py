"""A mapping is its file, and a path leads to values; what is wrong is said by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from manip_il.errors import ManipError, UsageError
from manip_il.mcap.mapping import Mapping, Source, load_mapping
from manip_il.mcap.path import parse_path, values_at

from .use import load

ROOT = Path(__file__).resolve().parents[2]


def tree() -> dict[str, Any]:
    number = {"topic": "/a", "field": "x", "dtype": "float32", "resample": "hold", "tolerance": 0.1}
    camera = {"topic": "/c", "video": True, "resample": "nearest", "tolerance": 0}
    return {"fps": 20, "task": "do it", "features": {"action": number, "observation.images.c": camera}}


def test_a_mapping_is_its_file(tmp_path: Path) -> None:
    number, camera = Source("/a", "hold", 0.1, "x", "float32"), Source("/c", "nearest", 0, video=True)
    assert load(tmp_path, **tree()) == Mapping(20, "do it", {"action": number, "observation.images.c": camera})


def test_written_and_read_again_it_is_equal(tmp_path: Path) -> None:
    odd = Source("/ä: x", "interpolate", 1e-9, ["a[n=no]", "yes.b[:]"], "float64", {"motors": ["on", "1"]}, (2, 3))
    features = {"3": odd, "null": Source("~", "hold", 0.5, video=False)}
    mapping = Mapping(30, Source("/task", "hold", 1, "message"), features, "null")
    path = tmp_path / "m.yaml"
    path.write_text(mapping.to_yaml(), encoding="utf-8")
    assert load_mapping(path) == mapping


def test_the_example_loads() -> None:
    mapping = load_mapping(ROOT / "configs/mcap/panda.yaml")
    assert [one.topic for one in mapping.sources.values()][:3] == ["/joint_states", "/tf", "/action"]


NUMBER = tree()["features"]["action"]


def of_action(**changes: Any) -> dict[str, Any]:
    return {"features": {"action": NUMBER | changes}}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"fsp": 20}, "unexpected keyword argument 'fsp'"),
        ({"fps": 0}, "fps is 0; expected a whole number from 1"),
        ({"task": 3}, "task is 3; expected text"),
        ({"task": {"topic": "/t"}}, "task: .*`resample`"),
        ({"features": {}}, "features is empty; expected at least one column"),
        ({"features": {"timestamp": NUMBER}}, "LeRobot fills timestamp itself"),
        ({"features": {"a/b": NUMBER}}, "a column's name is 'a/b'; expected a name of letters, digits and _ . -"),
        (of_action(tolerence=1), "features: action: The fields `tolerence` are not valid"),
        (of_action(tolerance=-1), "tolerance is -1.*; expected seconds, 0 or more"),
        (of_action(tolerance=float("nan")), "tolerance is nan"),
        (of_action(tolerance="1s"), "features: action: `tolerance`: Couldn't parse '1s'"),
        (of_action(dtype="flaot32"), "dtype is flaot32; expected one of float16, float32"),
        (of_action(dtype="int64", resample="interpolate"), "features: action: only floats can be interpolated"),
        (of_action(field="a[b"), r"the path 'a\[b' is invalid"),
        (of_action(video=True), "expected either field or video"),
    ],
)
def test_a_wrong_value_is_refused_by_name_in_one_line(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=rf"^.*m\.yaml: .*{why}.*$"):
        load(tmp_path, **(tree() | change))


def test_yaml_of_a_mapping_runs_no_code(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("a: !!python/name:os.system x")
    with pytest.raises(UsageError, match=r"m\.yaml"):
        load_mapping(tmp_path / "m.yaml")


def joints() -> JointStates:
    message = JointStates()
    for number, name in enumerate(["shoulder", "elbow", "wrist.1"]):
        message.joints.add(name=name, position=number / 2)
    return message


@pytest.mark.parametrize(
    ("path", "message", "values"),
    [
        ("joints[name=elbow].position", joints(), [0.5]),
        ("joints[name=wrist.1].position", joints(), [1.0]),
        ("joints[:].position", joints(), [0.0, 0.5, 1.0]),
        ("data", {"data": [1, 2, 3]}, [1, 2, 3]),
        ("odd name.x", {"odd name": {"x": 4}}, [4]),
        ("list[id=7].x", {"list": [{"id": 6, "x": 0}, {"id": 7, "x": 1}]}, [1]),
        ("scalars[:].value", {"scalars": [{"value": 2}, {"value": 1}]}, [2, 1]),
        ("rows[:][0]", {"rows": [[1, 2], [3, 4]]}, [1, 3]),
    ],
)
def test_a_path_gives(path: str, message: object, values: list) -> None:
    assert values_at(path, message) == values


@pytest.mark.parametrize(
    ("path", "message", "why"),
    [
        ("joint", joints(), r"joint: no field 'joint' \(did you mean 'joints'\?\); known: timestamp, joints"),
        ("joints[name=elbo].name", joints(), r"\[name=elbo\] fits 0 of 3 elements; known: shoulder, elbow"),
        ("joints.position", joints(), r"in a list; choose its elements by \[0\], \[:\]"),
        ("joints[0].velocity", joints(), "velocity is not set in this message"),
        ("pose.position.x", PoseInFrame(), "pose is not set in this message"),
        ("data[:]", {"data": 1}, "of what is not a list"),
    ],
)
def test_a_path_that_leads_nowhere_says_where_it_ends(path: str, message: object, why: str) -> None:
    with pytest.raises(ManipError, match=why):
        values_at(path, message)


@pytest.mark.parametrize("text", ["", ".a", "[0]", "a.", "a..b", "a[", "a[]", "a[x]", "a[-1]"])
def test_a_bad_path_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is invalid; expected names and selectors"):
        parse_path(text)
