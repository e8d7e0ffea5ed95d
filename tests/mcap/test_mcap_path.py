"""Paths into messages: what they mean, and how they say that they lead nowhere."""

from __future__ import annotations

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError, UsageError
from manip_il.mcap.path import FieldPath, parse_path

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
        (
            "joints[name=elbo].position",
            joints(),
            r"joints\[name=elbo\]: 0 elements have this name \(did you mean 'elbow'",
        ),
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
        ("", 1),
        (".a", 1),
        ("a.", 2),
        ("a..b", 2),
        ("a b", 2),
        ("a[", 2),
        ("a[]", 2),
        ("a[x]", 2),
        ("a[-1]", 2),
        ("[0]", 1),
    ],
)
def test_a_bad_path_shows_where_it_goes_wrong(text: str, character: int) -> None:
    with pytest.raises(UsageError, match=rf"is invalid at character {character};"):
        parse_path(text)
