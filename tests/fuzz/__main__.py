"""`python -m tests.fuzz`: so many mutated inputs over all targets, read by pytest's workers, which may hang or die.

pytest-xdist names the input at which a worker ended, and starts another worker for the inputs that are left.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import pytest


class Table:
    """Of every target: what came of its inputs, the seconds and megabytes that they took."""

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        head = f"{'target':24}{'inputs':>7}{'accepted':>10}{'refused':>9}{'findings':>10}{'all [s]':>10}"
        terminalreporter.write_line(f"{head}{'slowest [s]':>13}{'largest [MB]':>14}")
        everything = [one for kind in ("passed", "failed") for one in terminalreporter.stats.get(kind, ())]
        targets: dict[str, list[pytest.TestReport]] = {}
        for report in everything:
            targets.setdefault(re.sub(r".*\[(.*) \d+\].*", r"\1", report.nodeid), []).append(report)
        for name, reports in {**targets, "all": everything}.items():
            findings = sum(report.failed for report in reports)
            tried = [dict(report.user_properties) for report in reports if report.user_properties]  # not where one died
            accepted = sum(bool(one["accepted"]) for one in tried)
            counts = f"{len(reports):>7,}{accepted:>10,}{len(reports) - findings - accepted:>9,}{findings:>10,}"
            seconds, megabytes = ([0, *(float(str(one[key])) for one in tried)] for key in ("seconds", "megabytes"))
            terminalreporter.write_line(
                f"{name:24}{counts}{sum(seconds):>10.0f}{max(seconds):>13.2f}{max(megabytes):>14.0f}"
            )


def main() -> int:
    """Return 0 where no input ended otherwise than it should."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--target", default="", help="of this one alone; of several by the beginning of their names")
    parser.add_argument("--number", type=int, help="this one input, in this process")
    parser.add_argument("--output", type=Path, default=Path("runs/fuzz"), help="where findings are kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="manip-il-fuzz-", ignore_cleanup_errors=True) as home:
        os.environ |= {"HF_HUB_OFFLINE": "1", "HOME": home}  # a process that harms nobody
        return run(options, parser, [f"--basetemp={home}/tests"])


def run(options: argparse.Namespace, parser: argparse.ArgumentParser, words: list[str]) -> int:
    from manip_il.sim.gl import choose_backend

    from .table import TARGETS

    targets = [target.name for target in TARGETS if target.name == options.target]
    targets = targets or [target.name for target in TARGETS if target.name.startswith(options.target)]
    if not targets:
        parser.error(f"no such target; there are: {', '.join(target.name for target in TARGETS)}")
    words += [str(Path(__file__).with_name("test_fuzz.py")), "-q", "--disable-warnings", "-p", "no:cacheprovider"]
    if options.number is None:
        shutil.rmtree(options.output, ignore_errors=True)
        words += [f"--numprocesses={options.workers}", "--dist=worksteal", f"--max-worker-restart={options.inputs}"]
    else:
        targets, words = targets[:1], [*words, "--capture=no"]
    choose_backend()
    settings = {**vars(options), "targets": targets, "output": str(options.output.absolute())}
    os.environ["MANIP_IL_FUZZ"] = json.dumps(settings)
    return pytest.main(words, plugins=[Table()])


if __name__ == "__main__":
    sys.exit(main())
