"""A lock file on another machine, which keeps two pushes apart: made only where there is none."""

from __future__ import annotations

import contextlib
import posixpath
import secrets
import threading
import time
from collections.abc import Callable, Generator

from manip_il.store.errors import RemoteError
from manip_il.store.sftp_connection import Sftp

LOCK = ".manip_il_push.lock"
LOCK_REFRESH = 3.0  # who holds the lock touches it so often [s]
LOCK_STALE = 15.0  # a lock that nobody was seen to touch for so long was left by a killed push [s]
LOCK_WAIT = 180.0  # [s]


@contextlib.contextmanager
def hold(held: Held, name: str, touch: Callable[[], None]) -> Generator[Held]:
    """Take a lock, and touch it while it is held; take away what a killed push left.

    touch: sets the file's time, on a channel of its own. name: of the place, for messages.
    """
    last = time.monotonic() + LOCK_WAIT
    seen, since = ("", 0), time.monotonic()
    while not held.take():
        now = held.touched()
        if now != seen:
            seen, since = now, time.monotonic()
        if time.monotonic() - since > LOCK_STALE:
            held.break_open(seen[0])
        if time.monotonic() > last:
            raise RemoteError(f"another push is updating {name}; wait, and push again")
        time.sleep(0.1)
    done = threading.Event()
    toucher = threading.Thread(target=_keep_touching, args=(touch, done), daemon=True)
    toucher.start()
    try:
        yield held
    finally:
        done.set()
        toucher.join()
        held.release()


def _keep_touching(touch: Callable[[], None], done: threading.Event) -> None:
    with contextlib.suppress(RemoteError):  # then it goes stale, and who holds it is told when he asks
        while not done.wait(LOCK_REFRESH):
            touch()


class Held:
    """A lock file that is made only where there is none."""

    def __init__(self, sftp: Sftp, path: str):
        self._sftp, self._path, self._word = sftp, path, secrets.token_hex(16)

    def __call__(self) -> bool:
        """Whether it is still ours."""
        return self.seen() == self._word

    def take(self) -> bool:
        """Return whether it could be made."""
        try:
            with self._sftp.open(self._path, "wx") as file:
                file.write(self._word)
        except PermissionError:
            raise
        except OSError:  # SFTP has no word for "is there already"
            if not self.seen():
                self._sftp.stat(posixpath.dirname(self._path))  # says so where the folder itself is the problem
            return False
        return True

    def seen(self) -> str:
        """Return the word of who holds it; empty where nobody does."""
        try:
            with self._sftp.open(self._path, "r") as file:
                return file.read(64).decode(errors="replace")
        except FileNotFoundError:
            return ""

    def touched(self) -> tuple[str, int]:
        """Return the word of who holds it, and when that one last touched it, by the clock over there [s]."""
        word = self.seen()
        with contextlib.suppress(FileNotFoundError):
            return word, self._sftp.stat(self._path).st_mtime or 0
        return word, 0

    def break_open(self, word: str) -> None:
        """Take a dead push's lock away. Two that try are told apart by the rename, which one alone can do."""
        aside = f"{self._path}.{secrets.token_hex(6)}"
        with contextlib.suppress(FileNotFoundError):
            if self.seen() == word:
                self._sftp.posix_rename(self._path, aside)
                self._sftp.remove(aside)

    def release(self) -> None:
        """Remove it, if it is ours."""
        with contextlib.suppress(OSError, EOFError):
            if self():
                self._sftp.remove(self._path)
