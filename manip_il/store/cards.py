"""Cards for the Hub: `README.md` of a dataset or policy, and a dataset's picture, made from its folder.

The texts are the templates `card_dataset.md.jinja` and `card_policy.md.jinja`, filled from the modules of those names.
No card holds an absolute path, a token or a date: the same folder gives the same bytes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from huggingface_hub import DatasetCard, ModelCard

from manip_il import checks
from manip_il.errors import ManipError
from manip_il.store.card_policy import policy_fields
from manip_il.store.errors import redact
from manip_il.store.manifest import Kind
from manip_il.store.push import CARD
from manip_il.yaml_file import parse_yaml

PICTURE = "assets/episodes.png"
_MADE_BY = "| made by | manip_il"  # a row of every card of ours
_REPOSITORY = "USER/NAME"  # in the commands of a card that is not for a Hub
_COMMANDS = {"RecordOptions": "record", "TrainOptions": "train", "DaggerOptions": "dagger"}
_HEADER = re.compile(r"# manip-il \S+: resolved options \((\w+)\)")
_NOT_SHOWN = (  # options that are places, or concern one machine
    *("root", "output_dir", "repo_id", "config_path", "resume", "overwrite", "engine", "device", "workers", "threads"),
    *("num_workers", "image_cache_gb", "log_freq", "save_freq", "tensorboard"),
)
_SECRET = re.compile(r"token|secret|password|passwd|credential|api_?key", re.IGNORECASE)
_LARGEST_CONFIG = 100_000  # [bytes]


def card_for(root: Path, kind: Kind, url: str) -> dict[str, bytes]:
    """Return path in the repository -> content. url: of the repository, for the commands that the card shows.

    A `README.md` of another origin is kept: then the result holds none. Raises `ManipError` for a folder that cannot be
    read.
    """
    own = root / CARD
    is_kept = own.is_file() and _MADE_BY not in own.read_text(encoding="utf-8", errors="replace")
    found = re.fullmatch(r"hf://(?:datasets/|models/)?([^@]+)(?:@.*)?", url)
    place = found[1] if found else _REPOSITORY
    if kind == "policy":
        return {} if is_kept else {CARD: _policy_card(root, place)}
    from manip_il.store.card_dataset import dataset_fields, draw_picture

    picture = draw_picture(root)
    files = {PICTURE: picture} if picture else {}
    if not is_kept:
        data, fields = dataset_fields(root, place)
        beside = root.absolute().with_name(f"{root.absolute().name}.journals")
        fields["command"] = command(beside / "config.yaml") or command(root.absolute().parent / "config.yaml")
        fields["picture"] = PICTURE if picture else None
        files[CARD] = _render(DatasetCard, "card_dataset", data, fields)
    return files


def _policy_card(root: Path, place: str) -> bytes:
    try:
        data, fields = policy_fields(root, place)
        fields["folder"] = place.rpartition("/")[2] if place != _REPOSITORY else "policy"
        fields["command"] = command(root / "config.yaml")
        return _render(ModelCard, "card_policy", data, fields)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ManipError(
            f"{root}: its card cannot be written, as a JSON file beside the policy holds unexpected values "
            f"({type(error).__name__}: {checks.shorten(str(error))}); restore the file"
        ) from error


def _render(card: type[DatasetCard | ModelCard], template: str, data: Any, fields: dict[str, Any]) -> bytes:
    """Fill a template. Every value of a table becomes one cell, without a secret."""
    values = {**fields, "version": version("manip_il")}
    for name in ("rows", "fingerprint"):
        values[name] = [(_cell(label), _cell(value)) for label, value in fields[name]]
    path = Path(__file__).with_name(f"{template}.md.jinja")
    made = card.from_template(data, template_path=str(path), **values)
    return f"{made}\n".encode()


def _cell(value: object) -> str:
    return redact(" ".join(str(value).split())).replace("|", "\\|")


def command(config: Path) -> str | None:
    """Return the `manip-il` command of a `config.yaml` of ours; None without one.

    Leaves out folders, options of one machine, and anything that could be a secret.
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
    is_plain = re.fullmatch(r"[\w.,:+@=-]+", value)  # no path, nothing that a shell would read
    return bool(is_plain) and name.split(".")[-1] not in _NOT_SHOWN and not _SECRET.search(name)
