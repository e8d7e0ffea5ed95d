"""A process that forks pushes and pulls and kills them: run by `test_kills`, as that has servers' threads of its own.

Reads a line of JSON a command ({"do", "url", "folder", "after"}), answers with one: how the child ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from pathlib import Path

from manip_il.store import file_store, s3_store, sftp_store
from manip_il.store.pull import pull
from manip_il.store.push import push
from manip_il.store.remote import RemoteUrl, open_remote

IMPORTED = (file_store, s3_store, sftp_store)  # before the fork, so that a kill meets work and not imports


def work(do: str, url: RemoteUrl, folder: Path) -> None:
    def silent(total: int, what: str):
        return contextlib.nullcontext(lambda _: None)

    if do == "push":
        push(folder, url, open_remote(url), silent)
    else:
        pull(url, open_remote(url), folder, silent)


def main() -> None:
    sftp_store.LOCK_STALE, sftp_store.LOCK_REFRESH = 1.5, 0.3  # many locks are left here
    for line in sys.stdin:
        command = json.loads(line)
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            code = 1
            try:
                work(command["do"], RemoteUrl.parse(command["url"]), Path(command["folder"]))
                code = 0
            finally:
                os._exit(code)
        if command["after"] is not None:
            time.sleep(command["after"])
            os.kill(child, signal.SIGKILL)  # a child that has ended is still ours to wait for
        _, status = os.waitpid(child, 0)
        ended = "killed" if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
        print(json.dumps({"ended": ended, "seconds": time.monotonic() - start}), flush=True)


if __name__ == "__main__":
    main()
