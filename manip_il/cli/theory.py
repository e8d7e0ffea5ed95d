"""`manip-il theory`: the theorems on cloning and DAgger, seen on small processes, and on the rounds of a run."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.inputs import require_folder
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import open_output, require_new
from manip_il.cli.progress import progress, say
from manip_il.errors import UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.theory.shift import Shift


@dataclass
class TheoryOptions:
    """Show what is proved of cloning and DAgger: on processes solved exactly, on linear systems, on the arm.

    Writes report.html and theory.json. SOURCE is the folder of a run of `manip-il dagger`: its distribution shift,
    round by round, beside the theorem's bound.
    """

    example: ClassVar[str] = "manip-il theory runs/dagger --output_dir=runs/theory"
    source: Path | None = option(None, "a run of manip-il dagger, to look at its rounds", positional=True)
    episodes: int = option(50, "of the expert and of every round's policy")
    cases: int = option(30, "wrong actions of each kind, to find what one costs the expert")
    workers: int | None = common.workers_option()
    output_dir: Path = option(Path("runs/theory"), "folder of report.html")
    overwrite: bool = option(False, "replace an existing one")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        for name, least in (("episodes", 2), ("cases", 1)):
            if getattr(self, name) < least:
                raise UsageError(f"--{name} is {getattr(self, name)}; expected at least {least}")
        common.require_workers(self.workers)
        if self.source is not None:
            require_folder(self.source, "a run of manip-il dagger")
        require_new(self.output_dir, overwrite=self.overwrite)

    def run(self) -> None:
        """Compute, measure, write the page and the file, print the slopes."""
        from manip_il.evaluation.results import write_json
        from manip_il.theory.bounds import all_curves
        from manip_il.theory.linear import drifts
        from manip_il.theory.processes import PROCESSES
        from manip_il.theory.report import FILE_NAME, PAGE, Theory, summary_lines, theory_report

        timings, begin = dict[str, float](), time.monotonic()
        with open_output(self) as folder:
            shift = None
            if self.source is not None:
                shift = self._shift(self.source)
                timings["the run"] = time.monotonic() - begin
            begin, curves = time.monotonic(), []
            with progress(6 * len(PROCESSES), "theorems") as bar:
                for curve in all_curves():
                    curves.append(curve)
                    bar.advance()
            theory = Theory(tuple(curves), tuple(drifts()), shift)
            timings["theorems"] = time.monotonic() - begin
            write_json(folder / FILE_NAME, theory.to_json())
            report = theory_report(theory, command_line("theory", self), to_plain(self), timings)
            report.write(folder / PAGE)
        for line in summary_lines(theory):
            say(line)
        say(f"report: {folder / PAGE}")

    def _shift(self, run: Path) -> Shift:
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.arm import common_env, read_arm
        from manip_il.evaluation.certify import certify, count_episodes
        from manip_il.theory.shift import find_rounds, measure_shift

        rounds = find_rounds(run)
        env = common_env(read_arm(run).members, lambda _: common.EnvOptions().env_config())
        count = count_episodes(env, self.cases) + self.episodes * (1 + len(rounds))
        with progress(count, f"theory {run}") as bar, Engine(self.workers) as engine:
            certificate = certify(engine, env, self.cases, on_episode=lambda _: bar.advance())
            gaps = certificate.actions.gaps
            u = gaps.largest if gaps else 0
            return measure_shift(engine, env, rounds, u, self.episodes, lambda _: bar.advance())
