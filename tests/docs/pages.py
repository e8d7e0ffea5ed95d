"""What README, docs and help tell a user to type: fenced blocks, cut into lines of shell words."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from manip_il.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md")),
    "benchmarks/README.md",
    "datasets/README.md",
)
_FENCE = re.compile(r"^ *```(\w*)$")


@dataclass(frozen=True)
class Block:
    """One fenced block. line: of its first line in the page."""

    page: str
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


@dataclass(frozen=True)
class Line:
    """One command of a shell block."""

    where: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.where}: {shlex.join(self.words)}"


def blocks(page: str) -> list[Block]:
    """Every fenced block of a page, in its order."""
    found: list[Block] = []
    begin, language, inside = 0, None, []
    for number, line in enumerate((ROOT / page).read_text(encoding="utf-8").splitlines(), start=1):
        fence = _FENCE.match(line)
        if fence and language is None:
            begin, language, inside = number + 1, fence[1], []
        elif fence and language is not None:
            found.append(Block(page, begin, language, "\n".join(inside)))
            language = None
        elif language is not None:
            inside.append(line)
    assert language is None, f"{page}:{begin}: the block does not end"
    return found


def shell_lines(block: Block) -> Iterator[Line]:
    """The commands of a shell block, without comments; a list with `&&` is several."""
    pending, begin = "", block.line
    for number, text in enumerate(block.text.splitlines(), start=block.line):
        begin = begin if pending else number
        pending = f"{pending}{text}\n"
        if text.endswith("\\"):
            pending = pending[:-2]
            continue
        try:
            words = shlex.split(pending, comments=True)
        except ValueError:  # a quotation goes on in the next line
            continue
        pending = ""
        for part in _split(words, "&&"):
            yield Line(f"{block.page}:{begin}", tuple(part))
    assert not pending, f"{block.where}: the last command does not end"


def _split(words: list[str], separator: str) -> Iterator[list[str]]:
    part: list[str] = []
    for word in [*words, separator]:
        if word != separator:
            part.append(word)
        elif part:
            yield part
            part = []


def page_lines(page: str) -> list[Line]:
    """Every command in the shell blocks of a page."""
    return [line for block in blocks(page) if block.language == "sh" for line in shell_lines(block)]


def help_lines() -> list[Line]:
    """The example in the help of every command, and that of `manip-il --help`."""
    from manip_il.cli.main import _help, load

    texts = {name: str(load(name).__doc__).rpartition("Example: ")[2] for name in COMMANDS}
    examples = {f"{name} --help": " ".join(text.split()) for name, text in texts.items()}
    first = _help().rpartition("example: ")[2]
    assert first in examples.values(), (
        f"manip-il --help: {first!r} is not the example of its command"
    )
    return [Line(f"manip-il {name}", tuple(shlex.split(text))) for name, text in examples.items()]


def command_of(words: tuple[str, ...]) -> tuple[str, list[str]]:
    """The command after `manip-il`, of one word or two, and its own words."""
    name = " ".join(words[:2])
    return (name, list(words[2:])) if name in COMMANDS else (words[0], list(words[1:]))
