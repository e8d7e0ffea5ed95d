"""`manip-il replay`: one episode of an evaluation again; `manip-il merge`: evaluations of several files as one."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_policy, find_policy, require_eval
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, atomic_write, open_output, require_new
from manip_il.cli.progress import say, warn
from manip_il.errors import ManipError, UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.evaluation.results import EpisodeResult, EvalResult

NO_FILES = ("expert", "random")  # drivers that are no policy, so that nothing is loaded


@dataclass
class PolicyPathGroup:
    """`--policy.*` of what is replayed."""

    path: Path | None = option(None, "its current path; by default the one in eval.json")


@dataclass
class ReplayOptions:
    """Run one episode of an evaluation again, alone: the same policy, seed and conditions.

    Prints the drawn conditions and the outcome, films the episode, and exits with 1 if the outcome is not that of
    eval.json.
    """

    example: ClassVar[str] = "manip-il replay runs/eval/eval.json --episode 17 --video out.mp4"
    file: Path = option(MISSING, "an eval.json, or its folder", positional=True)
    episode: int = option(MISSING, "which of its episodes, the first one is 0")
    video: Path | None = option(None, "an MP4 to write")
    policy: PolicyPathGroup = field(default_factory=PolicyPathGroup)
    trust: bool = common.trust_option()

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_eval(self.file)
        if self.policy.path is not None:
            find_policy(self.policy.path)

    def run(self) -> None:
        """Run the episode, print what was drawn, film it, compare the outcome."""
        from manip_il.evaluation.film import Shot, run_states
        from manip_il.evaluation.results import EvalResult
        from manip_il.evaluation.runner import episode_result, replay_differences

        result = EvalResult.read(self.file)
        if not 0 <= self.episode < len(result.episodes):
            raise UsageError(f"--episode is {self.episode}; {self.file} has episodes 0 to {len(result.episodes) - 1}")
        before = result.episodes[self.episode]
        job = self._job(result)
        episode = run_states(job, before.seed)
        say(_text(before))
        if self.video is not None:
            atomic_write(self.video, Shot.of(job, episode).film().mp4)
            say(f"video: {self.video}")
        if differences := replay_differences(before, episode_result(job, episode)):
            raise ManipError(
                f"episode {self.episode} differs from {self.file}: {'; '.join(differences)}; across "
                "machines and versions success rates can be compared, single episodes cannot"
            )
        say(f"the same as in {self.file}")

    def _job(self, result: EvalResult) -> RolloutJob:
        """Return the rollouts of the evaluation; warn if policy or program have changed since."""
        from manip_il.collect.drivers import PolicyDriver, driver_of
        from manip_il.collect.environments import env_fingerprint
        from manip_il.collect.job import RolloutJob
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.learn.checkpoint import Checkpoint
        from manip_il.learn.policy_files import policy_sha256

        env = result.settings.env(result.robot, result.task)
        conditions, hold = result.settings.conditions, result.settings.hold
        job = RolloutJob(env, hold=hold, label="last", conditions=conditions)
        if result.policy in NO_FILES and not result.policy_sha256 and self.policy.path is None:
            cameras, job = None, replace(job, driver=driver_of(result.policy))
        else:
            path = self._find(result)
            cameras = check_policy(Checkpoint.open(path), env, trust=self.trust)
            if result.policy_sha256 not in ("", policy_sha256(path)):
                warn(f"{path} is not the policy of {self.file}: its files differ")
            job = replace(job, driver=PolicyDriver((path,), trust=self.trust))
        here = env_fingerprint(env, cameras)
        warn(*compare_fingerprints(str(self.file), dict(result.fingerprint), "this machine", here))
        return job

    def _find(self, result: EvalResult) -> Path:
        if self.policy.path is not None:
            return find_policy(self.policy.path)
        try:
            return find_policy(Path(result.policy))
        except UsageError:
            raise UsageError(
                f"{self.file} is of {result.policy}, which is not here (paths are relative to where eval ran); "
                "give --policy.path=DIR"
            ) from None


def _text(result: EpisodeResult) -> str:
    """Seed, condition and outcome, and a line for each number that was drawn."""
    first = result.detail.get("steps_to_success")
    solved = f"success after {first} steps" if first is not None else "success" if result.success else "failure"
    ended = "at the goal at the end" if result.success_at_end else f"ended in phase {result.phase_at_end}"
    lines = [f"seed {result.seed}, {result.detail.get('condition', 'nominal')}: {solved}, {ended}"]
    return "\n".join(lines + [f"  {name}: {_short(value)}" for name, value in result.detail.get("drawn", {}).items()])


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    if isinstance(value, dict):
        return "; ".join(f"{name} {_short(one)}" for name, one in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass
class MergeOptions:
    """Merge evaluations of one policy on different seeds, for example from several containers, into one eval.json.

    Refused if policy, robot, task or settings differ, or if a seed was run twice.
    """

    example: ClassVar[str] = "manip-il merge out/0 out/1 out/2 --output_dir=out/all"
    files: list[Path] = option(MISSING, "two or more eval.json, or their folders", positional=True)
    output_dir: Path = option(Path("runs/merged"), "folder of the merged eval.json")
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
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.eval_report import eval_report
        from manip_il.evaluation.results import FILE_NAME, EvalResult, merge_results

        parts = {str(path): EvalResult.read(path) for path in self.files}
        merged = merge_results(parts)
        (first, one), *others = parts.items()
        for name, other in others:
            warn(*compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
        with open_output(self):
            merged.write(self.output_dir / FILE_NAME)
            report = eval_report(merged, command_line("merge", self), to_plain(self))
            report.write(self.output_dir / REPORT_FILE)
        say_result(merged)
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"report: {self.output_dir / REPORT_FILE}")


def say_result(result: EvalResult) -> None:
    """Print an evaluation's table, and the phases that failures ended in."""
    from manip_il.evaluation.tables import evaluation_table, print_table

    print_table(evaluation_table(result))
    if result.failures:
        phases = ", ".join(f"{phase} {count}" for phase, count in result.failures.items())
        say(f"failures by the phase that they ended in: {phases}")
