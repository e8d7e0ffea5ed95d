"""`manip-il push` and `manip-il pull`: upload and download of a dataset or a policy."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import exists
from manip_il.cli.outputs import require_ours
from manip_il.cli.progress import has_bars, say
from manip_il.errors import FolderExistsError, UsageError
from manip_il.option import option

REMOTES = "hf://datasets/USER/NAME, hf://USER/NAME, s3://BUCKET/FOLDER, sftp://HOST/FOLDER, file://FOLDER"


@dataclass
class PushOptions:
    """Push a dataset, or a policy with its run, to the Hugging Face Hub, an object store, another machine or a folder.

    A dataset is checked first, as by manip-il data check, and refused if it has errors. Only changes are uploaded.
    Readers see the old version until the new one is complete. After an interruption run the same command again: what
    has arrived is not sent twice.
    """

    example: ClassVar[str] = "manip-il push datasets/demos hf://datasets/me/demos"
    source: Path = option(
        MISSING, "folder of a dataset, a run or a policy", positional=True, check=exists("a dataset, a run or a policy")
    )
    remote: str = option(MISSING, REMOTES, positional=True)
    dry_run: bool = option(False, "only list what would be uploaded and removed")
    journals: bool = option(False, "include the journals, from which the dataset can be rebuilt")
    private: bool = option(False, "make a new repository on the Hub private")

    def run(self) -> None:
        """Examine, list, upload, switch over; print what was done."""
        from rich import filesize

        from manip_il.store.transfer import open_remote, push

        remote = open_remote(self.remote, private=self.private, quiet=not has_bars())
        plan = push(self.source, remote, journals=self.journals, dry_run=self.dry_run)
        sizes = {path: plan.manifest.files[path].size for path in plan.upload}
        for path, size in sizes.items() if self.dry_run else ():
            say(f"upload   {path} ({filesize.decimal(size)})")
        for path in plan.remove if self.dry_run else ():
            say(f"remove   {path}")
        counts = (
            f"{len(sizes)} files, {filesize.decimal(sum(sizes.values()))}, {'to upload' * self.dry_run or 'uploaded'}"
        )
        rest = f"{len(plan.remove)} {'to remove' * self.dry_run or 'removed'}; {len(plan.local) - len(sizes)} unchanged"
        say(f"{remote.name}: {counts}; {rest}{'; nothing was done' * self.dry_run}")
        if not self.dry_run:
            say(f"next: manip-il pull {remote.name} FOLDER")


@dataclass
class PullOptions:
    """Pull a dataset or a policy from the Hugging Face Hub, an object store, another machine or a folder.

    Every file is verified by its hash, and every file of a dataset opened once, before the folder appears. Paths that
    leave the folder, links, pickles and code are refused; nothing that is pulled is executed.
    """

    example: ClassVar[str] = "manip-il pull hf://datasets/me/demos datasets/demos"
    remote: str = option(MISSING, "what manip-il push was given, or any repo of the Hub", positional=True)
    target: Path = option(MISSING, "new folder for it", positional=True)
    revision: str | None = option(None, "branch, tag or commit of a repo on the Hub")
    dry_run: bool = option(False, "only list what would be pulled")
    overwrite: bool = option(False, "replace an existing dataset or run")

    def check(self) -> None:
        """Refuse a folder that may not be replaced."""
        if self.overwrite and self.target.is_dir() and any(self.target.iterdir()):
            require_ours(self.target)

    def run(self) -> None:
        """Fetch, verify, rename; print what was pulled."""
        from rich import filesize

        from manip_il.store.transfer import open_remote, pull

        remote = open_remote(self.remote, revision=self.revision, quiet=not has_bars())
        try:
            manifest = pull(remote, self.target, overwrite=self.overwrite, dry_run=self.dry_run)
        except FolderExistsError:
            remedy = "replace them with --overwrite=true, or name a new folder"
            raise UsageError(f"{self.target} or its journals exist already; {remedy}") from None
        for path, file in manifest.files.items() if self.dry_run else ():
            say(f"pull     {path} ({filesize.decimal(file.size)})")
        size = filesize.decimal(sum(file.size for file in manifest.files.values()))
        what = f"a {manifest.kind} of {len(manifest.files)} files, {size}"
        say(f"{remote.name}: {what}; nothing was done" if self.dry_run else f"{self.target}: {what}, all verified")
        if not self.dry_run and manifest.kind == "dataset":
            say(f"next: manip-il data check {self.target}")
