"""Objects in a folder of an SSH server: `sftp://me@machine/srv/demos`, with the keys and known hosts of ssh."""

from __future__ import annotations

import contextlib
import hashlib
import posixpath
import secrets
import shlex
import stat
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import paramiko

from manip_il.errors import UsageError
from manip_il.store.errors import NoSpaceError, NotFoundError, RemoteError, TransientError
from manip_il.store.manifest import LONGEST_TEXT
from manip_il.store.object_store import OBJECTS, STALE, Stored, wrong_when_read
from manip_il.store.remote import MANIFEST_FILE, Advance, RemoteUrl, Sink
from manip_il.store.sftp_connection import Connection, Sftp, read_ahead

REQUEST = 32_600  # of one write: 32,768 would travel in two packets [bytes]
HASH_TIME = 600.0  # that the other machine may take for sha256sum [s]
LOCK = ".manip_il_push.lock"
LOCK_REFRESH = 3.0  # between two touches by its owner [s]
LOCK_STALE = 15.0  # without a touch, after which a lock is taken for a killed push's [s]
LOCK_WAIT = 180.0  # for another push's lock [s]


class SftpBlobs:
    """`Blobs` on another machine. Two pushes are kept apart by a lock file."""

    threads = 4

    def __init__(self, url: RemoteUrl):
        self.name = str(url)
        self._root = url.place[3:] if url.place.startswith("/~/") else url.place
        self._connection = Connection(url)
        self.warnings: tuple[str, ...] = ()
        self._folders: set[str] = set()
        self._left: list[str] = []  # paths that killed pushes left

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and its hash."""
        with self._sftp("read") as sftp:
            try:
                with sftp.open(self._at(MANIFEST_FILE), "rb") as file:
                    data = b"".join(read_ahead(sftp, file, 0, min(file.stat().st_size or 0, LONGEST_TEXT + 1)))
            except FileNotFoundError:
                return None
        return data, hashlib.sha256(data).hexdigest()

    def prepare(self, size: int) -> None:
        """Make the folder; refuse one that holds something else."""
        with self._sftp("write to") as sftp:
            names: set[str] = set()
            with contextlib.suppress(FileNotFoundError):
                if not stat.S_ISDIR(sftp.stat(self._root).st_mode or 0):
                    raise UsageError(f"{self.name} is a file; expected a folder, or a name that is free")
                names = {name for name in sftp.listdir(self._root) if not name.startswith(".")}
            if names and not names & {MANIFEST_FILE, OBJECTS}:
                raise UsageError(f"{self.name} holds other files; name an empty or a new folder to push to")
            folder = "/" if self._root.startswith("/") else ""
            for part in f"{self._root}/{OBJECTS}".strip("/").split("/"):
                folder = posixpath.join(folder, part)
                _make_folder(sftp, folder)

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest if it still has the token `before`, and return its own; else None."""
        partial = self._at(f".{secrets.token_hex(8)}.partial")
        with self._sftp("write to") as sftp, self._locked(sftp) as lock:
            found = self.manifest()
            if (found[1] if found else None) != before:
                return None
            self._send(sftp, partial, data)
            if not lock.is_ours():
                sftp.remove(partial)
                raise TransientError(f"another push took over {self.name}, as this one seemed dead")
            sftp.posix_rename(partial, self._at(MANIFEST_FILE))
        return hashlib.sha256(data).hexdigest()

    def fetch(self, key: str, target: Sink, offset: int) -> None:
        """Read an object from `offset` on, many requests under way at a time."""
        with self._sftp("read") as sftp:
            try:
                file = sftp.open(self._path(key), "rb")
            except FileNotFoundError:
                raise NotFoundError(f"{self.name} has no object {key[:12]}") from None
            with file:
                for chunk in read_ahead(sftp, file, offset, file.stat().st_size or 0):
                    target.write(chunk)

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Send under another name and rename; `wrong` checks what has arrived, for many objects at once."""
        partial = self._at(f"{OBJECTS}/{key[:2]}/.{key[:12]}.{secrets.token_hex(6)}.partial")
        sent, digest = 0, hashlib.sha256()
        with self._sftp("write to") as sftp, source.open("rb") as file, ThreadPoolExecutor(1) as helper:
            if key[:2] not in self._folders:
                _make_folder(sftp, self._at(f"{OBJECTS}/{key[:2]}"))
                self._folders.add(key[:2])
            with sftp.open(partial, "wbx") as out:
                out.set_pipelined(True)
                out.MAX_REQUEST_SIZE = REQUEST
                while chunk := file.read(8 * REQUEST):
                    hashed = helper.submit(digest.update, chunk) if len(chunk) > REQUEST else None
                    out.write(chunk)
                    hashed.result() if hashed else digest.update(chunk)
                    sent += len(chunk)
                    advance(len(chunk))
            if digest.hexdigest() != key or sent != size:
                sftp.remove(partial)
                raise RemoteError(f"{source} changed while it was being pushed; push again when nobody writes to it")
            sftp.posix_rename(partial, self._path(key))
        return False

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Return those of `keys` that are there."""
        found: dict[str, Stored] = {}
        with self._sftp("read") as sftp:
            for key in keys:
                with contextlib.suppress(FileNotFoundError):
                    found[key] = _stored(sftp.lstat(self._path(key)))
        return found

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        found: dict[str, Stored] = {}
        self._left = []
        with self._sftp("list") as sftp:
            for folder in sftp.listdir(self._at(OBJECTS)):
                for item in sftp.listdir_attr(self._at(f"{OBJECTS}/{folder}")):
                    one = _stored(item)
                    if not item.filename.startswith("."):
                        found[item.filename] = one
                    elif one.age > STALE:
                        self._left.append(self._at(f"{OBJECTS}/{folder}/{item.filename}"))
        return found

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Return those that have other bytes: hashed on the other machine if it runs commands, else read back."""
        right = self._hashed_there(sizes)
        return wrong_when_read(self, [key for key in sizes if key not in right])

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects, and what killed pushes left, unless another push has been."""
        with self._sftp("write to") as sftp, self._locked(sftp) as lock:
            found = self.manifest()
            if found is None or found[1] != token:
                return
            for path in [*map(self._path, keys), *self._left]:
                if not lock.is_ours():
                    return
                with contextlib.suppress(FileNotFoundError):
                    sftp.remove(path)

    def _hashed_there(self, keys: Iterable[str]) -> set[str]:
        """Return the objects whose hash, computed on the other machine, is right; none if it runs no commands."""
        names = b"".join(f"{key[:2]}/{key}\0".encode() for key in keys)
        # OpenSSL uses the processor's own instructions, which are several times as quick as most sha256sum.
        tool = "if command -v openssl >/dev/null; then xargs -0 openssl dgst -sha256 -r; else xargs -0 sha256sum; fi"
        output = self._connection.run(f"cd {shlex.quote(self._at(OBJECTS))} && {tool}", names, HASH_TIME)
        rows = [line.split() for line in output.splitlines()]
        return {row[0] for row in rows if len(row) == 2 and row[1].lstrip("*") == f"{row[0][:2]}/{row[0]}"}

    def _locked(self, sftp: Sftp) -> contextlib.AbstractContextManager[_Lock]:
        def touch() -> None:
            with self._sftp("write to") as other:
                other.utime(self._at(LOCK), None)

        return _Lock(sftp, self._at(LOCK), self.name, touch).hold()

    def _send(self, sftp: Sftp, path: str, data: bytes) -> None:
        with sftp.open(path, "wbx") as out:
            out.set_pipelined(True)
            out.write(data)
        if sftp.stat(path).st_size != len(data):
            raise NoSpaceError(f"{self.name} did not store the whole manifest; make room there and push again")

    def _sftp(self, what: str) -> contextlib.AbstractContextManager[Sftp]:
        return self._connection.sftp(f"{what} {self.name}")

    def _at(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _path(self, key: str) -> str:
        return self._at(f"{OBJECTS}/{key[:2]}/{key}")


def _make_folder(sftp: Sftp, path: str) -> None:
    try:
        sftp.mkdir(path)
    except OSError as error:
        try:
            sftp.stat(path)  # it exists: another push may have made it meanwhile
        except FileNotFoundError:
            raise error from None


def _stored(item: paramiko.SFTPAttributes) -> Stored:
    return Stored(item.st_size or 0, time.time() - (item.st_mtime or 0))


class _Lock:
    """Lock file that keeps two pushes apart: made only where there is none, and touched while it is held.

    touch: sets the file's time, on a channel of its own. name: of the place, for messages.
    """

    def __init__(self, sftp: Sftp, path: str, name: str, touch: Callable[[], None]):
        self._sftp, self._path, self._name, self._touch = sftp, path, name, touch
        self._word = secrets.token_hex(16)  # the file's content says who holds it

    @contextlib.contextmanager
    def hold(self) -> Generator[_Lock]:
        """Take the lock, and remove one that a killed push left. Raises `RemoteError` if another push keeps it."""
        last = time.monotonic() + LOCK_WAIT
        seen, since = ("", 0), time.monotonic()
        while not self._take():
            now = self._owner(), self._touched()
            if now != seen:
                seen, since = now, time.monotonic()
            if time.monotonic() - since > LOCK_STALE:
                self._remove_stale(seen[0])
            if time.monotonic() > last:
                raise RemoteError(f"another push is updating {self._name}; wait, and push again")
            time.sleep(0.1)
        done = threading.Event()
        toucher = threading.Thread(target=self._keep_touching, args=(done,), daemon=True)
        toucher.start()
        try:
            yield self
        finally:
            done.set()
            toucher.join()
            with contextlib.suppress(OSError, EOFError):
                if self.is_ours():
                    self._sftp.remove(self._path)

    def is_ours(self) -> bool:
        """Return whether no other push has taken it over."""
        return self._owner() == self._word

    def _take(self) -> bool:
        try:
            with self._sftp.open(self._path, "wx") as file:
                file.write(self._word)
        except PermissionError:
            raise
        except OSError:  # SFTP has no code for a file that exists
            if not self._owner():
                self._sftp.stat(posixpath.dirname(self._path))  # raises if the folder itself is the problem
            return False
        return True

    def _owner(self) -> str:
        """Return the word of who holds it; empty if it is free."""
        try:
            with self._sftp.open(self._path, "r") as file:
                return file.read(64).decode(errors="replace")
        except FileNotFoundError:
            return ""

    def _touched(self) -> int:
        """Return when its owner last touched it, by the other machine's clock [s]."""
        with contextlib.suppress(FileNotFoundError):
            return self._sftp.stat(self._path).st_mtime or 0
        return 0

    def _remove_stale(self, word: str) -> None:
        """Remove a dead push's lock. Only one of two pushes that try it can do the rename."""
        aside = f"{self._path}.{secrets.token_hex(6)}"
        with contextlib.suppress(FileNotFoundError):
            if self._owner() == word:
                self._sftp.posix_rename(self._path, aside)
                self._sftp.remove(aside)

    def _keep_touching(self, done: threading.Event) -> None:
        with contextlib.suppress(RemoteError):  # then it becomes stale, and `is_ours` says so
            while not done.wait(LOCK_REFRESH):
                self._touch()
