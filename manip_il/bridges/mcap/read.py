"""Read messages and pictures of one MCAP file with the library's reader and decoders."""

from __future__ import annotations

import importlib
import itertools
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, override

import numpy as np
from mcap.decoder import DecoderFactory
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.well_known import MessageEncoding
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.camera import decode_picture
from manip_il.errors import ManipError

U8 = NDArray[np.uint8]

_LAST_STAMP = 2**63 - 1  # [ns]
_ROS2 = "mcap_ros2"  # module of the optional package mcap-ros2-support
_CHANNELS = {"rgb8": slice(None), "bgr8": slice(None, None, -1)}  # encoding of raw pictures -> slice of channels to RGB


def read_topics(path: Path) -> list[str]:
    """Return the topics in a file's summary; [] without a summary."""
    with checks.open_outside(path, "an MCAP file") as stream:
        summary = make_reader(stream).get_summary()
    return sorted({channel.topic for channel in summary.channels.values()} if summary else ())


def read_messages(path: Path, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, log time [ns] and decoded content of the messages of some topics, in order of time.

    Raises `ManipError` naming the file for any error of the MCAP library or a decoder.
    """
    factories: list[DecoderFactory] = [ProtobufFactory(), _OtherFactory()]
    if find_spec(_ROS2):
        factories.insert(0, importlib.import_module(f"{_ROS2}.decoder").DecoderFactory())
    try:
        with checks.open_outside(path, "an MCAP file") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=factories)
            for _, channel, message, content in reader.iter_decoded_messages(topics):
                stamp = checks.whole(f"the log time of {channel.topic}", message.log_time, 0, _LAST_STAMP)
                yield channel.topic, stamp, content
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        raise ManipError(f"cannot read {path}: {checks.one_line(error) or type(error).__name__}") from error


def read_pictures(path: Path, topic: str, stamps: Sequence[int]) -> Iterator[U8]:
    """Yield the pictures (height, width, 3) of a topic's messages with these ascending stamps, (T,) [ns].

    Raises `ManipError` naming file, topic and stamp for a message without a picture.
    """
    frames = Counter(stamps)
    for stamp, messages in itertools.groupby(read_messages(path, [topic]), lambda message: message[1]):
        *_, (_, _, content) = messages  # if stamps are equal, the last message counts
        if stamp in frames:
            try:
                picture = _picture(content)
            except ValueError as error:
                raise ManipError(f"{path}, topic {topic} at {stamp} ns: {error}") from error
            yield from itertools.repeat(picture, frames[stamp])


class _OtherFactory(DecoderFactory):
    """Last decoder factory to be asked: decodes JSON and raises `ValueError` for any other encoding."""

    @override
    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any]:
        if message_encoding == MessageEncoding.JSON:
            return json.loads
        is_ros2 = message_encoding == MessageEncoding.CDR and not find_spec(_ROS2)
        remedy = "for ROS 2: pip install mcap-ros2-support" if is_ros2 else "convert the file"
        found = f"{message_encoding} (schema: {schema.encoding if schema else 'none'})"
        raise ValueError(f"messages are {found}; expected protobuf, json or cdr (ros2msg); {remedy}")


def _picture(message: Any) -> U8:
    """Return the picture (height, width, 3) of a Foxglove or ROS message. Raises `ValueError` if there is none."""
    if hasattr(message, "format"):  # CompressedImage
        return decode_picture(bytes(message.data))
    encoding = getattr(message, "encoding", "none")  # RawImage of Foxglove, Image of ROS
    if encoding not in _CHANNELS:
        raise ValueError(f"the picture is encoded as {encoding!r}; expected {' or '.join(_CHANNELS)}, PNG or JPEG")
    height = message.height
    width = message.width
    step = message.step or message.width * 3
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)  # rows may be padded
    return np.ascontiguousarray(rows[:, : width * 3].reshape(height, width, 3)[:, :, _CHANNELS[encoding]])
