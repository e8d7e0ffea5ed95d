"""The parts of the quickstart: cloning with as many labels as DAgger had, the measurements, the pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from manip_il.algorithms.fitting import fit_table, round_fit
from manip_il.cli.suites import suite_conditions
from manip_il.data import schema
from manip_il.data.atomic import write_file
from manip_il.data.build import Recording
from manip_il.data.journal import list_episodes, read_header
from manip_il.data.lerobot_read import read_table
from manip_il.engine.environments import env_spec
from manip_il.engine.jobs import RolloutJob
from manip_il.errors import RenderError
from manip_il.evaluation.film import film, make_film, paths, run_states, strip
from manip_il.evaluation.report_data import Film, Kind, Paths, Strip
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.evaluation.runner import HOLD, evaluate
from manip_il.learn.columns import LEARNING_COLUMNS
from manip_il.recording import MAX_TRIES, collect_successes, provenance, record
from manip_il.seeding import stream_seeds

if TYPE_CHECKING:
    from manip_il.algorithms.config import RunConfig
    from manip_il.cli.stages import Stages
    from manip_il.engine.engine import Engine
    from manip_il.mdp import Episode
    from manip_il.sim.env import EnvConfig

FILM_EVERY = 2  # control steps a film's frame: a software renderer takes a tenth of a second for each
SUITES = {"nominal": "nominal", "disturbed": "knocked"}  # by the folder of the evaluations


@dataclass(frozen=True)
class Contestant:
    """One policy of the comparison. labels: expert labels that it learnt from."""

    key: str  # its folder
    name: str
    kind: Kind
    policy: Path | None = None
    labels: int | None = None

    def job(self, env: EnvConfig, suite: str = "nominal") -> RolloutJob:
        """Return its rollouts."""
        driver: Literal["expert", "policy"] = "expert" if self.policy is None else "policy"
        conditions = suite_conditions(suite, env.task, sees=False)
        return RolloutJob(env, driver, policy=self.policy, hold=HOLD, label="last", conditions=conditions)


def clone_with_labels(
    config: RunConfig, labels: int, round_0: Path, folder: Path, engine: Engine, stages: Stages
) -> tuple[Path, int]:
    """Fit a policy as every round's is fitted, to `labels` labels of demonstrations alone.

    The demonstrations are those of round 0 and the ones that follow in their stream of seeds. Returns the
    checkpoint and the number of labels.
    """
    if not (folder / "dataset").is_dir():
        _demonstrate(config, labels, round_0, folder, engine, stages)
    table = read_table(folder / "dataset", LEARNING_COLUMNS)
    so_far = np.cumsum(table[schema.LABEL_VALID])
    rows = int(np.searchsorted(so_far, labels)) + 1
    stages.start("cloning with as many labels, fit", round_fit(config).total_steps)
    policy = fit_table(
        config, {key: column[:rows] for key, column in table.items()}, folder / "policy", on_log=stages.log
    )
    stages.close()
    return policy, min(labels, int(so_far[-1]))


def measure(
    contestants: Sequence[Contestant], env: EnvConfig, seeds: range, folder: Path, engine: Engine, stages: Stages
) -> dict[str, EvalResult]:
    """Return key -> evaluation on the same seeds, in the suite that `folder` stands for.

    What an earlier run has written is read instead.
    """
    results: dict[str, EvalResult] = {}
    for who in contestants:
        path = folder / f"{who.key}.json"
        if not path.is_file():
            stages.start(f"{folder.name}: {who.name}", len(seeds))
            suite = SUITES.get(folder.name, "nominal")
            evaluate(engine, who.job(env, suite), seeds, who.name, stages.episode, suite=suite).write(path)
            stages.close()
        results[who.key] = EvalResult.read(path)
    return results


def compare(results: Mapping[str, EvalResult], pairs: Sequence[tuple[Contestant, Contestant]], words: str) -> list[str]:
    """Return one sentence a pair."""
    return [
        f"{words}: {compare_results(results[left.key], results[right.key], (left.name, right.name)).verdict}"
        for left, right in pairs
    ]


def telling_seed(loser: EvalResult, winner: EvalResult) -> int:
    """Return the first seed on which only the winner succeeds, else the first of all."""
    won = {episode.seed for episode in winner.episodes if episode.success}
    telling = (episode.seed for episode in loser.episodes if not episode.success and episode.seed in won)
    return next(telling, loser.episodes[0].seed)


@dataclass(frozen=True)
class Pictures:
    """Of one seed, of every policy; paths and a note where there is no OpenGL."""

    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    note: str = ""


def picture(contestants: Sequence[Contestant], env: EnvConfig, seed: int, stages: Stages) -> Pictures:
    """Run one seed with every policy and show it."""
    episodes = {who.name: run_states(who.job(env), seed) for who in contestants}
    stages.start("films", len(episodes))
    try:
        shown = [_show(name, episode, env, stages) for name, episode in episodes.items()]
    except RenderError as error:
        spec = env_spec(env)
        drawn = tuple(paths(episode, spec, name, _caption(episode)) for name, episode in episodes.items())
        return Pictures(paths=drawn, note=str(error))
    finally:
        stages.close()
    return Pictures(tuple(one for one, _ in shown), tuple(one for _, one in shown))


def _show(name: str, episode: Episode, env: EnvConfig, stages: Stages) -> tuple[Film, Strip]:
    frames = film(episode, env, every=FILM_EVERY)
    fps = env.control_hz // FILM_EVERY or 1
    stages.step()
    caption = _caption(episode)
    return make_film(name, frames, fps, caption), Strip(name, strip(frames, fps), caption)


def _caption(episode: Episode) -> str:
    return f"{'success' if episode.success else 'failure'}, seed {episode.seed}"


def _demonstrate(config: RunConfig, labels: int, round_0: Path, folder: Path, engine: Engine, stages: Stages) -> None:
    """Record until the demonstrations hold `labels` frames; those of round 0 count."""
    journals = folder / "journals"
    journals.mkdir(parents=True, exist_ok=True)
    for path in list_episodes(round_0 / "journals"):
        write_file(journals / path.name, path.read_bytes())
    job = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold)
    count = config.demonstrations
    stages.start("cloning with as many labels, record", count)
    while True:
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, config.seed)
        found = list(collect_successes(engine, job, seeds, count, journals, stages.episode))
        frames = sum(read_header(one.path).frames for one in found if one.success)
        if frames >= labels:
            break
        count = max(count + 1, math.ceil(count * labels / frames))
        stages.start("cloning with as many labels, record", max(0, count - len(found)))
    name = f"local/{config.env.robot}_{config.env.task}_demonstrations"
    record(found, journals, folder / "dataset", job, Recording(name, True, count, provenance(job)))
