"""Remotes other than the Hub, through fsspec: objects named by the sha256 of their bytes, and one
manifest.

    PLACE/manip_il_manifest.json       replaced last, atomically: readers see one version
         /objects/3f/3f9a...           each file's bytes, never changed

Nothing is ever removed, so that readers of older versions can finish, and a push that comes back
to older files sends nothing.
"""

import hashlib
import re
import secrets
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any, override

import fsspec
from fsspec.callbacks import TqdmCallback
from fsspec.implementations.local import LocalFileSystem

from manip_il import checks
from manip_il.bridges.store.errors import RemoteError, explained
from manip_il.bridges.store.manifest import MANIFEST_FILE, Arrival, Kind, Manifest, PushPlan
from manip_il.errors import UnknownName, UsageError

# for object stores: no stale listings
_FRESH = {"skip_instance_cache": True, "use_listings_cache": False}
_S3 = {"max_concurrency": 4, "config_kwargs": {"read_timeout": 120}, **_FRESH}
_OPTIONS: dict[str, dict[str, Any]] = {"file": {"auto_mkdir": True}, "s3": _S3, "sftp": {}}
_SFTP = re.compile(
    r"sftp://([^@:/]+(:[^@:/]*@|@))?(\[[0-9a-f:.]+\]|[^@:/\[\]]+)"
    r"(:[1-5]?\d{1,4}|:6[0-4]\d{3}|:65[0-4]\d{2}|:655[0-2]\d|:6553[0-5])?/[^@]+"
)
# concurrent files; s3fs has ten connections, and keeps up to 200 MB of every file in memory that it
# sends
_AT_ONCE = 10
_SENT_AT_ONCE = 5


class Local(LocalFileSystem):
    """This machine's files, of which a pull reads only regular ones."""

    @override
    def get_file(self, path1: Any, path2: Any, callback: Any = None, **kwargs: Any) -> None:
        """Copy a file and count its bytes.

        Args:
            path1: The file to copy.
            path2: The new file.
            callback: The `Arrival` that counts the bytes.
            kwargs: Ignored.

        Raises:
            RemoteError: if it is not a regular file, or has more bytes than expected.
        """
        with checks.open_outside(Path(path1), "a file of a push", RemoteError) as source:
            callback.copy(source, path2)


