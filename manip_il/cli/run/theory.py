"""Run `manip-il theory`: the proven bounds of cloning and DAgger, on small MDPs and on the
rounds of a run.
"""

from itertools import chain
from pathlib import Path

from manip_il.chapter.theory.bounds import PROCESSES, curves
from manip_il.chapter.theory.linear import drifts
from manip_il.chapter.theory.report import FILE_NAME, Theory, slope_table, theory_report
from manip_il.chapter.theory.shift import Shift, find_rounds, measure_shift
from manip_il.cli.chapter import TheoryOptions
from manip_il.cli.outputs import publish
from manip_il.cli.progress import progress
from manip_il.evaluation.certify import certify, count_episodes
from manip_il.evaluation.side import read_member


def run_theory(options: TheoryOptions) -> None:
    """Compute and measure; write the report and the JSON file; print the slopes."""
    with options.open() as folder:
        shift = _shift(options, options.source) if options.source else None
        theory = Theory(tuple(chain(*map(curves, PROCESSES))), tuple(drifts()), shift)
        page = theory_report(theory)
        fact = f"policies above their bound: {theory.above}"
        publish(
            folder / FILE_NAME,
            theory.to_json(),
            [slope_table(theory)],
            fact,
            page=page,
            options=options,
        )


def _shift(options: TheoryOptions, run: Path) -> Shift:
    rounds = find_rounds(run)
    validation = read_member(run).validation
    env = validation.env()
    count = count_episodes(env, options.cases) + options.episodes * (1 + len(rounds))
    with progress(count, f"theory {run}") as bar, options.open_engine() as engine:
        certificate = certify(engine, env, options.cases, on_episode=lambda _: bar.step())
        u, conditions = certificate.mu or 0, validation.settings.conditions
        return measure_shift(
            engine, env, rounds, u, options.episodes, lambda _: bar.step(), conditions
        )
