"""A process that has imported torch, LeRobot and its commands; every command runs in a fork of it, at once.

Nothing of this project is imported unless named on the command line: LeRobot must find it by itself. One JSON object a
line comes in, `{"words", "folder", "out", "err"}`, the words those of a shell; the exit code goes out.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import sys
from importlib.metadata import entry_points

LEROBOT = (
    "accelerate",
    "lerobot.datasets.lerobot_dataset",
    "lerobot.policies.act.modeling_act",
    "lerobot.scripts.lerobot_edit_dataset",
    "lerobot.scripts.lerobot_eval",
    "lerobot.scripts.lerobot_train",
)


def work(words: list[str], folder: str, out: str, err: str) -> None:
    """Become the command."""
    os.chdir(folder)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    if words[0] != "python":
        sys.argv = words
        sys.exit(entry_points(group="console_scripts")[words[0]].load()())
    if words[1] == "-c":
        sys.argv = ["-c", *words[3:]]
        exec(words[2], {"__name__": "__main__"})
    else:
        sys.argv = words[1:]
        sys.path.insert(0, os.path.dirname(words[1]))
        runpy.run_path(words[1], run_name="__main__")


def main() -> None:
    for name in (*LEROBOT, *sys.argv[1:]):
        importlib.import_module(name)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            work(**json.loads(line))  # ends as Python does: with what is to be done at the exit, or a traceback
            return
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
