"""A folder in which the lines of a page are run, one after the other, as a user would."""

import contextlib
import os
import re
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path

from manip_il.cli.main import load
from manip_il.cli.parsing import parse

from .ours import Ours
from .pages import ROOT, Block, Line, command_of, shell_lines
from .sizes import small_lerobot, small_words
from .stock import RECIPES, Stock

PROGRAM = "manip-il"
_NAMES = {"USER": "user", "NAME": "name", "//me/": "//user/", "datasets/me/": "datasets/user/"}
# its volumes, as folders of this place
_OF_A_CONTAINER = re.compile(r"(?:(?<=^)|(?<==))/(?=(?:policy|out)\b)")

LeRobot = Callable[[list[str], Path], None]


class Workplace:
    """Runs lines.

    A line that no rule covers is an error. ours: runs commands and code in the process of the page.
    """

    def __init__(self, folder: Path, ours: Ours, stock: Stock, lerobot: LeRobot) -> None:
        self.folder, self.ours, self.stock, self.lerobot = folder, ours, stock, lerobot

    def run_block(self, block: Block) -> None:
        """Every command of a shell block, a Python block, or what a YAML block is for."""
        match block.language:
            case "sh":
                for line in shell_lines(block):
                    self.run(line)
            case "python":
                self._python_block(block)
            case "yaml":
                self._yaml_block(block)
            case language:
                assert language in ("text", "toml"), f"{block.where}: the tests know no {language}"

    def run(self, line: Line) -> None:
        """One command, at a small size; fails unless it ends with exit code 0."""
        first = line.words[0]
        words = tuple(_OF_A_CONTAINER.sub("", _named(word)) for word in line.words)
        if first == PROGRAM:
            self.stock.bring(words, self.folder, self.ours)
            self._manip_il(words[1:], line)
        elif first.startswith("lerobot-"):
            self.stock.bring(words, self.folder, self.ours)
            self.lerobot(small_lerobot(words), self.folder)
        else:
            rule = RULES.get(first)
            assert rule is not None, f"{line}: no rule says how the tests run this"
            rule(self, line)

    def _manip_il(self, words: tuple[str, ...], line: Line) -> None:
        with contextlib.chdir(self.folder):
            small = small_words(words)
        self.ours.run(small, self.folder, str(line))

    def _python_block(self, block: Block) -> None:
        """`# NAME.py` in its first line names a file of the user's own for the lines that follow."""
        if named := re.fullmatch(r"# (\w+\.py)", block.text.splitlines()[0]):
            (self.folder / named[1]).write_text(block.text, encoding="utf-8")
        words = ("python", *(name for name in RECIPES if f'"{name}"' in block.text))
        self.stock.bring(words, self.folder, self.ours)
        self.ours.execute(block.text, self.folder, block.where)

    def _yaml_block(self, block: Block) -> None:
        """`# NAME.yaml` in its first line names the file for the lines that follow."""
        named = re.fullmatch(r"# ([\w.-]+\.yaml)", block.text.splitlines()[0])
        assert named, f"{block.where}: a YAML block without a name"
        (self.folder / named[1]).write_text(block.text, encoding="utf-8")

    def _make(self, line: Line) -> None:
        """What the target would run of this program.

        The rest of it is machinery that CI runs itself.
        """
        clean = {
            name: value
            for name, value in os.environ.items()
            if name not in ("MAKEFLAGS", "MAKELEVEL")
        }
        done = subprocess.run(
            ["make", "--dry-run", *line.words[1:]],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env=clean,
            check=False,
        )
        assert done.returncode == 0, f"{line}: {done.stderr}"
        for recipe in done.stdout.splitlines():
            if recipe.startswith(f".venv/bin/{PROGRAM} "):
                self.run(Line(line.where, (PROGRAM, *shlex.split(recipe)[1:])))

    def _docker(self, line: Line) -> None:
        """Building and running are CI's.

        What is asked of the program in the container must be words it knows.
        """
        _, _, asked = shlex.join(line.words).partition(f" {PROGRAM}")
        if line.words[1] == "run" and asked.strip():
            name, own = command_of(tuple(shlex.split(asked)))
            parse(load(name), own)

    def _python(self, line: Line) -> None:
        self.lerobot(["python", str(ROOT / line.words[1]), *line.words[2:], "--quick"], self.folder)

    def _mkdir(self, line: Line) -> None:
        subprocess.run(line.words, cwd=self.folder, check=True)

    def _not_run(self, line: Line) -> None:
        """CI, or the tests' own servers, have done it."""


RULES: dict[str, Callable[[Workplace, Line], None]] = {
    "make": Workplace._make,
    "docker": Workplace._docker,
    "python": Workplace._python,
    "mkdir": Workplace._mkdir,
    **dict.fromkeys(("export", ".", "apt-get"), Workplace._not_run),
}


def _named(word: str) -> str:
    for name, ours in _NAMES.items():
        word = word.replace(name, ours)
    return word
