"""A folder of another machine that runs sshd: `sftp://me@machine/srv/demos`. Keys and known hosts are those of ssh."""

from __future__ import annotations

import contextlib
import hashlib
import posixpath
import secrets
import shlex
import stat
import time
from collections.abc import Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

from manip_il.errors import UsageError
from manip_il.store.blobs import OBJECTS, STALE, Stored
from manip_il.store.errors import NoSpaceError, NotFoundError, RemoteError, TransientError
from manip_il.store.manifest import LONGEST_TEXT
from manip_il.store.object_store import ObjectRemote, wrong_when_read
from manip_il.store.remote import MANIFEST_FILE, Advance
from manip_il.store.sftp_connection import Connection, Sftp
from manip_il.store.sftp_lock import LOCK, Held, hold
from manip_il.store.sftp_reads import read_ahead
from manip_il.store.url import RemoteUrl

REQUEST = 32_600  # of what is written at a time: with 32,768 each one would travel in two packets [bytes]
HASH_TIME = 600.0  # the other machine may take so long over sha256sum [s]


def open_sftp(url: RemoteUrl) -> ObjectRemote:
    """Return the remote of an `sftp://` URL; nothing is connected yet."""
    return ObjectRemote(SftpBlobs(url))


class SftpBlobs:
    """`Blobs` on another machine. Two pushes are kept apart by a lock file, made where there is none."""

    threads = 4

    def __init__(self, url: RemoteUrl):
        self._name = str(url)
        self._root = url.place[3:] if url.place.startswith("/~/") else url.place
        self._connection = Connection(url)
        self.warnings: tuple[str, ...] = ()
        self._folders: set[str] = set()
        self._left: list[str] = []

    def describe(self) -> str:
        """Return the URL, without the password."""
        return self._name

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
                    raise UsageError(f"{self._name} is a file; expected a folder, or a name that is free")
                names = {name for name in sftp.listdir(self._root) if not name.startswith(".")}
            if names and not names & {MANIFEST_FILE, OBJECTS}:
                raise UsageError(f"{self._name} holds other files; name an empty or a new folder to push to")
            folder = "/" if self._root.startswith("/") else ""
            for part in f"{self._root}/{OBJECTS}".strip("/").split("/"):
                folder = posixpath.join(folder, part)
                _make_folder(sftp, folder)

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest where it still has the token `before`; None where it has not."""
        partial = self._at(f".{secrets.token_hex(8)}.partial")
        with self._sftp("write to") as sftp, self._locked(sftp) as mine:
            found = self.manifest()
            if (found[1] if found else None) != before:
                return None
            self._send(sftp, partial, data)
            if not mine():
                sftp.remove(partial)
                raise TransientError(f"another push took over {self._name}, as this one seemed dead")
            sftp.posix_rename(partial, self._at(MANIFEST_FILE))
        return hashlib.sha256(data).hexdigest()

    def fetch(self, key: str, target: BinaryIO, offset: int) -> None:
        """Read an object from `offset` on, many requests under way at a time."""
        with self._sftp("read") as sftp:
            try:
                file = sftp.open(self._path(key), "rb")
            except FileNotFoundError:
                raise NotFoundError(f"{self._name} has no object {key[:12]}") from None
            with file:
                for chunk in read_ahead(sftp, file, offset, file.stat().st_size or 0):
                    target.write(chunk)

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Send under another name and rename; what has arrived is looked at later, for many objects at once."""
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
        """Those of `keys` that are there."""
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
        """Those that are not what their name says: hashed over there where that can be had, else read back."""
        right = self._hashed_there(sizes)
        return wrong_when_read(self, [key for key in sizes if key not in right])

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects, and what killed pushes left, unless another push has been."""
        with self._sftp("write to") as sftp, self._locked(sftp) as mine:
            found = self.manifest()
            if found is None or found[1] != token:
                return
            for path in [*map(self._path, keys), *self._left]:
                if not mine():
                    return
                with contextlib.suppress(FileNotFoundError):
                    sftp.remove(path)

    def _hashed_there(self, keys: Iterable[str]) -> set[str]:
        """Objects of which `sha256sum`, run on the other machine, says what their name says; empty without a shell."""
        names = b"".join(f"{key[:2]}/{key}\0".encode() for key in keys)
        # OpenSSL uses the processor's own instructions, which are several times as quick as most sha256sum.
        tool = "if command -v openssl >/dev/null; then xargs -0 openssl dgst -sha256 -r; else xargs -0 sha256sum; fi"
        output = self._connection.answer(f"cd {shlex.quote(self._at(OBJECTS))} && {tool}", names, HASH_TIME)
        rows = [line.split() for line in output.splitlines()]
        return {row[0] for row in rows if len(row) == 2 and row[1].lstrip("*") == f"{row[0][:2]}/{row[0]}"}

    def _locked(self, sftp: Sftp) -> contextlib.AbstractContextManager[Held]:
        return hold(Held(sftp, self._at(LOCK)), self._name, self._touch_lock)

    def _touch_lock(self) -> None:
        with self._sftp("write to") as sftp:
            sftp.utime(self._at(LOCK), None)

    def _send(self, sftp: Sftp, path: str, data: bytes) -> None:
        with sftp.open(path, "wbx") as out:
            out.set_pipelined(True)
            out.write(data)
        if sftp.stat(path).st_size != len(data):
            raise NoSpaceError(f"{self._name} did not store the whole manifest; make room there and push again")

    @contextlib.contextmanager
    def _sftp(self, what: str) -> Generator[Sftp]:
        with self._connection.sftp(f"{what} {self._name}") as sftp:
            yield sftp

    def _at(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _path(self, key: str) -> str:
        return self._at(f"{OBJECTS}/{key[:2]}/{key}")


def _make_folder(sftp: Sftp, path: str) -> None:
    try:
        sftp.mkdir(path)
    except OSError as error:
        try:
            sftp.stat(path)  # it was there, or somebody else has made it meanwhile
        except FileNotFoundError:
            raise error from None


def _stored(item: object) -> Stored:
    size, modified = getattr(item, "st_size", 0), getattr(item, "st_mtime", 0)
    return Stored(size or 0, time.time() - (modified or 0))
