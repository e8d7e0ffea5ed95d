"""Check for what LeRobot's own recorder leaves when it dies before `finalize()`: told as one story."""

from __future__ import annotations

from collections.abc import Iterator

from manip_il.data.shards import NO_FOOTER
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, count_frames, error, plural, some
from manip_il.doctor.leftovers import IMAGES


def check_recorder(dataset: Dataset) -> Iterator[Finding]:
    """Yield no recorder died here. LeRobot counts episodes as it goes, but closes its files only in the end."""
    info = dataset.info
    if info is None or dataset.is_ours:
        return
    place = str(dataset.root)
    open_files = [one.name for one in (*dataset.data_shards, *dataset.episode_shards) if one.problem == NO_FOOTER]
    whole = _whole_episodes(dataset)
    if info.episodes == 0 and not dataset.data_shards and not dataset.episode_shards:
        yield error(place, f"a recorder was started here, but no episode was saved{_unsaved(dataset)}; record again")
    elif whole < info.episodes and any(one.problem == NO_FOOTER for one in dataset.data_shards):
        lost = info.episodes - whole
        yield error(
            place,
            f"LeRobot's recorder died here before finalize(): it had saved {count_frames(info.episodes, info.frames)}, "
            f"but the rows of {plural(lost, 'episode')} are lost, as it never closed {some(open_files)}"
            f"{_videos(dataset)}{_unsaved(dataset)}; {_advice(dataset, whole, open_files)}",
        )


def _whole_episodes(dataset: Dataset) -> int:
    """Episodes whose rows and description can both be read."""
    if dataset.episodes is None:
        return 0
    readable = {shard.name for shard in dataset.data_shards if not shard.problem}
    return sum(file in readable for file in dataset.episodes.files)


def _unsaved(dataset: Dataset) -> str:
    folders = sorted({path.name for path in dataset.root.glob(f"{IMAGES}/*/episode-*") if any(path.iterdir())})
    return f"; pictures of {some(folders)} that it had not encoded are in {IMAGES}" if folders else ""


def _videos(dataset: Dataset) -> str:
    count = len(list(dataset.root.glob("videos/*/*/*.mp4")))
    return f"; {plural(count, 'video file')} remain, without the rows they belong to" if count else ""


def _advice(dataset: Dataset, whole: int, open_files: list[str]) -> str:
    if not whole or dataset.episodes is None:
        return "LeRobot can neither read nor resume this: record again, into another folder"
    frames = int(dataset.episodes.length[:whole].sum())
    return (
        f"the first {count_frames(whole, frames)} are intact: LeRobot reads them again once those files are moved "
        f'away and meta/info.json has these counts, with "train": "0:{whole}" in its splits; then --repair=true '
        f"computes their statistics"
    )
