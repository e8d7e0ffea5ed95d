"""`manip-il pull REMOTE TARGET`: a dataset or a policy from somewhere else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.folders import require_ours
from manip_il.cli.groups import option, warn
from manip_il.cli.progress import bytes_text, say
from manip_il.cli.transfer import going_on, moved
from manip_il.errors import FolderExistsError, UsageError

if TYPE_CHECKING:
    from manip_il.store.remote import RemoteUrl


@dataclass
class PullOptions:
    """Pull a dataset or a policy from the Hugging Face Hub, an S3 store, another machine or a folder.

    Every file is verified by its hash before the folder appears. Interrupted transfers resume: run the same command
    again. Paths that leave the folder, links, pickles and code are refused; nothing that is pulled is executed.
    """

    example: ClassVar[str] = "manip-il pull hf://datasets/me/demos datasets/demos"
    remote: str = field(metadata={"help": "what manip-il push was given, or any repo of the Hub", "positional": True})
    target: Path = field(metadata={"help": "new folder for it", "positional": True})
    revision: str | None = option(None, "branch, tag or commit of a repo on the Hub")
    dry_run: bool = option(False, "only list what would be pulled")
    overwrite: bool = option(False, "replace an existing dataset or run")

    def check(self) -> None:
        """Refuse an address that is none, and a folder that may not be replaced."""
        self._url()
        if self.overwrite and self.target.is_dir() and any(self.target.iterdir()):
            require_ours(self.target)

    def run(self) -> None:
        """Fetch, verify, rename; say what is there now."""
        from manip_il.store.pull import pull
        from manip_il.store.remote import open_remote

        url = self._url()
        remote = open_remote(url)
        try:
            with going_on():
                pulled = pull(url, remote, self.target, moved, overwrite=self.overwrite, dry_run=self.dry_run)
        except FolderExistsError:
            text = (
                f"{self.target} or its journals exist already; replace them with --overwrite=true, or name a new folder"
            )
            raise UsageError(text) from None
        finally:
            warn(remote.warnings)
        manifest = pulled.manifest
        if self.dry_run:
            for entry in manifest.files:
                say(f"pull     {entry.path} ({bytes_text(entry.size)})")
        size = f"a {manifest.kind} of {len(manifest.files)} files, {bytes_text(manifest.size)}"
        kept = f", of which {bytes_text(pulled.kept)} had been transferred before" if pulled.kept else ""
        say(f"{url}: {size}; nothing was done" if self.dry_run else f"{self.target}: {size}, all verified{kept}")
        if not self.dry_run and manifest.kind == "dataset":
            say(f"next: manip-il doctor {self.target}")

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
