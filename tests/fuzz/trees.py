"""Mutations of bytes, JSON and YAML: types swapped, values removed, added, nested; and texts that no tree gives."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from random import Random
from typing import Any

import yaml

Path = list[Any]  # keys and indices from the root

LENGTHS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)
DEEP = 20_000  # levels; Python's own limit is 1,000
_MARK = "@@RAW@@"  # in place of a text that no dumper writes
_RAW = (
    *("[" * DEEP + "]" * DEEP, '{"a":' * DEEP + "1" + "}" * DEEP, "NaN", "-Infinity", "1e999", "9" * 5_000, "tru", ""),
    f"[{'0,' * 300_000}0]",
)
_RAW_YAML = (
    "!!python/object/apply:os.system ['true']",
    "!!python/name:os.system",
    "!!binary zzz",
    "!!timestamp x",
    "!!int 1_0:99",
    "*nobody",
    "&a [*a, *a]",
    "2001-01-01",
    "2001-99-99",
    "1:99:99",
    "0x",
    "? [a, b]\n: c",
    "<<: 3",
)
ODD: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, -5, 2**31, 2**63, 2**64, 2**80, 10**400, 10**9),
    *(0.0, -0.0, 0.5, 1e-320, 1e308, math.nan, math.inf, -math.inf),
    *("", " ", "x", "true", "20", "null", "../x", "../../../../x", "/etc/passwd", "a/b", "x/../../y", "~", "C:\\x"),
    *("\0", "\n", "a\nb", "\x1b[31m", "\u202e", "\ud800", "é", "ﬁ", "%s", "{}", "{0.__class__}", "https://u:p@h/x"),
    *("x" * 100_000, "9" * 5_000, [], {}, [[]], [None], {"": None}, {"type": None}, [1, "a", None]),
    *([0] * 2_000, {str(number): number for number in range(2_000)}),
)


def damaged(rng: Random, data: bytes) -> bytes:
    """The bytes with one to four changes: flipped, cut, doubled, spliced, overwritten by a length."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(_DAMAGES)(rng, data)
    return data


