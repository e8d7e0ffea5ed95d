"""Mapping files and their paths into messages: what they mean, and what is said where they are wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError, UsageError
from manip_il.mcap.mapping import Camera, Mapping, Values, load_mapping
from manip_il.mcap.path import FieldPath, parse_path

from .use import load

ROOT = Path(__file__).resolve().parents[2]


def tree() -> dict[str, Any]:
    number = {"topic": "/a", "field": "x", "dtype": "float32", "resample": "hold", "tolerance": 0.1}
    camera = {"topic": "/c", "video": True, "resample": "nearest", "tolerance": 0}
    return {"fps": 20, "task": "do it", "features": {"action": number, "observation.images.c": camera}}


def test_a_mapping_is_its_file(tmp_path: Path) -> None:
    mapping = load(tmp_path, **tree())
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


NUMBER = tree()["features"]["action"]


def of_action(**changes: Any) -> dict[str, Any]:
    return {"features": {"action": NUMBER | changes}}


def of_camera(**changes: Any) -> dict[str, Any]:
    return {"features": {"c": tree()["features"]["observation.images.c"] | changes}}


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
        ({"features": {"timestamp": NUMBER}}, "LeRobot counts timestamp itself"),
        ({"features": {"a/b": NUMBER}}, "a column's name is 'a/b'; expected a name of letters, digits and _ . -"),
        ({"features": {"a": 1}}, "features: a: got 1; expected a mapping of topic, field, dtype"),
        (of_action(tolerence=1), r"action: unknown key 'tolerence' \(did you mean 'tolerance'\?\)"),
        (of_action(tolerance=-1), "features: action: tolerance is -1; expected seconds, 0 or more"),
        (of_action(tolerance=float("inf")), "tolerance is inf"),
        (of_action(tolerance=10**400), "tolerance is "),
        (of_action(tolerance="1s"), "tolerance is '1s'"),
        (of_action(topic=None), "topic is None; expected text"),
        (of_action(resample="linear"), "unknown resample 'linear'"),
        (of_action(dtype="flaot32"), r"unknown dtype 'flaot32' \(did you mean 'float32'\?\)"),
        (of_action(dtype="int64", resample="interpolate"), "resample is interpolate, which int64 cannot be"),
        (of_action(field=[]), r"field is \[\]; expected a path or a list of paths"),
        (of_action(field="a[b"), r"the path 'a\[b' is invalid at character 2"),
        (of_action(shape=[0]), r"shape is \(0,\)"),
        (of_action(shape=3), "shape is 3; expected a list of whole numbers"),
        (of_camera(video="yes"), "features: c: video is 'yes'; expected true or false"),
        (of_camera(dtype="image"), "unknown key 'dtype'"),
        (of_camera(resample="interpolate"), "interpolate, which pictures cannot be"),
    ],
)
def test_a_wrong_value_is_refused_by_name(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=rf"m\.yaml: .*{why}"):
        load(tmp_path, **(tree() | change))


@pytest.mark.parametrize("text", ["[1]", "a: [", "a: !!python/name:os.system x", "\0"])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"m\.yaml"):
        load_mapping(path)
    with pytest.raises(UsageError, match=r"cannot read .*x\.yaml: No such file"):
        load_mapping(tmp_path / "x.yaml")


words = st.from_regex(r"[a-z_][a-z0-9_]*", fullmatch=True)
steps = st.one_of(st.text(), st.integers(0, 99), st.just(slice(None)), st.tuples(words, st.text()))
paths = st.builds(lambda first, rest: FieldPath((first, *rest)), st.text(), st.lists(steps, max_size=5))


@given(paths)
def test_text_and_path_are_the_same_thing(path: FieldPath) -> None:
    assert parse_path(str(path)) == path


@given(st.text(max_size=12))
def test_any_text_is_a_path_or_refused(text: str) -> None:
    try:
        parsed = parse_path(text)
    except UsageError:
        return
    assert parse_path(str(parsed)) == parsed


@given(
    st.lists(st.dictionaries(st.sampled_from(["label", "value"]), st.integers(), min_size=2, max_size=2), min_size=1)
)
def test_all_elements_are_those_at_each_index(scalars: list[dict[str, int]]) -> None:
    message = {"scalars": scalars}
    one_by_one = [parse_path(f"scalars[{number}].value").values(message)[0] for number in range(len(scalars))]
    assert parse_path("scalars[:].value").values(message) == one_by_one == [scalar["value"] for scalar in scalars]


def joints() -> JointStates:
    message = JointStates()
    for number, name in enumerate(["shoulder", "elbow", "wrist [2]"]):
        message.joints.add(name=name, position=number / 2)
    return message


@pytest.mark.parametrize(
    ("path", "message", "values"),
    [
        ("joints[name=elbow].position", joints(), [0.5]),
        ('joints[name="wrist [2]"].position', joints(), [1.0]),
        ("joints[:].position", joints(), [0.0, 0.5, 1.0]),
        ("joints[2].name", joints(), ["wrist [2]"]),
        ("data", {"data": [1, 2, 3]}, [1, 2, 3]),
        ("data[1]", {"data": [1, 2, 3]}, [2]),
        ('"odd name".x', {"odd name": {"x": 4}}, [4]),
        ("list[id=7].x", {"list": [{"id": 6, "x": 0}, {"id": 7, "x": 1}]}, [1]),
        ("größe", {"größe": 1}, [1]),
        ("rows[:][0]", {"rows": [[1, 2], [3, 4]]}, [1, 3]),
    ],
)
def test_a_path_gives(path: str, message: object, values: list) -> None:
    assert parse_path(path).values(message) == values


@pytest.mark.parametrize(
    ("path", "message", "why"),
    [
        ("joint", joints(), r"joint: no field 'joint' \(did you mean 'joints'\?\); known: timestamp, joints"),
        ("joints[name=elbo].name", joints(), r"joints\[name=elbo\]: 0 elements have .* \(did you mean 'elbow'"),
        ("joints[3].position", joints(), "the list has 3 elements"),
        ("joints.position", joints(), r"in a list; choose its elements by \[0\], \[:\]"),
        ("joints[0].velocity", joints(), r"joints\[0\]\.velocity: not set in this message"),
        ("joints[0].position.x", joints(), "no field 'x' in a plain value"),
        ("pose.position.x", PoseInFrame(), "pose: not set in this message"),
        ("data[:]", {"data": 1}, r"data\[:\]: not a list"),
        ("data[n=1]", {"data": [{"n": 1}, {"n": 1}]}, "2 elements have this n"),
    ],
)
def test_a_path_that_leads_nowhere_says_where_it_ends(path: str, message: object, why: str) -> None:
    with pytest.raises(ManipError, match=why):
        parse_path(path).values(message)


@pytest.mark.parametrize(
    ("text", "character"),
    [
        *((text, 1) for text in ("", ".a", "[0]")),
        *((text, 2) for text in ("a.", "a..b", "a b", "a[", "a[]", "a[x]", "a[-1]")),
    ],
)
def test_a_bad_path_shows_where_it_goes_wrong(text: str, character: int) -> None:
    with pytest.raises(UsageError, match=rf"is invalid at character {character};"):
        parse_path(text)
