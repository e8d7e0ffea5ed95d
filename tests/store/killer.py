"""A process that forks pushes and pulls and kills them: run by `test_kills`, as that has servers' threads of its own.

Reads one JSON object a line ({"do", "url", "folder", "after"}); answers with one that says how the child ended.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

from manip_il.cli.push_pull import open_remote
from manip_il.store import cards, file_store, hub, s3_store, sftp_store
from manip_il.store.pull import pull
from manip_il.store.push import push
from manip_il.store.remote import RemoteUrl

from .trees import unwatched

IMPORTED = (cards, file_store, hub, s3_store, sftp_store)  # before the fork, so that a kill meets work and not imports


def work(do: str, text: str, folder: Path) -> None:
    url = RemoteUrl.parse(text)
    if do == "push":
        push(folder, url, open_remote(url), unwatched)
    else:
        pull(url, open_remote(url), folder, unwatched)


def main() -> None:
    sftp_store.LOCK_STALE, sftp_store.LOCK_REFRESH = 1.5, 0.3  # many locks are left here
    for line in sys.stdin:
        command = json.loads(line)
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            code = 1
            try:
                work(command["do"], command["url"], Path(command["folder"]))
                code = 0
            except BaseException as error:
                print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
            os._exit(code)
        if command["after"] is not None:
            time.sleep(command["after"])
            os.kill(child, signal.SIGKILL)  # a child that has ended is still ours to wait for
        _, status = os.waitpid(child, 0)
        ended = "killed" if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
        print(json.dumps({"ended": ended, "seconds": time.monotonic() - start}), flush=True)


if __name__ == "__main__":
    main()
