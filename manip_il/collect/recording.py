"""Record a dataset: the expert's demonstrations, or a policy's rollouts with the expert's labels."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import HOLD, RolloutJob
from manip_il.collect.query import parse_query
from manip_il.collect.record import MAX_TRIES, collect, collect_successes, journal_of, provenance
from manip_il.collect.workers import Engine, engine_of
from manip_il.data.build import Recording
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_seeds
from manip_il.data.ownership import require_replaceable
from manip_il.data.video import try_encoder
from manip_il.data.video_config import VideoConfig
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.policy_folder import policy_folder
from manip_il.option import make_options
from manip_il.progress import Progress
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_of_name, env_spec

_LOG = logging.getLogger(__name__)


def record(
    root: Path | str,
    env: EnvConfig | str,
    episodes: int = 50,
    *,
    policy: Any = None,
    beta: float = 0.0,
    query: str = "every",
    seed: int = 0,
    workers: int | Engine | None = 1,
    video: VideoConfig | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Dataset:
    """Record a dataset: the expert's successful demonstrations or, given a policy, all of its rollouts.

    Each frame holds the executed action and the expert's label. Finished episodes are written at once, to the folder
    `journals_of(root)`.

    Args:
        root: The dataset's folder.
        env: The environment, or its name: `panda` or `panda/lift`.
        episodes: Number of episodes.
        policy: A `Checkpoint`, or the path of a checkpoint or a run.
        beta: Share of the steps that the expert drives instead of the policy.
        query: When the expert is queried, as for `manip-il dagger --query`.
        seed: 0 to 1000.
        workers: Number of processes, None for one per core; or the engine to use.
        video: How pictures are encoded.
        resume: Whether to continue the recording in the folders.
        progress: Follows the recording.
        options: Fields of `RolloutJob`, such as `label` and `cameras`; `round` is by default 1 with a policy, else 0.

    Returns:
        The dataset.

    Raises:
        UsageError: for an option that is unknown or invalid, or a folder that holds files.
        MismatchError: if a recording is continued with other options.
    """
    root = Path(root).expanduser()
    journals = journals_of(root)
    progress = progress or Progress()
    video = video or VideoConfig()
    driver = RolloutJob.driver if policy is None else PolicyDriver.of(policy_folder(policy), beta=beta)
    chosen: dict[str, Any] = {"hold": HOLD, "round": 0 if policy is None else 1, "query": parse_query(query)}
    job = make_options(RolloutJob, env=env_of_name(env), driver=driver, **chosen | options)
    episodes = checks.whole("episodes", episodes, 1, BLOCK // MAX_TRIES)
    env_spec(job.env, job.cameras)  # raises if no scene can be made, before anything is written
    if job.cameras:
        try_encoder(video, job.cameras.size, job.env.control_hz)
    for folder in () if resume else (root, journals):
        require_replaceable(folder)
    progress.started()
    done = len(list_seeds(journals))
    if any(root.glob("*")) and not done:
        raise UsageError(f"{root} cannot be continued without {journals}; choose another folder")
    for line in journal_of(journals, job).prepare():
        _LOG.warning(line)
    recording = Recording(
        provenance=provenance(job), video=asdict(video) if job.cameras else {}, only_labelled=not job.labels_all
    )
    if policy is None:
        recording = replace(recording, only_successes=True, episodes=episodes)
    before, now = (one.provenance.get("vary") for one in (Recording.read(journals), recording))
    if done and before != now:
        raise MismatchError("what --vary draws from", str(journals), before, "the command line", now)
    progress.start(f"record {job.env.robot} {job.env.task}", max(0, episodes - done))
    with engine_of(workers) as engine:
        if policy is None:
            seeds = stream_seeds("demonstrations", MAX_TRIES * episodes, seed)
            made = collect_successes(engine, job, seeds, episodes, journals, progress.episode)
        else:
            seeds = stream_seeds(f"round/{job.round}", episodes, seed)
            made = collect(engine, job, seeds, journals, progress.episode)
        recording.write(journals)
        recording.make(made, root, replace=resume)
    return Dataset.open(root)


def journals_of(root: Path) -> Path:
    """Return the folder of the journals from which a dataset is made."""
    return root.with_name(f"{root.name}.journals")
