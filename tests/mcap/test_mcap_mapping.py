"""A mapping file says all that an import needs, or what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from manip_il.errors import UsageError
from manip_il.mcap.mapping import Camera, Mapping, Values, load_mapping
from manip_il.mcap.path import parse_path

ROOT = Path(__file__).resolve().parents[2]


def tree() -> dict[str, Any]:
    number = {"topic": "/a", "field": "x", "dtype": "float32", "resample": "hold", "tolerance": 0.1}
    camera = {"topic": "/c", "video": True, "resample": "nearest", "tolerance": 0}
    return {"fps": 20, "task": "do it", "features": {"action": number, "observation.images.c": camera}}


def load(folder: Path, content: object) -> Mapping:
    path = folder / "m.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_mapping(path)


def test_a_mapping_is_its_file(tmp_path: Path) -> None:
    mapping = load(tmp_path, tree())
    assert mapping == Mapping(
        20,
        None,
        "do it",
        {
            "action": Values("/a", "hold", 0.1, (parse_path("x"),), "float32"),
            "observation.images.c": Camera("/c", "nearest", 0, True),
        },
    )
    assert mapping.topics == ["/a", "/c"]


def test_written_and_read_again_it_is_equal(tmp_path: Path) -> None:
    paths = (parse_path("a[n=no]"), parse_path('"yes".b[:]'))
    task = Values("/task", "hold", 1, (parse_path("message"),), "string")
    odd = Values("/ä: x", "interpolate", 1e-9, paths, "float64", {"motors": ["on", "1"]}, (2, 3))
    mapping = Mapping(30, "null", task, {"3": odd, "null": Camera("~", "hold", 0.5, False)})
    path = tmp_path / "m.yaml"
    path.write_text(mapping.to_yaml(), encoding="utf-8")
    assert load_mapping(path) == mapping


def test_the_example_loads() -> None:
    mapping = load_mapping(ROOT / "configs/mcap/panda.yaml")
    assert mapping.topics == ["/joint_states", "/tf", "/action", "/scalars"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"fsp": 20}, r"unknown key 'fsp' \(did you mean 'fps'\?\)"),
        ({"fps": 0}, "fps is 0; expected a whole number above 0"),
        ({"fps": 29.97}, "fps is 29.97"),
        ({"fps": True}, "fps is True"),
        ({"robot_type": 3}, "robot_type is 3; expected text or null"),
        ({"task": 3}, "task: task is 3; expected text, or topic"),
        ({"task": ""}, "task is ''"),
        ({"task": {"topic": "/t"}}, "task: field is missing"),
        ({"features": {}}, "features is {}; expected at least one"),
        ({"features": [1]}, r"features is \[1\]; expected a mapping of column names"),
        ({"features": {"timestamp": tree()["features"]["action"]}}, "LeRobot counts timestamp itself"),
        (
            {"features": {"a/b": tree()["features"]["action"]}},
            "a column's name is 'a/b'; expected a name of letters, digits and _ . -",
        ),
        ({"features": {"a": 1}}, "features: a: got 1; expected a mapping of topic, field, dtype"),
    ],
)
def test_a_wrong_value_is_refused_by_name(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=rf"m\.yaml: .*{why}"):
        load(tmp_path, {**tree(), **change})


@pytest.mark.parametrize(
    ("key", "change", "why"),
    [
        ("action", {"tolerence": 1}, r"unknown key 'tolerence' \(did you mean 'tolerance'\?\)"),
        ("action", {"tolerance": -1}, "tolerance is -1; expected seconds, 0 or more"),
        ("action", {"tolerance": float("inf")}, "tolerance is inf"),
        ("action", {"tolerance": "1s"}, "tolerance is '1s'"),
        ("action", {"topic": None}, "topic is None; expected text"),
        ("action", {"resample": "linear"}, "unknown resample 'linear'"),
        ("action", {"dtype": "flaot32"}, r"unknown dtype 'flaot32' \(did you mean 'float32'\?\)"),
        ("action", {"dtype": "int64", "resample": "interpolate"}, "resample is interpolate, which int64 cannot be"),
        ("action", {"field": []}, r"field is \[\]; expected a path or a list of paths"),
        ("action", {"field": "a[b"}, r"the path 'a\[b' is invalid at character 2"),
        ("action", {"shape": [0]}, r"shape is \(0,\)"),
        ("action", {"shape": 3}, "shape is 3; expected a list of whole numbers"),
        ("observation.images.c", {"video": "yes"}, "video is 'yes'; expected true or false"),
        ("observation.images.c", {"dtype": "image"}, "unknown key 'dtype'"),
        ("observation.images.c", {"resample": "interpolate"}, "interpolate, which pictures cannot be"),
    ],
)
def test_a_wrong_feature_is_refused_by_name(tmp_path: Path, key: str, change: dict[str, Any], why: str) -> None:
    content = tree()
    content["features"][key] |= change
    with pytest.raises(UsageError, match=rf"m\.yaml: features: {key}: .*{why}"):
        load(tmp_path, content)


@pytest.mark.parametrize("text", ["[1]", "a: [", "a: !!python/name:os.system x", "\0"])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"m\.yaml"):
        load_mapping(path)
    with pytest.raises(UsageError, match=r"cannot read .*x\.yaml: No such file"):
        load_mapping(tmp_path / "x.yaml")
