"""A mapping is its file, and a path leads to values; what is wrong is said by name."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from manip_il.bridges.mcap.mapping import Mapping, TopicSource, load_mapping, values_at
from manip_il.errors import ManipError, UsageError

from .use import load

ROOT = Path(__file__).resolve().parents[2]
NUMBER = {"topic": "/a", "field": "x", "dtype": "float32", "resample": "previous", "tolerance": 0.1}
CAMERA = {"topic": "/c", "video": True, "resample": "nearest", "tolerance": 0}
TREE: dict[str, Any] = {
    "fps": 20,
    "task": "do it",
    "features": {"action": NUMBER, "observation.images.c": CAMERA},
}


def test_a_mapping_is_its_file_and_the_example_loads(tmp_path: Path) -> None:
    number, camera = (
        TopicSource("/a", "previous", 0.1, "x", "float32"),
        TopicSource("/c", "nearest", 0, video=True),
    )
    assert load(tmp_path, **TREE) == Mapping(
        20, "do it", {"action": number, "observation.images.c": camera}
    )
    example = load_mapping(ROOT / "configs/mcap/panda.yaml")
    assert [one.topic for one in example.sources.values()][:3] == [
        "/joint_states",
        "/action",
        "/scalars",
    ]


def test_a_path_leads_to_values_or_says_where_it_ends() -> None:
    joints = JointStates()
    for number, name in enumerate(["shoulder", "wrist.1"]):
        joints.joints.add(name=name, position=number / 2)
    assert values_at("joints[:].position", joints) == [0.0, 0.5]
    assert (
        values_at("joints[name=wrist.1].position", joints)
        == values_at("a b[1]", {"a b": [0, 0.5]})
        == [0.5]
    )
    # as mcap-ros2-support makes them
    ros = type("JointState", (SimpleNamespace,), {"__slots__": ["position"]})()
    ros.position = [1.5, 2.5]
    assert values_at("position", ros) == [1.5, 2.5]
    for path, why in (
        ("joint", r"no field 'joint' \(did you mean 'joints'\?\); known: timestamp, joints"),
        ("joints[name=elbo].name", r"\[name=elbo\] matches 0 of 2 elements"),
        ("joints.position", r"in a list; select elements by \[0\], \[:\]"),
        ("joints[0].velocity", "velocity is not set in this message"),
    ):
        with pytest.raises(ManipError, match=why):
            values_at(path, joints)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("robot_type", "[1, 2]"),
        ("task", '"\\ud800"'),
        ("names", '["\\ud800"]'),
        ("names", "[2001-01-01]"),
    ],
)
def test_what_a_dataset_cannot_hold_is_refused_before_an_episode_is_read(
    key: str, value: str, tmp_path: Path
) -> None:
    column = "{topic: /a, field: x, dtype: float32, resample: nearest, tolerance: 1, names: NAMES}"
    told = {"robot_type": "arm", "task": "t", "names": "null"} | {key: value}
    text = (
        f"fps: 10\nrobot_type: {told['robot_type']}\ntask: {told['task']}\nfeatures: {{action:"
        f" {column}}}\n"
    )
    (tmp_path / "m.yaml").write_text(text.replace("NAMES", told["names"]))
    with pytest.raises(UsageError, match=r"m\.yaml") as error:
        load_mapping(tmp_path / "m.yaml")
    assert "\n" not in str(error.value)