def _flip(rng: Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + bytes([(data[place : place + 1] or b"\0")[0] ^ (1 << rng.randrange(8))]) + data[place + 1 :]


def _cut(rng: Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1)
    return rng.choice((data[:place], data[place:], b""))


def _repeat(rng: Random, data: bytes) -> bytes:
    start = rng.randrange(len(data) + 1)
    piece = data[start : start + rng.choice((1, 8, 200))]
    return data[:start] + piece * rng.choice((2, 10, 1_000)) + data[start:]


def _splice(rng: Random, data: bytes) -> bytes:
    there, here, size = (rng.randrange(len(data) + 1) for _ in range(3))
    piece = data[there : there + min(size, 500)]
    return data[:here] + piece + data[here + len(piece) :]


def _length(rng: Random, data: bytes) -> bytes:
    size = rng.choice((1, 2, 4, 8))
    value = rng.choice(LENGTHS) % 2 ** (8 * size)
    anywhere, head = rng.randrange(len(data) + 1), rng.randrange(min(len(data), 64) + 1)
    place = rng.choice((anywhere, head, max(len(data) - rng.randrange(64), 0)))
    return data[:place] + value.to_bytes(size, rng.choice(("little", "big"))) + data[place + size :]


def _noise(rng: Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.randbytes(rng.choice((1, 16, 300))) + data[place:]


_DAMAGES = (_flip, _flip, _cut, _repeat, _splice, _length, _length, _noise)


def mutate_json(rng: Random, data: bytes) -> bytes:
    """A JSON text, mostly still JSON."""
    if rng.random() < 0.1:
        return damaged(rng, data)
    text = json.dumps(mutate_tree(rng, json.loads(data)))
    return _with_raw(rng, _with_twin(rng, text), _RAW).encode("utf-8", "surrogatepass")


def mutate_json_lines(rng: Random, data: bytes) -> bytes:
    """A file of JSON lines: one or two of them changed, doubled, torn or in another order."""
    lines = data.splitlines(keepends=True)
    for _ in range(rng.choice((1, 1, 2))):
        place = rng.randrange(len(lines))
        change = rng.randrange(8)
        if change < 5:
            try:
                lines[place] = mutate_json(rng, lines[place].strip()) + b"\n"
            except (ValueError, RecursionError):  # it is none any more
                lines[place] = damaged(rng, lines[place])
        elif change == 5:
            lines.insert(place, lines[rng.randrange(len(lines))] * rng.choice((1, 3, 1_000)))
        elif change == 6:
            lines[place] = rng.choice((b"\n", b"null\n", b"[]\n", b"\xff\n", b"{", lines[place].rstrip()))
        else:
            rng.shuffle(lines)
    return b"".join(lines)


def mutate_yaml(rng: Random, data: bytes) -> bytes:
    """A YAML text, mostly still YAML."""
    choice = rng.random()
    if choice < 0.1:
        return damaged(rng, data)
    if choice < 0.15:
        return alias_bomb(rng.choice((3, 9)))
    header = data.partition(b"\n")[0].decode(errors="replace") + "\n" if data.startswith(b"#") else ""
    tree = mutate_tree(rng, yaml.safe_load(data))
    try:
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=rng.choice((False, None, True)))
    except (yaml.YAMLError, RecursionError, ValueError):
        text = json.dumps(tree)
    return (header + _with_raw(rng, text, (*_RAW, *_RAW_YAML))).encode("utf-8", "surrogatepass")


def alias_bomb(levels: int) -> bytes:
    """Nine values that each name the one before nine times: 9 ** levels where somebody walks through them."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    for level in range(1, levels):
        before = f"*a{level - 1}"
        lines.append(f"a{level}: &a{level} [{', '.join([before] * 9)}]")
    return "\n".join(lines).encode()


def mutate_tree(rng: Random, tree: Any) -> Any:
    """The tree with one to three changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        path = _somewhere(rng, tree)
        tree = _replaced(tree, path, rng.choice(_CHANGES)(rng, _at(tree, path)))
    return tree


def _odd(rng: Random, value: Any) -> Any:
    return rng.choice(ODD)


def _swap_type(rng: Random, value: Any) -> Any:
    if isinstance(value, bool) or value is None:
        return rng.choice((str(value).lower(), int(bool(value)), [value]))
    if isinstance(value, int | float):
        return rng.choice((str(value), [value], float(value) if abs(value) < 1e300 else 0.5, {"value": value}))
    if isinstance(value, str):
        return rng.choice(([value], {value: value}, len(value), list(value), value.encode(errors="replace").hex()))
    if isinstance(value, list):
        return rng.choice(({str(number): one for number, one in enumerate(value)}, str(value), len(value)))
    return rng.choice((list(value), list(value.values()), [list(pair) for pair in value.items()], str(value)))


def _shift(rng: Random, value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return rng.choice((-value, value + 1, value - 1, value * 1_000_000_000, value + 0.5 if value < 1e300 else 0.5))
    if isinstance(value, str):
        value = value[:1_000]
        return rng.choice((value + "x", "../" + value, value + "/../x", value.upper(), value * 1_000, value[:-1], "é"))
    if isinstance(value, list):
        return rng.choice((value[:-1], value[::-1], value * 2, value[:1] * 1_000, [*value, *value[:1]]))
    if value is None:
        return "None"
    keys = list(value)
    rng.shuffle(keys)
    return {key: value[key] for key in keys}


def _remove(rng: Random, value: Any) -> Any:
    if isinstance(value, list | dict) and value:
        gone = rng.randrange(len(value))
        if isinstance(value, list):
            return [one for number, one in enumerate(value) if number != gone]
        return {key: one for number, (key, one) in enumerate(value.items()) if number != gone}
    return None


def _add(rng: Random, value: Any) -> Any:
    if isinstance(value, dict):
        return {**value, rng.choice(("", "x", "../x", "__class__", "type", "x" * 1_000)): rng.choice(ODD)}
    return [*value, rng.choice(ODD)] if isinstance(value, list) else [value, rng.choice(ODD)]


def _rename(rng: Random, value: Any) -> Any:
    if not isinstance(value, dict) or not value:
        return rng.choice(ODD)
    old = rng.choice(list(value))
    new = rng.choice((f"{old}x", "../x", "x/../../y", "", "é", str(old) * 50, "observation.images.../../x"))
    return {new if key == old else key: one for key, one in value.items()}


def _nest(rng: Random, value: Any) -> Any:
    for _ in range(rng.choice((1, 2, 50, 300))):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return value


def _raw_text(rng: Random, value: Any) -> Any:
    return _MARK


_CHANGES: tuple[Callable[[Random, Any], Any], ...] = (
    *(_odd, _odd, _odd, _swap_type, _swap_type, _shift, _shift, _remove, _add, _rename, _nest, _raw_text),
)


def _somewhere(rng: Random, tree: Any) -> Path:
    """A node: down from the root, so that long lists do not take all."""
    path: Path = []
    while isinstance(tree, list | dict) and tree and rng.random() < 0.8:
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        path.append(key)
        tree = tree[key]
    return path


def _at(tree: Any, path: Path) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def _replaced(tree: Any, path: Path, value: Any) -> Any:
    if not path:
        return value
    copy = tree.copy()
    copy[path[0]] = _replaced(tree[path[0]], path[1:], value)
    return copy


def _with_raw(rng: Random, text: str, raw: tuple[str, ...]) -> str:
    """What stands for a raw text, in or without quotes, becomes one."""
    return re.sub(rf"([\"']?){_MARK}\1", lambda found: rng.choice(raw), text, count=2)


def _with_twin(rng: Random, text: str) -> str:
    """Now and then, the first key twice."""
    if not text.startswith('{"') or rng.random() < 0.95:
        return text
    key = text[1 : text.index('"', 2) + 1]
    return f"{{{key}: {rng.choice(('null', '1', '[]'))}, {text[1:]}"
