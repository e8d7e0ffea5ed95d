"""Record episodes: run the seeds that have no journal yet, and write each journal as soon as its
episode ends.

Record a dataset: the expert's demonstrations, or a policy's rollouts with the expert's labels.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.edits import EditSource, EditTarget
from manip_il.collect.job import HOLD, RolloutJob
from manip_il.collect.language import annotate_dataset
from manip_il.collect.query import parse_query
from manip_il.collect.workers import Engine, engine_of
from manip_il.data.atomic import require_replaceable
from manip_il.data.build import Recording
from manip_il.data.dataset import Dataset
from manip_il.data.journal import (
    Journal,
    episode_path,
    journals_of,
    list_seeds,
    read_journal,
)
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.mdp import Episode
from manip_il.option import make_options
from manip_il.progress import Progress
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.sim.config import Look
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.several import divide, task_number
from manip_il.worlds.table import env_fingerprint, env_of_name, env_spec, task_names

OnEpisode = Callable[[Episode], None]
MAX_TRIES = 3  # most tries, as a multiple of the requested successes


def journal_of(journals: Path, job: RolloutJob) -> Journal:
    """Return the journal folder of a job, with its spec and fingerprint."""
    return Journal(journals, env_spec(job.env, job.cameras), env_fingerprint(job.env, job.cameras))


def collect(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[tuple[Journal, Episode]]:
    """Run the seeds that have no journal in `journals` yet.

    Each finished episode is written at once.

    Args:
        engine: Runs the episodes.
        job: The job to which the seeds belong.
        seeds: One for each episode.
        journals: Folder of the journals.
        on_episode: Called when an episode is on disk. An exception in it ends the run, and finished
            episodes stay on disk.

    Yields:
        What `read_journal` returns for each seed, in the order of `seeds`, as soon as all earlier
        ones are done.
    """
    journal = journal_of(journals, job)
    waiting = deque(seeds)
    on_disk = set(list_seeds(journals))

    def ready() -> Iterator[tuple[Journal, Episode]]:
        while waiting and waiting[0] in on_disk:
            yield read_journal(episode_path(journals, waiting.popleft()))

    yield from ready()
    for episode in engine.run(job, [seed for seed in waiting if seed not in on_disk], journal):
        on_disk.add(episode.seed)
        if on_episode is not None:
            on_episode(episode)
        yield from ready()


def collect_successes(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    count: int,
    journals: Path,
    on_episode: OnEpisode | None = None,
) -> Iterator[tuple[Journal, Episode]]:
    """Run seeds in order until `count` episodes have succeeded.

    The episodes depend on the seeds alone.

    Args:
        engine: Runs the episodes.
        job: The job to which the seeds belong.
        seeds: Seeds to try, in this order.
        count: Number of successes wanted.
        journals: Folder of the journals.
        on_episode: As in `collect`.

    Yields:
        All episodes, failed ones too, as `collect` does.

    Raises:
        ManipError: if reaching `count` would take more than the given seeds, or more than
            `MAX_TRIES` times `count` tries.
    """
    tried, good = 0, 0
    while good < count:
        more = seeds[tried : tried + count - good]
        if tried + count - good > min(len(seeds), MAX_TRIES * count):
            raise ManipError(
                f"only {good} of {tried} demonstrations succeeded; {count} are needed; "
                "measure the expert first: manip-il eval --policy.type=expert"
            )
        tried += len(more)
        for journal, episode in collect(engine, job, more, journals, on_episode):
            good += episode.success
            yield journal, episode


def demonstrate(
    engine: Engine,
    job: RolloutJob,
    stream: str,
    count: int,
    journals: Path,
    progress: Progress,
    seed: int = 0,
    shares: Sequence[float] = (),
) -> Iterator[tuple[Journal, Episode]]:
    """Run the expert until it has succeeded in `count` episodes.

    Args:
        engine: Runs the episodes.
        job: The job of the episodes.
        stream: Name of the stream of seeds.
        count: Number of successes wanted.
        journals: Folder of the journals.
        progress: Follows the episodes.
        seed: The user's `--seed`.
        shares: How many episodes each task gets, as in `seeds_by_task`.

    Yields:
        What `collect_successes` yields.
    """
    parts = seeds_by_task(job.env, stream, count, seed, tries=MAX_TRIES, weights=shares)
    for seeds, number in parts:
        yield from collect_successes(engine, job, seeds, number, journals, progress.episode)


def seeds_by_task(
    env: EnvConfig,
    stream: str,
    count: int,
    seed: int = 0,
    *,
    tries: int = 1,
    weights: Sequence[float] = (),
) -> list[tuple[Sequence[int], int]]:
    """Divide episodes among the tasks of an environment.

    Args:
        env: The environment.
        stream: Name of the stream of seeds.
        count: Number of episodes.
        seed: The user's `--seed`.
        tries: Seeds to choose from, as a multiple of the episodes.
        weights: How many episodes each task gets, relative to the others; by default equally many.

    Returns:
        For each task, its seeds and its number of episodes; tasks without episodes are left out.

    Raises:
        UsageError: if there are not as many weights as tasks.
    """
    tasks = len(task_names(env))
    if weights and (len(weights) != tasks or min(weights) < 0 or not sum(weights)):
        raise UsageError(f"shares are {list(weights)}; expected one for each of {tasks} tasks")
    if tasks == 1:
        return [(stream_seeds(stream, tries * count, seed), count)]
    numbers = divide(count, weights or [1.0] * tasks)
    enough = min(BLOCK, tries * tasks * max(numbers))
    by_task: list[list[int]] = [[] for _ in numbers]
    for one in stream_seeds(stream, enough, seed):
        by_task[task_number(one, tasks)].append(one)
    return [(seeds, number) for seeds, number in zip(by_task, numbers, strict=True) if number]


def provenance(job: RolloutJob) -> dict[str, Any]:
    """Return a job's driver, round, labels and randomisation, as stored in datasets.

    An episode's random draws follow from these and its seed, by `Condition.draw`.
    """
    source: dict[str, Any] = {
        "driver": job.driver.name,
        "round": job.round,
        "beta": job.driver.beta,
    }
    if job.conditions:
        source["vary"] = [condition.to_json() for condition in job.conditions]
    if job.cameras and job.cameras.look != Look():
        source["rendered"] = {"cameras": asdict(job.cameras)}
    if job.policy is None:
        return source
    steps = {"branch_steps": job.branch_steps} if job.label == "branch" else {}
    return {**source, "label": job.label, "query": str(job.query), **steps}


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
    language: bool = False,
    shares: Sequence[float] = (),
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Dataset:
    """Record a dataset: the expert's successful demonstrations or, given a policy, all of its
    rollouts.

    Each frame holds the executed action and the expert's label. Finished episodes are written at
    once, to the folder `journals_of(root)`.

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
        language: Whether to add texts that are true of every frame, as `annotate_dataset` does.
        shares: How many demonstrations each of several tasks gets, relative to the others; by
            default equally many.
        resume: Whether to continue the recording in the folders.
        progress: Follows the recording.
        options: Fields of `RolloutJob`, such as `label` and `cameras`; `round` is by default 1 with
            a policy, else 0.

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
    driver = RolloutJob.driver if policy is None else PolicyDriver.of(policy, beta=beta)
    chosen: dict[str, Any] = {
        "hold": HOLD,
        "round": 0 if policy is None else 1,
        "query": parse_query(query),
    }
    job = make_options(RolloutJob, env=env_of_name(env), driver=driver, **chosen | options)
    episodes = checks.whole("episodes", episodes, 1, BLOCK // MAX_TRIES)
    env_spec(job.env, job.cameras)  # raises if no scene can be made, before anything is written
    for folder in () if resume else (root, journals):
        require_replaceable(folder)
    progress.started()
    done = len(list_seeds(journals))
    if any(root.glob("*")) and not done:
        raise UsageError(f"{root} cannot be continued without {journals}; choose another folder")
    journal_of(journals, job).prepare()
    recording = Recording(
        provenance=provenance(job),
        video=asdict(video) if job.cameras else {},
        only_labelled=not job.labels_all,
    )
    if policy is None:
        recording = replace(recording, only_successes=True, episodes=episodes)
    before, now = (one.provenance.get("vary") for one in (Recording.read(journals), recording))
    if done and before != now:
        raise MismatchError(
            "what --vary draws from", str(journals), before, "the command line", now
        )
    progress.start(f"record {job.env.robot} {job.env.task}", max(0, episodes - done))
    with engine_of(workers) as engine:
        if policy is None:
            stream = "demonstrations"
            made = demonstrate(engine, job, stream, episodes, journals, progress, seed, shares)
        else:
            seeds = stream_seeds(f"round/{job.round}", episodes, seed)
            made = collect(engine, job, seeds, journals, progress.episode)
        recording.write(journals)
        recording.make(made, root, replace=resume)
        if language:
            target = EditTarget(root, engine.workers or 1, replace=True)
            annotate_dataset(EditSource(Dataset.open(root), job.env), target)
    return Dataset.open(root)
