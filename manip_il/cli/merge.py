"""`manip-il merge`: the parts of one evaluation, run on several machines, as one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli.folders import prepare_output
from manip_il.cli.groups import command_line, option, save_options, warn
from manip_il.cli.options import to_plain
from manip_il.cli.paths import require_eval, require_new
from manip_il.cli.progress import say
from manip_il.errors import FolderExistsError, UsageError

REPORT_FILE = "report.html"


@dataclass
class MergeOptions:
    """Merge evaluations of one policy on different seeds, for example from several containers, into one eval.json.

    Refused if policy, robot, task or settings differ, or if a seed was run twice.
    """

    example: ClassVar[str] = "manip-il merge out/0 out/1 out/2 --output_dir=out/all"
    files: list[Path] = field(metadata={"help": "two or more eval.json, or their folders", "positional": True})
    output_dir: Path = field(default=Path("runs/merged"), metadata={"help": "folder of the merged eval.json"})
    overwrite: bool = option(False, "replace an existing merged evaluation")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if len(self.files) < 2:
            raise UsageError(f"{self.files[0]} is the only one; expected two or more evaluations to merge")
        for path in self.files:
            if self.files.count(path) > 1:
                raise UsageError(f"{path} is given twice; expected every evaluation once")
            require_eval(path)
        require_new(self.output_dir, overwrite=self.overwrite)

    def run(self) -> None:
        """Read all, merge, write, print the table."""
        from manip_il.data.atomic import exclusive
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.eval_report import eval_report
        from manip_il.evaluation.results import FILE_NAME, EvalResult, merge_results
        from manip_il.evaluation.tables import evaluation_lines, evaluation_table, print_table

        parts = {str(path): EvalResult.read(path) for path in self.files}
        merged = merge_results(parts)
        (first, one), *others = parts.items()
        for name, other in others:
            warn(compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
        with exclusive(self.output_dir):
            try:
                prepare_output(self.output_dir, resume=False, overwrite=self.overwrite)
            except FolderExistsError:
                raise UsageError(f"{self.output_dir} exists already; replace it with --overwrite=true") from None
            save_options(self.output_dir, self)
            merged.write(self.output_dir / FILE_NAME)
            report = eval_report(merged, command=command_line("merge", self), config=to_plain(self))
            report.write(self.output_dir / REPORT_FILE)
        print_table(evaluation_table(merged))
        for line in evaluation_lines(merged):
            say(line)
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"report: {self.output_dir / REPORT_FILE}")
