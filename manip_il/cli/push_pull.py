"""`manip-il push` and `manip-il pull`: upload and download of a dataset or a policy."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.inputs import require_folder
from manip_il.cli.interrupt import Interrupted
from manip_il.cli.outputs import require_ours, require_short_path
from manip_il.cli.progress import bytes_text, progress, say, warn
from manip_il.errors import FolderExistsError, UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.store.push import Plan
    from manip_il.store.remote import Remote, RemoteUrl

DISPLAY_EVERY = 0.1  # between two updates of the display [s]


@contextmanager
def show_bytes(total: int, what: str) -> Generator[Callable[[int], None]]:
    """Show the progress of a transfer of `total` bytes; the callback adds bytes, from any thread."""
    if not total:
        yield lambda count: None
        return
    lock, displayed = threading.Lock(), time.monotonic()
    done = waiting = 0

    def advance(count: int) -> None:
        nonlocal done, waiting, displayed
        with lock:
            done, waiting = done + count, waiting + count
            now = time.monotonic()
            if now - displayed >= DISPLAY_EVERY or done >= total:
                bar.advance(waiting)
                waiting, displayed = 0, now

    with progress(total, what, of_bytes=True) as bar:
        yield advance


@contextmanager
def resumable() -> Generator[None]:
    """Have Ctrl-C answer that the same command resumes the transfer."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("what has been transferred so far", "the same command") from None


@dataclass
class PushOptions:
    """Push a dataset, or a policy with its run, to the Hugging Face Hub, an S3 store, another machine or a folder.

    A dataset is checked first, as by manip-il data check, and refused if it has errors. Only changes are uploaded.
    Readers see the old version until the new one is complete and verified. Interrupted transfers resume: run the same
    command again. Of two concurrent pushes one succeeds, and the other says so.
    """

    example: ClassVar[str] = "manip-il push datasets/demos hf://datasets/me/demos"
    source: Path = option(MISSING, "folder of a dataset, a run or a policy", positional=True)
    remote: str = option(
        MISSING,
        "hf://datasets/USER/NAME, hf://USER/NAME, s3://BUCKET/FOLDER, sftp://HOST/FOLDER, file://FOLDER",
        positional=True,
    )
    dry_run: bool = option(False, "only list what would be uploaded and removed")
    journals: bool = option(False, "include the journals, from which the dataset can be rebuilt")
    private: bool = option(False, "make a new repository on the Hub private")

    def check(self) -> None:
        """Refuse an invalid address, and a missing folder."""
        from manip_il.store.remote import RemoteUrl

        RemoteUrl.parse(self.remote)
        require_folder(self.source, "the folder of a dataset, a run or a policy")

    def run(self) -> None:
        """Examine, list, upload, switch over; print what was done."""
        from manip_il.store.push import push
        from manip_il.store.remote import RemoteUrl

        url = RemoteUrl.parse(self.remote)
        remote = open_remote(url, private=self.private)
        try:
            with resumable():
                plan, published = push(
                    self.source, url, remote, show_bytes, journals=self.journals, dry_run=self.dry_run
                )
        finally:
            warn(*remote.warnings)
        if published is None:
            _say_plan(plan, url)
            return
        if published.uploaded or published.removed:
            counts = f"{published.uploaded} files, {bytes_text(published.size)}, uploaded"
            say(f"{url}: {counts}; {published.removed} removed; {published.kept} unchanged")
        else:
            say(f"{url}: {published.kept} files, all there already")
        say(f"next: manip-il pull {url} FOLDER")


def _say_plan(plan: Plan, url: object) -> None:
    for path in plan.upload:
        say(f"upload   {path} ({bytes_text(plan.manifest.by_path[path].size)})")
    for path in plan.remove:
        say(f"remove   {path}")
    kept = len(plan.manifest.files) - len(plan.upload)
    upload = f"{len(plan.upload)} files, {bytes_text(plan.size)}, to upload"
    say(f"{url}: {upload}; {len(plan.remove)} to remove; {kept} unchanged; nothing was done")


@dataclass
class PullOptions:
    """Pull a dataset or a policy from the Hugging Face Hub, an S3 store, another machine or a folder.

    Every file is verified by its hash before the folder appears. Interrupted transfers resume: run the same command
    again. Paths that leave the folder, links, pickles and code are refused; nothing that is pulled is executed.
    """

    example: ClassVar[str] = "manip-il pull hf://datasets/me/demos datasets/demos"
    remote: str = option(MISSING, "what manip-il push was given, or any repo of the Hub", positional=True)
    target: Path = option(MISSING, "new folder for it", positional=True)
    revision: str | None = option(None, "branch, tag or commit of a repo on the Hub")
    dry_run: bool = option(False, "only list what would be pulled")
    overwrite: bool = option(False, "replace an existing dataset or run")

    def check(self) -> None:
        """Refuse an invalid address, and a folder that may not be replaced."""
        self._url()
        require_short_path(self.target)
        if self.overwrite and self.target.is_dir() and any(self.target.iterdir()):
            require_ours(self.target)

    def run(self) -> None:
        """Fetch, verify, rename; print what was pulled."""
        from manip_il.store.pull import pull

        url = self._url()
        remote = open_remote(url)
        try:
            with resumable():
                pulled = pull(url, remote, self.target, show_bytes, overwrite=self.overwrite, dry_run=self.dry_run)
        except FolderExistsError:
            remedy = "replace them with --overwrite=true, or name a new folder"
            raise UsageError(f"{self.target} or its journals exist already; {remedy}") from None
        finally:
            warn(*remote.warnings)
        manifest = pulled.manifest
        if self.dry_run:
            for entry in manifest.files:
                say(f"pull     {entry.path} ({bytes_text(entry.size)})")
        size = f"a {manifest.kind} of {len(manifest.files)} files, {bytes_text(manifest.size)}"
        kept = f", of which {bytes_text(pulled.kept)} had been transferred before" if pulled.kept else ""
        say(f"{url}: {size}; nothing was done" if self.dry_run else f"{self.target}: {size}, all verified{kept}")
        if not self.dry_run and manifest.kind == "dataset":
            say(f"next: manip-il data check {self.target}")

    def _url(self) -> RemoteUrl:
        from manip_il.store.remote import RemoteUrl

        url = RemoteUrl.parse(self.remote)
        if self.revision is None:
            return url
        if url.scheme != "hf":
            raise UsageError(f"--revision={self.revision} is only for the Hub; {url} holds one version")
        if url.revision not in (None, self.revision):
            raise UsageError(f"{url} and --revision={self.revision} differ; give one of them")
        return RemoteUrl.parse(f"{replace(url, revision=None)}@{self.revision}")


def open_remote(url: RemoteUrl, *, private: bool = False) -> Remote:
    """Return the remote of a URL, without connecting yet; the library of its scheme is imported here.

    private: of a repository that a push creates on the Hub.
    """
    if url.scheme == "hf":
        from manip_il.store.hub import HubRemote

        return HubRemote(url, private)
    if url.scheme == "s3":
        from manip_il.store.s3_store import S3Blobs as Blobs
    elif url.scheme == "sftp":
        from manip_il.store.sftp_store import SftpBlobs as Blobs
    else:
        from manip_il.store.file_store import FileBlobs as Blobs
    from manip_il.store.object_store import ObjectRemote

    return ObjectRemote(Blobs(url))
