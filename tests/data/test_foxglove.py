"""Messages keep every bit, in the schemas that Foxglove and LeRobot know."""

from __future__ import annotations

import io

import hypothesis.extra.numpy as hnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from manip_il.data import foxglove
from manip_il.data import schema as s

from ..mcap.use import decoded

SPEC = s.RobotTaskSpec("r", "t", 30, ("a", "b"), ("ee.x",), 1, "", cameras=("front", "wrist"), image_size=(2, 3))


def written(channels: list[foxglove.Channel], times: list[int]) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    foxglove.add_channels(writer, channels, times)
    writer.finish()
    return stream.getvalue()


@given(hnp.arrays(np.float64, (3, 2), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_numbers_keep_every_bit(values: np.ndarray) -> None:
    times = [0, 1, 2**62]
    data = written(
        [
            foxglove.joint_states("/joints", ["a", "b % c"], values, times),
            foxglove.scalars("/scalars", ["a", 'b "% c'], values.tolist()),
        ],
        times,
    )
    found = {(topic, time): message for topic, time, message in decoded(data)}
    for time, row in zip(times, values, strict=True):
        joints = found["/joints", time].joints
        assert np.array([joint.position for joint in joints]).tobytes() == row.tobytes()
        assert [joint.name for joint in joints] == ["a", "b % c"]
        scalars = found["/scalars", time]["scalars"]
        assert np.array([scalar["value"] for scalar in scalars], np.float64).tobytes() == row.tobytes()
        assert scalars[1]["label"] == 'b "% c'
        assert found["/joints", time].timestamp.ToNanoseconds() == time


def test_the_scalars_schema_is_lerobots() -> None:
    from lerobot.utils import foxglove_visualization as lerobots

    assert foxglove.SCALARS == lerobots._SCALARS_SCHEMA
    assert lerobots._foxglove_topic(s.IMAGES + "front", is_image=True) == foxglove.IMAGE_TOPICS + "front"
