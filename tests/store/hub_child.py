"""A process to kill: it pushes and pulls on command, each time in a fork of its own that starts at once.

One JSON object a line comes in, `{"do": "push" | "pull", "folder", "url"}`; the fork's process id goes out, and when it
has ended its exit code.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from manip_il.store.cards import card_for
from manip_il.store.hub import HubRemote
from manip_il.store.pull import pull
from manip_il.store.push import push
from manip_il.store.remote import RemoteUrl, open_remote

PRELOADED = (card_for, HubRemote)  # so that no fork has to import them


@contextlib.contextmanager
def silent(total: int, what: str) -> Iterator:
    yield lambda count: None


def work(do: str, folder: str, url: str) -> None:
    parsed = RemoteUrl.parse(url)
    remote = open_remote(parsed)
    if do == "push":
        push(Path(folder), parsed, remote, silent)
    else:
        pull(parsed, remote, Path(folder), silent)


def main() -> None:
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                work(**json.loads(line))
                code = 0
            except BaseException as error:
                print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
            os._exit(code)
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
