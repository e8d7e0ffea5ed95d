"""`manip-il theory`: the proven bounds of cloning and DAgger, on small MDPs and on the rounds of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from manip_il.cli.common_options import EngineOptions
from manip_il.cli.outputs import Output, output_folder
from manip_il.option import option


@dataclass(frozen=True)
class TheoryOptions(EngineOptions, Output):
    """Compare the proven bounds of cloning and DAgger with exactly solved MDPs, linear systems and the arm.

    Writes report.html and theory.json. SOURCE is a run of `manip-il dagger`: for every round, the policy's
    distribution shift and its excess cost are measured, and the cost is compared with DAgger's bound.

    Example: manip-il theory runs/dagger --output_dir=runs/theory
    """

    source: Path | None = option(None, "a run of manip-il dagger, to measure its rounds", positional=True, exists="")
    episodes: int = option(50, "episodes of the expert and of every round's policy", at_least=2)
    cases: int = option(30, "episodes per kind of perturbation, to measure the cost of a wrong action", at_least=1)
    output_dir: Path = output_folder("runs/theory")