class Objects:
    """A folder in any file system that fsspec supports.

    Attributes:
        at_once: Number of files that are transferred concurrently.
        name: The URL without a password, for messages.
        quiet: Whether progress bars are hidden.
    """

    kind: Kind | None = None  # the address does not say which

    def __init__(self, scheme: str, url: str, *, quiet: bool = False):
        """Parse the URL of a folder, without connecting to its server.

        Args:
            scheme: The part of the URL before `://`.
            url: The whole URL.
            quiet: Whether to hide progress bars.

        Raises:
            UnknownName: if fsspec does not know the scheme.
            UsageError: if the scheme's package is not installed, or the address is invalid.
        """
        self._scheme, self.quiet = scheme, quiet
        self.name = re.sub(r"(?<=://)([^/@:]*):.*@", r"\1@", url)
        try:
            if scheme == "sftp":
                from manip_il.bridges.store.sftp import Sftp  # paramiko is an extra

                self._class: Any = Sftp
            else:
                self._class = Local if scheme == "file" else fsspec.get_filesystem_class(scheme)
        except ImportError as error:
            how = "pip install 'manip_il[sharing]'" if scheme in _OPTIONS else error
            raise UsageError(f"{scheme}:// needs another package: {how}") from None
        except ValueError:
            raise UnknownName(
                "scheme",
                f"{scheme}://",
                ("hf://", "s3://", "sftp://", "file://", "gs://", "az://"),
            ) from None
        if scheme == "sftp" and not _SFTP.fullmatch(url):
            raise UsageError(
                "the sftp:// address is invalid; expected sftp://[USER@]HOST[:PORT]/FOLDER; in a"
                " password write / as %2F, @ as %40, : as %3A"
            )
        self.at_once = _AT_ONCE if self._class.async_impl else 1
        self._login, place = (
            self._class._get_kwargs_from_urls(url),
            self._class._strip_protocol(url),
        )
        self._root = place.removeprefix("/~/").rstrip("/")  # relative to the user's home
        self._manifest = f"{self._root}/{MANIFEST_FILE}"

    @cached_property
    def _fs(self) -> Any:
        return self._class(**self._login, **_OPTIONS.get(self._scheme, _FRESH))

    def read(self) -> Manifest | None:
        """Return the current version; None if there is none."""
        with explained(f"read {self.name}"):
            try:
                info = self._fs.info(self._manifest)
            except (FileNotFoundError, NotADirectoryError):
                return None
            with tempfile.NamedTemporaryFile() as arrived:
                self._fs.get_file(
                    self._manifest, arrived.name, callback=Arrival(checks.LARGEST_READ)
                )
                data = arrived.read()
            return Manifest.from_json(data, info.get("ETag") or hashlib.sha256(data).hexdigest())

    def write(self, plan: PushPlan) -> None:
        """Upload missing objects, then replace the manifest."""
        with explained(f"push to {self.name}"):
            found = self._fs.find(f"{self._root}/objects", detail=True)
            if links := [
                name for name, info in found.items() if info.get("islink") or info["type"] == "link"
            ]:
                raise RemoteError(
                    f"{links[0]} is a link, and nothing is written through links; remove it there"
                )
            there = {name.rpartition("/")[2]: info["size"] for name, info in found.items()}
            files = plan.manifest.files
            missing = {
                file.sha256: path
                for path, file in files.items()
                if there.get(file.sha256) != file.size
            }
            sources = [str(plan.local[path]) for path in missing.values()]
            bar = TqdmCallback({"desc": "push", "unit": " files", "disable": self.quiet or None})
            at_once = {"batch_size": _SENT_AT_ONCE} if self._fs.async_impl else {}
            self._fs.put(sources, [self._object(key) for key in missing], callback=bar, **at_once)
            for path in missing.values():
                if plan.local[path].stat().st_size != files[path].size:
                    raise RemoteError(
                        f"{plan.local[path]} was modified during the push; push again"
                    )
            before = plan.before or Manifest(plan.manifest.kind, {})
            if files != before.files:
                self._switch(plan.manifest, before.version)

    def download(self, manifest: Manifest, folder: Path, path: str) -> None:
        """Download the object of one file, without checking its hash.

        Args:
            manifest: The version that the file belongs to.
            folder: Where the file is written, at its own path.
            path: The file's path in the manifest.

        Raises:
            RemoteError: if the server sends more bytes than the manifest says.
        """
        file = manifest.files[path]
        self._fs.get_file(
            self._object(file.sha256), str(folder / path), callback=Arrival(file.size)
        )

    def _switch(self, new: Manifest, before: str) -> None:
        """Replace the manifest if its version is still `before`: on S3 atomically, elsewhere
        after one more look.
        """

        def is_outdated() -> bool:
            return getattr(self.read(), "version", "") != before

        try:
            if is_outdated():
                raise FileExistsError
            if self._scheme in ("file", "sftp"):  # others replace a file atomically
                partial = f"{self._root}/.{MANIFEST_FILE}.{secrets.token_hex(8)}.partial"
                self._fs.pipe_file(partial, new.to_json())
                self._fs.mv(partial, self._manifest)
            else:
                condition = {"IfMatch": before} if before else {"IfNoneMatch": "*"}
                self._fs.pipe_file(
                    self._manifest, new.to_json(), **(condition if self._scheme == "s3" else {})
                )
        except OSError as error:
            if is_outdated():  # or this push succeeded, and its answer was lost
                raise RemoteError(
                    f"{self.name} was changed by another push in the meantime; push again"
                ) from error
            raise

    def _object(self, key: str) -> str:
        return f"{self._root}/objects/{key[:2]}/{key}"
