"""The names of policies and of their options, read from the text of LeRobot's and our configuration files.

A mistyped name is so answered at once: importing the configurations themselves takes seconds.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from manip_il.errors import UnknownName

# Where a policy's configuration is kept with what was meant for one machine or one command.
NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")
_REGISTERED = re.compile(r"""@PreTrainedConfig\.register_subclass\(\s*["'](\w+)["']""")
_BASE = "PreTrainedConfig"
_FEW = 12  # names that one line of an error may list


@cache
def policy_files() -> Mapping[str, Path]:
    """`--policy.type` -> the file of its configuration, for every policy of LeRobot's and of this project."""
    found = (Path(root) / "policies" for root in _lerobot())
    files = [file for root in (*found, Path(__file__).parent) for file in root.glob("*/configuration_*.py")]
    return {kind: file for file in sorted(files) for kind in _REGISTERED.findall(file.read_text(encoding="utf-8"))}


def policy_options(kind: str) -> tuple[str, ...]:
    """Return names of the options of a policy type, sorted.

    None where its configuration is not written as others are.
    """
    own, classes = (_classes(policy_files()[one]) for one in ("mlp", kind))
    name = next((name for name, one in classes.items() if kind in _registered(one)), "")
    classes = own | classes  # the cnn's options are the mlp's, and some
    names: set[str] = set()
    while name != _BASE:
        if name not in classes:
            return ()
        names |= set(_fields(classes[name]))
        bases = [base.id for base in classes[name].bases if isinstance(base, ast.Name)]
        name = bases[0] if len(bases) == 1 else ""
    base = next((_classes(Path(root) / "configs" / "policies.py") for root in _lerobot()), {}).get(_BASE)
    return () if base is None else tuple(sorted({*names, *_fields(base)} - {*NOT_OURS}))


def check_names(settings: Mapping[str, Any], default_type: str) -> None:
    """Raise `UnknownName` where `--policy.*` names a type or an option that is not there; with a `path` it may be."""
    if "path" in settings:
        return
    kind = settings.get("type", default_type)
    if not isinstance(kind, str) or kind not in policy_files():
        raise UnknownName("policy", str(kind), policy_files())
    known = policy_options(kind)
    for name in settings:
        if known and name not in (*known, "type"):
            raise unknown_option(kind, name, known)


def unknown_option(kind: str, name: str, known: tuple[str, ...]) -> UnknownName:
    """Return the error that names the nearest of a policy's options, and all where they are few."""
    where = f"manip-il train --policy.type={kind} --help lists all"
    return UnknownName(f"option of --policy.type={kind}:", name, known, where if len(known) > _FEW else "")


def _lerobot() -> list[str]:
    """Folders of LeRobot's package, which is not imported for it."""
    spec = find_spec("lerobot")
    return list(spec.submodule_search_locations or []) if spec is not None else []


@cache
def _classes(file: Path) -> dict[str, ast.ClassDef]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def _registered(node: ast.ClassDef) -> list[str]:
    return [name for one in node.decorator_list for name in _REGISTERED.findall(f"@{ast.unparse(one)}")]


def _fields(node: ast.ClassDef) -> Iterator[str]:
    """Annotated names in a dataclass's body that are options."""
    for line in node.body:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            text = ast.unparse(line)
            if "ClassVar[" not in text and "init=False" not in text:
                yield line.target.id
