"""Pieces that both cards are made of."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from manip_il.store.errors import redact
from manip_il.yaml_file import parse_yaml

MADE_BY = "| made by | manip_il"
LICENSE = "apache-2.0"
REPOSITORY = "USER/NAME"  # where the card is not for a Hub
_COMMANDS = {"RecordOptions": "record", "TrainOptions": "train", "DaggerOptions": "dagger"}
_HEADER = re.compile(r"# manip-il \S+: resolved options \((\w+)\)")
_PLACES = (
    *("root", "output_dir", "repo_id", "config_path", "resume", "overwrite", "engine", "device", "workers", "threads"),
    *("num_workers", "image_cache_gb", "log_freq", "save_freq", "tensorboard"),
)
_SECRET = re.compile(r"token|secret|password|passwd|credential|api_?key", re.IGNORECASE)
_LARGEST_CONFIG = 100_000  # [bytes]


def repository(url: str) -> str:
    """`USER/NAME` of an `hf://` URL."""
    found = re.fullmatch(r"hf://(?:datasets/|models/)?([^@]+)(?:@.*)?", url)
    return found[1] if found else REPOSITORY


def table(rows: Iterable[tuple[str, object]]) -> str:
    """Return a Markdown table without a head; a last row says what made it, so that a card of ours is known."""
    cells = [f"| {name} | {_cell(value)} |" for name, value in rows]
    return "\n".join(["| | |", "|---|---|", *cells, f"{MADE_BY} {version('manip_il')} |"])


def fingerprint_rows(fingerprint: Mapping[str, Any]) -> str:
    """Return versions and hashes, folded away."""
    if not fingerprint:
        return "Made by another program: there is no fingerprint of its environment.\n"
    rows = "\n".join(f"| {_cell(name)} | `{_cell(value)}` |" for name, value in fingerprint.items())
    head = "<details><summary>Fingerprint of the environment</summary>"
    return f"{head}\n\n| | |\n|---|---|\n{rows}\n\n</details>\n"


def command(config: Path) -> str | None:
    """Return the `manip-il` command that a `config.yaml` of ours stands for; None without one.

    Folders and what concerns one machine are left out, and anything that could be a secret.
    """
    if not config.is_file() or config.stat().st_size > _LARGEST_CONFIG:
        return None
    text = config.read_text(encoding="utf-8", errors="replace")
    header = _HEADER.match(text)
    word = _COMMANDS.get(header[1]) if header else None
    if word is None:
        return None
    try:
        tree = parse_yaml(text)
    except ValueError:
        return None
    words = [f"--{name}={value}" for name, value in _leaves(tree) if _is_shown(name, value)]
    return redact(f"manip-il {word} \\\n  " + " \\\n  ".join(words))


def _leaves(tree: object, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(tree, dict):
        named = cast("Mapping[str, object]", tree)
        return [
            leaf for key, value in named.items() for leaf in _leaves(value, f"{prefix}.{key}" if prefix else str(key))
        ]
    if isinstance(tree, list):
        items = cast("Sequence[object]", tree)
        return [(prefix, ",".join(map(str, items)))] if items else []
    if isinstance(tree, bool):
        return [(prefix, str(tree).lower())]
    return [] if tree is None else [(prefix, str(tree))]


def _is_shown(name: str, value: str) -> bool:
    plain = re.fullmatch(r"[\w.,:+@=-]+", value)  # no path, nothing that a shell would read
    return bool(plain) and name.split(".")[-1] not in _PLACES and not _SECRET.search(name)


def _cell(value: object) -> str:
    return redact(" ".join(str(value).split())).replace("|", "\\|")
