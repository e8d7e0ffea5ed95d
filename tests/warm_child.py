"""A process that has imported torch, LeRobot and its commands.

Every command runs in a fork of it, at once.

Nothing of this project is imported unless named on the command line: LeRobot must find it by
itself. One JSON object a line comes in, `{"words", "folder", "out", "err"}`, the words those of a
shell; the exit code goes out.
"""

import atexit
import gc
import importlib
import json
import os
import runpy
import sys
import threading
import traceback
from importlib.metadata import entry_points
from typing import NoReturn

LEROBOT = (
    "accelerate",
    "lerobot.datasets.lerobot_dataset",
    "lerobot.policies.act.modeling_act",
    "lerobot.scripts.lerobot_edit_dataset",
    "lerobot.scripts.lerobot_eval",
    "lerobot.scripts.lerobot_train",
    "torchcodec.decoders",
)


def become(words: list[str], folder: str, out: str, err: str) -> NoReturn:
    """Run the command and end as Python does, but for taking everything apart, which takes
    longer than to start.
    """
    code = 1
    try:
        work(words, folder, out, err)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def work(words: list[str], folder: str, out: str, err: str) -> None:
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
    gc.freeze()  # else every fork's first collection copies all that was imported
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            become(**json.loads(line))
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
