"""A mapping is its file, and a path leads to values; what is wrong is said by name."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from manip_il.errors import ManipError, UsageError
from manip_il.mcap.mapping import Mapping, Source, exact_rate, frame_times, load_mapping
from manip_il.mcap.path import values_at

from .use import load

ROOT = Path(__file__).resolve().parents[2]
NUMBER = {"topic": "/a", "field": "x", "dtype": "float32", "resample": "previous", "tolerance": 0.1}
CAMERA = {"topic": "/c", "video": True, "resample": "nearest", "tolerance": 0}
TREE: dict[str, Any] = {"fps": 20, "task": "do it", "features": {"action": NUMBER, "observation.images.c": CAMERA}}


def test_a_mapping_is_its_file_and_the_example_loads(tmp_path: Path) -> None:
    number, camera = Source("/a", "previous", 0.1, "x", "float32"), Source("/c", "nearest", 0, video=True)
    assert load(tmp_path, **TREE) == Mapping(20, "do it", {"action": number, "observation.images.c": camera})
    example = load_mapping(ROOT / "configs/mcap/panda.yaml")
    assert [one.topic for one in example.sources.values()][:3] == ["/joint_states", "/tf", "/action"]


def of_action(**changes: Any) -> dict[str, Any]:
    return {"features": {"action": NUMBER | changes}}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"fsp": 20}, "unexpected keyword argument 'fsp'"),
        ({"fps": 0}, "fps is 0; expected a finite number from 1"),
        ({"fps": 29.97}, "whole rates, not at 29.97; observation.images.c needs video: false"),
        ({"task": {"topic": "/t"}}, "task: .*`resample`"),
        ({"features": {}}, "features is empty; expected at least one column"),
        ({"features": {"timestamp": NUMBER}}, "LeRobot fills timestamp itself"),
        ({"features": {"a/b": NUMBER}}, "a column's name is 'a/b'; expected a name of letters, digits and _ . -"),
        (of_action(tolerence=1), "features: action: The fields `tolerence` are not valid"),
        (of_action(tolerance=float("nan")), "tolerance is nan"),
        (of_action(dtype="flaot32"), "dtype is flaot32; expected one of float16, float32"),
        (of_action(resample="hold"), "'hold'.* into one of: nearest, previous"),
        (of_action(field="a[b"), r"the path 'a\[b' is invalid"),
        (of_action(video=True), "expected either field or video"),
    ],
)
def test_a_wrong_value_is_refused_by_name_in_one_line(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=rf"^.*m\.yaml: .*{why}.*$"):
        load(tmp_path, **(TREE | change))


@pytest.mark.parametrize(
    ("fps", "rate"),
    [
        (30, Fraction(30)),
        (29.97, Fraction(2997, 100)),
        (30_000 / 1001, Fraction(30_000, 1001)),
        (12.3457, Fraction("12.3457")),
    ],
)
def test_a_fractional_rate_is_exact(fps: float, rate: Fraction) -> None:
    assert exact_rate(fps) == rate
    assert frame_times(900, rate)[899] == 899 * 10**9 // rate


def joints() -> JointStates:
    message = JointStates()
    for number, name in enumerate(["shoulder", "elbow", "wrist.1"]):
        message.joints.add(name=name, position=number / 2)
    return message


@pytest.mark.parametrize(
    ("path", "message", "values"),
    [
        ("joints[name=wrist.1].position", joints(), [1.0]),
        ("joints[:].position", joints(), [0.0, 0.5, 1.0]),
        ("data", {"data": [1, 2, 3]}, [1, 2, 3]),
        ("odd name.x", {"odd name": {"x": 4}}, [4]),
        ("list[id=7].x", {"list": [{"id": 6, "x": 0}, {"id": 7, "x": 1}]}, [1]),
        ("rows[:][0]", {"rows": [[1, 2], [3, 4]]}, [1, 3]),
    ],
)
def test_a_path_gives(path: str, message: object, values: list) -> None:
    assert values_at(path, message) == values


@pytest.mark.parametrize(
    ("path", "message", "why"),
    [
        ("joint", joints(), r"no field 'joint' \(did you mean 'joints'\?\); known: timestamp, joints"),
        ("joints[name=elbo].name", joints(), r"\[name=elbo\] fits 0 of 3 elements"),
        ("joints.position", joints(), r"in a list; choose its elements by \[0\], \[:\]"),
        ("joints[0].velocity", joints(), "velocity is not set in this message"),
        ("pose.position.x", PoseInFrame(), "pose is not set in this message"),
        ("data[:]", {"data": 1}, "of what is not a list"),
    ],
)
def test_a_path_that_leads_nowhere_says_where_it_ends(path: str, message: object, why: str) -> None:
    with pytest.raises(ManipError, match=why):
        values_at(path, message)
