"""Files of evaluations: episodes as they end, one of them again (`manip-il replay`), several files as one (`merge`)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_policy, find_policy, require_eval
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, append_jsonl, atomic_write, open_output, read_jsonl, require_new
from manip_il.cli.progress import say, warn
from manip_il.cli.trials import Shot
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.evaluation.results import EpisodeResult, EvalResult

EPISODES_FILE = "episodes.jsonl"
NO_FILES = ("expert", "random")  # drivers that are no policy, so that nothing is loaded


@dataclass(frozen=True)
class EpisodeJournal:
    """Episodes of an evaluation as they end: `episodes.jsonl`, first what all have in common, then a line for each."""

    path: Path

    @classmethod
    def open(cls, folder: Path, job: RolloutJob, suite: str) -> EpisodeJournal:
        """Return the file in `folder`, begun where there is none.

        Raises `MismatchError` where its episodes are those of another policy, environment or version of this program.
        """
        journal, common = cls(folder / EPISODES_FILE), _common(job, suite)
        lines = read_jsonl(journal.path)
        if not lines:
            append_jsonl(journal.path, common)
            return journal
        for key, now in common.items():
            before = lines[0].get(key)
            if before != now:
                what = f"{key} ({folder} was started with another; --overwrite=true starts over)"
                raise MismatchError(what, "then", before, "now", now)
        return journal

    def add(self, result: EpisodeResult) -> None:
        """Append one, at once."""
        append_jsonl(self.path, result.to_json())

    def results(self, seeds: Collection[int]) -> dict[int, EpisodeResult]:
        """Return the results of these seeds that are there. Raises `ManipError` for a line that is not an episode."""
        from manip_il.evaluation.results import EpisodeResult

        found: dict[int, EpisodeResult] = {}
        for line in read_jsonl(self.path)[1:]:
            try:
                result = EpisodeResult.from_json(line)
            except (KeyError, ManipError) as error:
                why = f"{error} is missing" if isinstance(error, KeyError) else error
                text = f"a line that is not an episode ({why}); start again with --overwrite=true"
                raise ManipError(f"{self.path}: {text}") from error
            if result.seed in seeds:
                found[result.seed] = result
        return found


def _common(job: RolloutJob, suite: str) -> dict[str, Any]:
    from manip_il.collect.environments import env_fingerprint
    from manip_il.collect.job import observed_cameras
    from manip_il.evaluation.results import EvalSettings
    from manip_il.learn.policy_files import policy_sha256

    return {
        "policy_sha256": policy_sha256(job.policy) if job.policy is not None else job.driver.name,
        "fingerprint": env_fingerprint(job.env, observed_cameras(job)),
        "settings": EvalSettings.of(job, suite).to_json(),
    }


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
        from manip_il.evaluation.results import EvalResult

        result = EvalResult.read(self.file)
        if not 0 <= self.episode < len(result.episodes):
            raise UsageError(f"--episode is {self.episode}; {self.file} has episodes 0 to {len(result.episodes) - 1}")
        before = result.episodes[self.episode]
        job = self._job(result)
        from manip_il.evaluation.film import run_states
        from manip_il.evaluation.runner import episode_result

        episode = run_states(job, before.seed)
        after = episode_result(job, episode)
        say(_text(before))
        if self.video is not None:
            film, _ = Shot.of(job, episode).film()
            atomic_write(self.video, film.mp4)
            say(f"video: {self.video}")
        differences = _differences(before, after)
        if differences:
            raise ManipError(
                f"episode {self.episode} differs from {self.file}: {'; '.join(differences)}; across "
                "machines and versions success rates can be compared, single episodes cannot"
            )
        say(f"the same as in {self.file}")

    def _job(self, result: EvalResult) -> RolloutJob:
        """Return the rollouts of the evaluation; warn where policy or program have changed since."""
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
    drawn: dict[str, Any] = dict(result.detail.get("drawn", {}))
    first = result.detail.get("steps_to_success")
    solved = f"success after {first} steps" if first is not None else "success" if result.success else "failure"
    ended = "at the goal at the end" if result.success_at_end else f"ended in phase {result.phase_at_end}"
    lines = [f"seed {result.seed}, {result.detail.get('condition', 'nominal')}: {solved}, {ended}"]
    return "\n".join(lines + [f"  {name}: {_short(value)}" for name, value in drawn.items()])


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    if isinstance(value, dict):
        return "; ".join(f"{name} {_short(one)}" for name, one in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _differences(before: EpisodeResult, after: EpisodeResult) -> list[str]:
    """Return in what two runs of one episode differ; `MismatchError` where they had other conditions."""
    now = dict(after.detail["drawn"])
    if before.detail.get("drawn", {}) != now:
        raise MismatchError("what is drawn for the episode", "then", before.detail.get("drawn"), "now", now)
    pairs = {name: (getattr(before, name), getattr(after, name)) for name in ("success", "success_at_end", "steps")}
    pairs |= {"return": (before.ret, after.ret)}
    return [f"{name} was {was}, is {value}" for name, (was, value) in pairs.items() if was != value]


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
        from manip_il.evaluation.tables import evaluation_lines, evaluation_table, print_table

        parts = {str(path): EvalResult.read(path) for path in self.files}
        merged = merge_results(parts)
        (first, one), *others = parts.items()
        for name, other in others:
            warn(*compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
        with open_output(self):
            merged.write(self.output_dir / FILE_NAME)
            report = eval_report(merged, command=command_line("merge", self), config=to_plain(self))
            report.write(self.output_dir / REPORT_FILE)
        print_table(evaluation_table(merged))
        for line in evaluation_lines(merged):
            say(line)
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"report: {self.output_dir / REPORT_FILE}")
