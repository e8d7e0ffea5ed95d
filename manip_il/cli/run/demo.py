"""Run `manip-il demo`: demonstrations, cloning, DAgger, and a report that compares them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.imitation import dagger
from manip_il.algorithms.results import best_result
from manip_il.algorithms.run import Run
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.demo import DemoOptions
from manip_il.cli.outputs import REPORT_FILE, about
from manip_il.cli.progress import Stages, say, say_next
from manip_il.cli.run.dagger import dagger_config
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.eval_report import run_report, success_table
from manip_il.evaluation.film import collect_films, film_episode, run_states
from manip_il.evaluation.measuring import measure_sides, open_driver
from manip_il.evaluation.report import Film
from manip_il.evaluation.runner import episode_hold
from manip_il.evaluation.side import Member, Side, read_member
from manip_il.evaluation.tables import CLONING, DAGGER, EXPERT

ENOUGH = 1.25  # demonstrations to record, relative to the number that should give enough labels


def run_demo(options: DemoOptions) -> None:
    """Run the missing steps, print the table, write the report."""
    config = dagger_config(DaggerOptions(env=options.env, settings=options.settings, fit=options.fit))
    kept = f"every finished episode, round and evaluation, in {options.output_dir}"
    with options.open() as folder, Stages(kept) as stages, options.open_engine() as engine:
        sides = _measure(options, config, folder, engine, stages)
        films, no_films = _film(sides, config, stages)
    disturbed = [Side.of(side.name, side.disturbed) for side in sides if side.disturbed]
    verdict, *facts = (
        prefix + Comparison(tested[place], tested[-1]).verdict
        for prefix, tested in (("", sides), ("Disturbed: ", disturbed))
        for place in (2, 1)  # cloning from as many labels, then round 0
    )
    facts.append(f"{config.disturbed_share:.0%} of DAgger's rollouts were disturbed, no demonstration was.")
    page = run_report(
        sides,
        [Side("DAgger", (read_member(folder / "dagger"),))],
        films,
        no_films,
        title=f"Demo: {config.env.robot} {config.env.task}",
        verdict=verdict,
        facts=tuple(facts),
        fingerprint=sides[-1].results[0].fingerprint,
        **about(options),
    )
    page.write(folder / REPORT_FILE)
    success_table(sides).print()
    say(verdict, *facts)
    say(f"report: {folder / REPORT_FILE}")
    say_next("eval", f"--policy.path={sides[-1].members[0].policy}", "--eval.films=3", f"--output_dir={folder}_eval")


def _measure(options: DemoOptions, config: RunConfig, folder: Path, engine: Engine, stages: Stages) -> list[Side]:
    """Run DAgger, clone from as many labels, and test both, round 0 and the expert (policy None)."""
    results = dagger(folder / "dagger", config, workers=engine, progress=stages)
    first, best = results[0], best_result(results)
    most = results[-1].labels
    run = Run(replace(config, label_budget=most), folder / f"cloning_{most}", engine, stages)
    more = run.demonstrations(math.ceil(ENOUGH * config.demonstrations * most / first.labels))
    policy = run.fit([more]).path
    contestants = (
        ("expert", None, None, EXPERT),
        ("cloning", first.policy, first.labels, CLONING),
        ("cloning with as many labels", policy, more.labels, CLONING),
        (f"DAgger (round {best.number})", best.policy, best.labels, DAGGER),
    )
    sides = [Side(name, (Member(Path(name), policy=path),), colour, n) for name, path, n, colour in contestants]
    nominal, disturbed = (
        measure_sides(
            sides,
            {side.name: config.env for side in sides},
            folder / suite,
            episodes=count,
            suite=suite,
            seed=config.seed,
            engine=engine,
            progress=stages,
        )
        for suite, count in (("nominal", options.test_episodes), ("knocked", options.disturbed_episodes))
    )
    return [replace(side, disturbed=other.results[0]) for side, other in zip(nominal, disturbed, strict=True)]


def _film(sides: Sequence[Side], config: RunConfig, stages: Stages) -> tuple[list[Film], str]:
    """Film every policy on the first seed on which DAgger succeeds and cloning fails, else on the first seed."""
    cloned, best = sides[1].results[0].episodes, sides[-1].results[0].episodes
    won = {episode.seed for episode in best if episode.success}
    seed = next((one.seed for one in cloned if not one.success and one.seed in won), cloned[0].seed)

    def films() -> Iterator[Film]:
        for side in sides:
            env, driver, _ = open_driver(side.members[0].policy, config.env)
            episode = run_states(RolloutJob(env, driver, episode_hold(env)), seed)
            caption = f"{'success' if episode.success else 'failure'}, seed {seed}"
            yield film_episode(env, episode, side.name, caption)

    stages.start("films", len(sides))
    return collect_films(films(), stages)
