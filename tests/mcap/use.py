"""What tests of MCAP share: messages as others decode them, mappings, and files of messages."""

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import register_schema

from manip_il.bridges.mcap.mapping import Mapping, load_mapping

MS = 1_000_000
Messages = Iterable[tuple[int, Any]]  # stamp [ms], content


def decoded(data: bytes) -> list[tuple[str, int, Any]]:
    """Every message's topic, stamp [ns] and content, as others read them."""
    found: list[tuple[str, int, Any]] = []
    for schema, channel, message in make_reader(
        io.BytesIO(data), validate_crcs=True
    ).iter_messages():
        decoder = DecoderFactory().decoder_for(channel.message_encoding, schema) or json.loads
        found.append((channel.topic, message.log_time, decoder(message.data)))
    return found


def load(folder: Path, features: Any, **more: Any) -> Mapping:
    """The mapping that a file of these features is, at 10 frames a second unless `more` says
    otherwise.
    """
    path = folder / "m.yaml"
    path.write_text(
        yaml.safe_dump({"fps": 10, "task": "t", "features": features, **more}), encoding="utf-8"
    )
    return load_mapping(path)


def feature(topic: str = "/a", **changes: Any) -> dict[str, Any]:
    """A column of the field `x` in a mapping."""
    return {
        "topic": topic,
        "field": "x",
        "dtype": "float64",
        "resample": "nearest",
        "tolerance": 0.02,
        **changes,
    }


def ramp(stamps: Iterable[int]) -> list[tuple[int, Any]]:
    """Messages that hold their stamps."""
    return [(stamp, {"x": float(stamp)}) for stamp in stamps]


def write(path: Path, topics: dict[str, Messages]) -> Path:
    """Write topics of messages, in this order: JSON, protobuf, or bytes as of ROS 2."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, messages in topics.items():
            channel = None
            for stamp, content in messages:
                kind = {dict: "json", bytes: "cdr"}.get(type(content), "protobuf")
                if channel is None:
                    schema = register_schema(writer, type(content)) if kind == "protobuf" else 0
                    channel = writer.register_channel(topic, kind, schema)
                data = json.dumps(content).encode() if kind == "json" else content
                data = content.SerializeToString() if kind == "protobuf" else data
                writer.add_message(channel, stamp * MS, data, stamp * MS)
        writer.finish()
    return path
