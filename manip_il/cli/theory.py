"""`manip-il theory`: the proven bounds of cloning and DAgger, on small MDPs and on the rounds of a run."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.common_options import EngineOptions
from manip_il.cli.options import command_line, group, to_plain
from manip_il.cli.outputs import Output, publish
from manip_il.cli.progress import progress
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.theory.shift import Shift


@dataclass(frozen=True)
class TheoryOptions:
    """Compare the proven bounds of cloning and DAgger with exactly solved MDPs, linear systems and the arm.

    Writes report.html and theory.json. SOURCE is a run of `manip-il dagger`: for every round, the policy's
    distribution shift and its excess cost are measured, and the cost is compared with DAgger's bound.
    """

    example: ClassVar[str] = "manip-il theory runs/dagger --output_dir=runs/theory"
    source: Path | None = option(None, "a run of manip-il dagger, to measure its rounds", positional=True, exists="")
    episodes: int = option(50, "episodes of the expert and of every round's policy", at_least=2)
    cases: int = option(30, "episodes per kind of perturbation, to measure the cost of a wrong action", at_least=1)
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: Output = group(Output(Path("runs/theory")), prefix="")

    def run(self) -> None:
        """Compute and measure; write the report and the JSON file; print the slopes."""
        from manip_il.theory.bounds import curves
        from manip_il.theory.linear import drifts
        from manip_il.theory.processes import PROCESSES
        from manip_il.theory.report import FILE_NAME, Theory, slope_table, theory_report

        with self.output.open(self) as folder:
            shift = self._shift(self.source) if self.source else None
            theory = Theory(tuple(chain(*map(curves, PROCESSES))), tuple(drifts()), shift)
            page = theory_report(theory, command_line(), to_plain(self))
            fact = f"policies above their bound: {theory.above}"
            publish(folder / FILE_NAME, theory.to_json(), [slope_table(theory)], fact, page=page)

    def _shift(self, run: Path) -> Shift:
        from manip_il.evaluation.certify import certify, count_episodes
        from manip_il.evaluation.side import read_member
        from manip_il.theory.shift import find_rounds, measure_shift

        rounds = find_rounds(run)
        validation = read_member(run).validation
        env = validation.env()
        count = count_episodes(env, self.cases) + self.episodes * (1 + len(rounds))
        with progress(count, f"theory {run}") as bar, self.engine.open() as engine:
            certificate = certify(engine, env, self.cases, on_episode=lambda _: bar.step())
            u, conditions = certificate.mu or 0, validation.settings.conditions
            return measure_shift(engine, env, rounds, u, self.episodes, lambda _: bar.step(), conditions)
