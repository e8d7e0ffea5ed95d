"""The folders that documented commands take for granted, each made once, when it is first
needed, and small.
"""

import shutil
from pathlib import Path

from ..boards import write as write_board
from ..robots.own import model_of, write
from .ours import Ours
from .pages import ROOT, command_of
from .sizes import small_words

_EXPERT = "eval --policy.type=expert"
RECIPES = {  # folder -> the command that makes it, relative to the same place
    "datasets/demos": "record --dataset.root=datasets/demos",
    "datasets/demos.journals": "record --dataset.root=datasets/demos",
    "datasets/seen": "record --cameras=front,wrist --dataset.root=datasets/seen",
    "datasets/more": "record --dataset.root=datasets/more",
    **dict.fromkeys(
        ("datasets/session", "datasets/session.journals"),
        "record --robot.type=so101 --task.type=lift --dataset.root=datasets/session",
    ),
    "datasets/rest": (
        "record --robot.type=so101 --task.type=lift --cameras=front,wrist"
        " --dataset.root=datasets/rest"
    ),
    "runs/arm": "train --policy.type=cnn --dataset.root=datasets/rest --output_dir=runs/arm",
    "datasets/carry": "record --task.type=carry --dataset.root=datasets/carry",
    "runs/irl": "irl datasets/carry --output_dir=runs/irl",
    "demos_mcap": "data to-mcap datasets/demos demos_mcap",
    "runs/act": "train --policy.type=act --dataset.root=datasets/demos --output_dir=runs/act",
    "runs/cloned": "train --dataset.root=datasets/demos --output_dir=runs/cloned",
    "policy": "train --dataset.root=datasets/demos --output_dir=policy",
    "runs/dagger": "dagger --output_dir=runs/dagger",
    "runs/cloning": "dagger --method=cloning --output_dir=runs/cloning",
    "pairs.json": "reward pairs runs/dagger --output=pairs.json",
    "preferences.json": "reward answer pairs.json --sources=runs/dagger --output=preferences.json",
    "runs/reward": (
        "reward fit pairs.json preferences.json --sources=runs/dagger --output_dir=runs/reward"
    ),
    "runs/eval": f"{_EXPERT} --output_dir=runs/eval",
}
# what a file names, and a command that is given the file reads
READ_BY = {"pairs.json": "runs/dagger"}
ARM = Path("my_arm.yaml")
SAMPLE = "datasets/sample"  # comes with the repository
BOARD = "datasets/board"  # of `robot align`
_OUTPUTS = ("output", "output_dir", "output-dir", "video", "new_root", "log")
# make their second
_TARGETS = ("data build", "data render", "data to-mcap", "data from-mcap", "pull")


class Stock:
    """Makes and keeps them in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def bring(self, words: tuple[str, ...], target: Path, ours: Ours) -> None:
        """Put what a line reads, and nobody has made there yet, into `target`."""
        given = inputs(words)
        for path in (*given, *(READ_BY[one] for one in given if one in READ_BY)):
            if path == ARM.name and not (target / path).exists():
                write(target, name=ARM.stem)
            if path.endswith(".xml") and not (target / path).exists():
                (target / path).write_text(model_of())
            name = next(
                (name for name in (*RECIPES, SAMPLE, BOARD) if f"{path}/".startswith(f"{name}/")),
                None,
            )
            if name is None or (target / name).exists():
                continue
            made = self._made(name, ours)
            if made != target / name:
                (shutil.copytree if made.is_dir() else shutil.copy)(made, target / name)

    def _made(self, name: str, ours: Ours) -> Path:
        if name == SAMPLE:
            return ROOT / SAMPLE
        if name == BOARD and not (self.folder / name).exists():
            write_board(self.folder / name)
        if not (self.folder / name).exists():
            words = tuple(RECIPES[name].split())
            self.bring(("manip-il", *words), self.folder, ours)
            ours.run(small_words(words), self.folder, f"to make {name}")
        return self.folder / name


def inputs(words: tuple[str, ...]) -> list[str]:
    """The words of a line, and the values of its options, that may name what it reads."""
    program, rest = words[0], words[1:]
    name, own = command_of(rest) if program == "manip-il" else ("", list(rest))
    made_by_record = name == "record" and not any(word.startswith("--resume") for word in own)
    found: list[str] = []
    places = 0
    for word in own:
        option, _, value = word[2:].partition("=") if word.startswith("--") else ("", "", word)
        if not option:
            places += 1
        is_output = option in _OUTPUTS or (option == "dataset.root" and made_by_record)
        if not is_output and not (not option and places == 2 and name in _TARGETS):
            found.append(value.removeprefix("./"))
    return found
