"""Run `manip-il data render`, `redraw`, `relabel`, `build`, `merge`: make a dataset from existing
ones.

Run `manip-il data check`, `repair`: find errors in a dataset, and repair them.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from manip_il.bridges.doctor.examine import Check, examine_folder, repair
from manip_il.bridges.doctor.files import Finding, warning
from manip_il.bridges.doctor.models import missing
from manip_il.cli.common_options import OfDataset
from manip_il.cli.data import (
    AnnotateOptions,
    BuildOptions,
    CheckOptions,
    Edit,
    MergeOptions,
    RedrawOptions,
    RelabelOptions,
    RenderOptions,
    RepairOptions,
)
from manip_il.cli.outputs import progress, require_writable, say
from manip_il.collect.edits import (
    CHUNK,
    EditSource,
    EditTarget,
    Scenes,
    open_source,
    redraw_dataset,
    relabel_dataset,
    render_dataset,
)
from manip_il.collect.inputs import differences
from manip_il.collect.language import annotate_dataset
from manip_il.collect.workers import default_workers
from manip_il.data.atomic import DATASET, exclusive
from manip_il.data.build import build, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import OURS
from manip_il.errors import ManipError
from manip_il.evaluation.suites import varied

_RUN = "dataset"  # folder of a DAgger run with the states of all rounds


def run_build(options: BuildOptions) -> None:
    """Build the dataset."""
    require_writable(options.dataset, DATASET, options.overwrite, [options.journals])
    with exclusive(options.dataset):
        info, failed = build(options.journals, options.dataset, replace=options.overwrite)
    say(
        f"built {info.episodes:,} episodes, {info.frames:,} frames; failed episodes left out:"
        f" {failed}"
    )
    say(f"dataset: {options.dataset}")


def run_merge(options: MergeOptions) -> None:
    """Merge; the new dataset appears when it is complete."""
    with exclusive(options.output):
        require_writable(options.output, DATASET, options.overwrite, options.datasets)
        info = merge_datasets(
            options.datasets, options.output, options.episodes, replace=options.overwrite
        )
    say(f"merged {info.episodes:,} episodes, {info.frames:,} frames", f"dataset: {options.output}")


@contextmanager
def _open(
    options: Edit, what: str, root: Path | None = None, pieces: int | None = None
) -> Generator[tuple[EditSource, EditTarget]]:
    """Yield the dataset to read and the new dataset's locked folder, and show progress.

    root: the dataset, by default `source`. pieces: total of the progress bar, by default the number
    of episodes.
    """
    root = root or options.source
    folder = options.target or root.with_name(f"{root.absolute().name}_{what}")
    require_writable(folder, DATASET, options.overwrite, [root])
    source = open_source(root, options.robot, options.task, options.object)
    with exclusive(folder), progress(pieces or source.dataset.info.episodes, str(folder)) as bar:
        yield (
            source,
            EditTarget(folder, options.workers or default_workers(), options.overwrite, bar.step),
        )
    say(f"dataset: {folder}")


def run_render(options: RenderOptions) -> None:
    """Render every episode; TARGET appears when it is complete."""
    with _open(options, "rendered") as (source, target):
        info = render_dataset(source, options.camera_config(source.env, options.look), target)
        say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames")


def run_relabel(options: RelabelOptions) -> None:
    """Label every state; TARGET appears when it is complete."""
    with _open(options, "relabelled") as (source, target):
        info = relabel_dataset(source, target)
        say(f"relabelled {info.episodes:,} episodes, {info.frames:,} frames")


def run_annotate(options: AnnotateOptions) -> None:
    """Describe every state; TARGET appears when it is complete."""
    with _open(options, "annotated") as (source, target):
        info = annotate_dataset(source, target)
        say(f"annotated {info.episodes:,} episodes, {info.frames:,} frames")


def run_redraw(options: RedrawOptions) -> None:
    """Draw all scenes; TARGET appears when it is complete."""
    root = (
        options.source / _RUN
        if (options.source / _RUN / "meta" / "info.json").is_file()
        else options.source
    )
    with _open(options, "redrawn", root, -(-options.frames // CHUNK)) as (source, target):
        conditions = varied(options.vary, source.env, sees=True)
        cameras = options.camera_config(source.env)
        cameras = cameras if options.pictures else None
        scenes = Scenes(
            cameras, options.frames, options.seed, options.scenes, conditions, options.branch_steps
        )
        info = redraw_dataset(source, scenes, target)
        left = options.frames - info.episodes
        say(
            f"redrew {info.episodes:,} scenes, {info.frames:,} frames; {left:,} left out, without a"
            " valid label"
        )


def run_check(options: CheckOptions) -> None:
    """Check the dataset and print every finding and the verdict.

    Raises `ManipError` if there are errors.
    """
    of_model = [partial(missing, name=options.model)] if options.model else []
    found = _examine(options, *of_model)
    _conclude(options, found, f"try manip-il data repair {options.dataset}")


def _examine(options: OfDataset, *more: Check) -> list[Finding]:
    """Check the dataset and print every finding."""
    findings = examine_folder(options.dataset.absolute(), [check_robot, *more])
    say(*map(str, findings))
    return findings


def _conclude(options: OfDataset, findings: list[Finding], remedy: str) -> None:
    errors = sum(finding.is_error for finding in findings)
    if errors:
        raise ManipError(
            f"{options.dataset}: errors: {errors}, warnings: {len(findings) - errors}; {remedy}"
        )
    info = Dataset.open(options.dataset).info
    say(
        f"{options.dataset}: {info.episodes:,} episodes, {info.frames:,} frames: whole; warnings:"
        f" {len(findings)}"
    )


def run_repair(options: RepairOptions) -> None:
    """Check, repair, check again, and print the verdict; raises `ManipError` if errors remain."""
    if findings := _examine(options):
        say(*(f"repair   {line}" for line in repair(options.dataset.absolute())))
        findings = _examine(options)
    _conclude(
        options,
        findings,
        "these cannot be repaired: build it from its journals (manip-il data build), or pull or"
        " record it again",
    )


def check_robot(dataset: Dataset) -> Iterator[Finding]:
    """Compare a dataset's joints, observations and model with those of its robot and task in
    this version.
    """
    if dataset.own is None:
        return
    try:
        for text in differences(dataset):
            yield warning(
                OURS,
                text,
                f"for labels of the current expert: manip-il data relabel {dataset.root}",
            )
    except ManipError as error:
        yield Finding(
            OURS, str(error), "use the version of this program that recorded it, or record again"
        )
