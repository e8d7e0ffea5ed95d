"""LeRobot's commands without their seconds of import: this process has imported them, each line runs in a fork.

One JSON object a line comes in, `{"words", "folder", "log"}`; the exit code goes out.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from importlib.metadata import entry_points

import accelerate
from lerobot.policies.act import modeling_act
from lerobot.scripts import lerobot_eval, lerobot_train

from manip_il import lerobot_plugin

PRELOADED = (accelerate, modeling_act, lerobot_eval, lerobot_train, lerobot_plugin)


def work(words: list[str], folder: str, log: str) -> int:
    os.chdir(folder)
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(target, 1)
    os.dup2(target, 2)
    sys.argv = words
    try:
        entry_points(group="console_scripts")[words[0]].load()()
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def main() -> None:
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            code = work(**json.loads(line))
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
