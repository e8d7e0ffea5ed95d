"""`manip-il replay`: one episode of an evaluation again, alone, from its line in eval.json."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.cli.folders import atomic_write
from manip_il.cli.groups import find_policy, trust_option, warn
from manip_il.cli.paths import require_eval
from manip_il.cli.progress import say
from manip_il.errors import ManipError, MismatchError, UsageError

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.results import EpisodeResult, EvalResult

NO_FILES = ("expert", "random")


@dataclass
class PlaceGroup:
    """`--policy.*` of what is replayed."""

    path: Path | None = field(default=None, metadata={"help": "its current path; by default the one in eval.json"})


@dataclass
class ReplayOptions:
    """Run one episode of an evaluation again, alone: the same policy, seed and conditions.

    Prints the drawn conditions and the outcome, films the episode, and exits with 1 if the outcome is not that of
    eval.json.
    """

    example: ClassVar[str] = "manip-il replay runs/eval/eval.json --episode 17 --video out.mp4"
    file: Path = field(metadata={"help": "an eval.json, or its folder", "positional": True})
    episode: int = field(metadata={"help": "which of its episodes, the first one is 0"})
    video: Path | None = field(default=None, metadata={"help": "an MP4 to write"})
    policy: PlaceGroup = field(default_factory=PlaceGroup)
    trust: bool = trust_option()

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_eval(self.file)
        if self.policy.path is not None:
            find_policy(self.policy.path)

    def run(self) -> None:
        """Run it, tell, film, compare."""
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
        for line in _told(before):
            say(line)
        if self.video is not None:
            from manip_il.cli.shown import film_episode

            atomic_write(self.video, film_episode(job, episode).mp4)
            say(f"video: {self.video}")
        differences = _differences(before, after)
        if differences:
            raise ManipError(
                f"episode {self.episode} differs from {self.file}: {'; '.join(differences)}; across "
                "machines and versions success rates can be compared, single episodes cannot"
            )
        say(f"the same as in {self.file}")

    def _job(self, result: EvalResult) -> RolloutJob:
        """As the evaluation had it; warns where policy or program are not those of then."""
        from manip_il.cli.policy_check import check_policy
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.engine.environments import env_fingerprint, policy_sha256
        from manip_il.engine.jobs import RolloutJob
        from manip_il.learn.checkpoint import read_meta

        env = result.settings.env(result.robot, result.task)
        conditions, hold = result.settings.conditions, result.settings.hold
        if result.policy in NO_FILES and not result.policy_sha256 and self.policy.path is None:
            cameras = None
            job = RolloutJob(env, result.policy, hold=hold, label="last", conditions=conditions)  # pyright: ignore[reportArgumentType]
        else:
            path = self._find(result)
            cameras = check_policy(path, read_meta(path), env, trust=self.trust)
            if result.policy_sha256 not in ("", policy_sha256(path)):
                warn([f"{path} is not the policy of {self.file}: its files differ"])
            job = RolloutJob(env, "policy", policy=path, hold=hold, label="last", conditions=conditions)
            job = replace(job, trust=self.trust)
        here = env_fingerprint(env, cameras)
        warn(compare_fingerprints(str(self.file), dict(result.fingerprint), "this machine", here))
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


def _told(result: EpisodeResult) -> list[str]:
    drawn: dict[str, Any] = dict(result.detail.get("drawn", {}))
    first = result.detail.get("steps_to_success")
    solved = f"success after {first} steps" if first is not None else "success" if result.success else "failure"
    ended = "at the goal at the end" if result.success_at_end else f"ended in phase {result.phase_at_end}"
    lines = [f"seed {result.seed}, {result.detail.get('condition', 'nominal')}: {solved}, {ended}"]
    return lines + [f"  {name}: {_short(value)}" for name, value in drawn.items()]


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    if isinstance(value, dict):
        return "; ".join(f"{name} {_short(one)}" for name, one in value.items())
    return str(value)


def _differences(before: EpisodeResult, after: EpisodeResult) -> list[str]:
    """In what two runs of one episode differ. Raises `MismatchError` where not even the circumstances are the same."""
    if before.detail.get("drawn", {}) != dict(after.detail["drawn"]):
        raise MismatchError(
            "what is drawn for the episode", "then", before.detail.get("drawn"), "now", dict(after.detail["drawn"])
        )
    pairs = {name: (getattr(before, name), getattr(after, name)) for name in ("success", "success_at_end", "steps")}
    pairs |= {"return": (before.ret, after.ret)}
    return [f"{name} was {then}, is {now}" for name, (then, now) in pairs.items() if then != now]
