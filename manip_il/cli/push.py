"""`manip-il push SOURCE REMOTE`: a dataset or a policy, somewhere else."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.groups import option, warn
from manip_il.cli.paths import require_folder
from manip_il.cli.progress import bytes_text, say
from manip_il.cli.transfer import going_on, moved

if TYPE_CHECKING:
    from manip_il.store.push import Plan
    from manip_il.store.remote import Published


@dataclass
class PushOptions:
    """Push a dataset, or a policy with its run, to the Hugging Face Hub, an S3 store, another machine or a folder.

    A dataset is checked first, as by manip-il doctor, and refused if it has errors. Only changes are uploaded. Readers
    see the old version until the new one is complete and verified. Interrupted transfers resume: run the same command
    again. Of two concurrent pushes one succeeds, and the other says so.
    """

    example: ClassVar[str] = "manip-il push datasets/demos hf://datasets/me/demos"
    source: Path = field(metadata={"help": "folder of a dataset, a run or a policy", "positional": True})
    remote: str = field(
        metadata={
            "help": "hf://datasets/USER/NAME, hf://USER/NAME, s3://BUCKET/FOLDER, sftp://HOST/FOLDER, file://FOLDER",
            "positional": True,
        }
    )
    dry_run: bool = option(False, "only list what would be uploaded and removed")
    journals: bool = option(False, "include the journals, from which the dataset can be rebuilt")
    private: bool = option(False, "make a new repository on the Hub private")

    def check(self) -> None:
        """Refuse an address that is none, and what is no folder."""
        from manip_il.store.remote import RemoteUrl

        RemoteUrl.parse(self.remote)
        require_folder(self.source, "the folder of a dataset, a run or a policy")

    def run(self) -> None:
        """Examine, list, upload, switch over; say what was done."""
        from manip_il.store.push import push
        from manip_il.store.remote import RemoteUrl, open_remote

        url = RemoteUrl.parse(self.remote)
        remote = open_remote(url, private=self.private)
        try:
            with going_on():
                plan, published = push(self.source, url, remote, moved, journals=self.journals, dry_run=self.dry_run)
        finally:
            warn(remote.warnings)
        if published is None:
            _say_plan(plan, url)
            return
        say(_summary(published, url))
        say(f"next: manip-il pull {url} FOLDER")


def _say_plan(plan: Plan, url: object) -> None:
    for path in plan.upload:
        say(f"upload   {path} ({bytes_text(plan.manifest.by_path[path].size)})")
    for path in plan.remove:
        say(f"remove   {path}")
    kept = len(plan.manifest.files) - len(plan.upload)
    counts = (
        f"{len(plan.upload)} files, {bytes_text(plan.size)}, to upload; {len(plan.remove)} to remove; {kept} unchanged"
    )
    say(f"{url}: {counts}; nothing was done")


def _summary(published: Published, url: object) -> str:
    if not published.uploaded and not published.removed:
        return f"{url}: {published.kept} files, all there already"
    counts = f"{published.uploaded} files, {bytes_text(published.size)}, uploaded"
    return f"{url}: {counts}; {published.removed} removed; {published.kept} unchanged"
