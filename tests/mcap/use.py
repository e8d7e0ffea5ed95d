"""What tests of MCAP share: messages as decoded, mappings, and the frames that an import makes."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from manip_il.mcap.importing import features_of, frames_of, read_import
from manip_il.mcap.mapping import Mapping, load_mapping


def decoded(data: bytes) -> list[tuple[str, int, Any]]:
    """Every message's topic, stamp [ns] and content, as others read them."""
    found: list[tuple[str, int, Any]] = []
    for schema, channel, message in make_reader(io.BytesIO(data), validate_crcs=True).iter_messages():
        decoder = DecoderFactory().decoder_for(channel.message_encoding, schema) or json.loads
        found.append((channel.topic, message.log_time, decoder(message.data)))
    return found


def load(folder: Path, features: Any, **more: Any) -> Mapping:
    """The mapping that a file of these features is, at 10 frames a second unless `more` says otherwise."""
    path = folder / "m.yaml"
    path.write_text(yaml.safe_dump({"fps": 10, "task": "t", "features": features, **more}), encoding="utf-8")
    return load_mapping(path)


def imported(path: Path, mapping: Mapping) -> list[dict[str, Any]]:
    episode = read_import(path, mapping)
    return list(frames_of(episode, mapping, features_of(episode, mapping)))
