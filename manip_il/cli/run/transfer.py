"""Run `manip-il push`, `pull`: move datasets and policies."""

from rich import filesize

from manip_il.bridges.store.transfer import open_remote, pull, push
from manip_il.cli.outputs import has_bars, say, say_next
from manip_il.cli.transfer import (
    PullOptions,
    PushOptions,
)


def run_push(options: PushOptions) -> None:
    """Check, list, upload, switch to the new version; print what was done."""
    remote = open_remote(options.remote, private=options.private, quiet=not has_bars())
    plan = push(options.source, remote, dry_run=options.dry_run)
    size = filesize.decimal(sum(plan.manifest.files[path].size for path in plan.upload))
    if options.dry_run:
        say(
            *(f"upload   {path}" for path in plan.upload),
            *(f"remove   {path}" for path in plan.remove),
        )
    done = "would be " if options.dry_run else ""
    say(
        f"{remote.name}: {len(plan.upload)} files, {size}, {done}uploaded; {len(plan.remove)}"
        f" {done}removed"
    )
    if not options.dry_run:
        say_next("pull", remote.name, "FOLDER")


def run_pull(options: PullOptions) -> None:
    """Download and verify the files, move the folder into place, and print what was pulled."""
    remote = open_remote(options.remote, revision=options.revision, quiet=not has_bars())
    manifest = pull(remote, options.target, overwrite=options.overwrite, dry_run=options.dry_run)
    if options.dry_run:
        say(*(f"pull     {path}" for path in manifest.files))
    size = filesize.decimal(sum(file.size for file in manifest.files.values()))
    done = "would be downloaded" if options.dry_run else "all verified"
    say(f"{options.target}: a {manifest.kind} of {len(manifest.files)} files, {size}, {done}")
