"""What `manip-il eval` does without new episodes: run one again, merge evaluations, or look at the machine."""

from __future__ import annotations

import json
import multiprocessing
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from manip_il.cli.inputs import open_driver
from manip_il.cli.progress import say, warn
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import default_workers
from manip_il.data.atomic import write_file
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.evaluation.film import Shot, run_states
from manip_il.evaluation.policy_folder import find_policy
from manip_il.evaluation.results import EvalResult, merge_results
from manip_il.evaluation.runner import episode_result, replay_differences
from manip_il.learn.checkpoint import policy_sha256
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.tasks.envs import make_env

NO_FILES = ("expert", "random")  # drivers that are no policy, so that nothing is loaded


def replay(
    file: Path, seed: int, policy: Path | None, video: Path | None, own: Mapping[str, str], *, trust: bool
) -> None:
    """Run one episode of an evaluation again: the same policy, seed and conditions. Prints what was drawn.

    policy: its current path, by default the one in the evaluation. video: an MP4 to write. own: the files of its task
    and its object's mesh, as its settings name them, if they do not ship. Raises `ManipError` if the outcome is not
    that of the evaluation, `UsageError` for a seed or a policy that is not there.
    """
    result = EvalResult.read(file)
    by_seed = {episode.seed: episode for episode in result.episodes}
    if seed not in by_seed:
        raise UsageError(f"--replay is {seed}; {file} has the seeds {min(by_seed)} to {max(by_seed)}")
    before, job = by_seed[seed], _job(result, file, policy, own, trust)
    episode = run_states(job, seed)
    ended = "success" if before.success else f"failure in phase {before.phase_at_end}"
    say(f"seed {seed}, {before.detail.get('condition', 'nominal')}: {ended}")
    say(*(f"  {name}: {json.dumps(value)}" for name, value in before.detail.get("drawn", {}).items()))
    if video is not None:
        write_file(video, Shot(job, episode).film().mp4)
        say(f"video: {video}")
    if differences := replay_differences(before, episode_result(job, episode)):
        raise ManipError(
            f"the episode of seed {seed} differs from {file}: {'; '.join(differences)}; across "
            "machines and versions success rates can be compared, single episodes cannot"
        )
    say(f"the same as in {file}")


def _job(result: EvalResult, file: Path, policy: Path | None, own: Mapping[str, str], trust: bool) -> RolloutJob:
    """Return the rollouts of the evaluation; warn if policy or program have changed since."""
    settings = replace(result.settings, object=own.get("object", result.settings.object))
    env = settings.env(result.robot, own.get("task", result.task))
    if (given := env_spec(env).task) != result.task:
        raise MismatchError("task", str(file), result.task, "--task.type", given)
    is_policy = result.policy not in NO_FILES or bool(result.policy_sha256) or policy is not None
    path = find_policy(policy or Path(result.policy)) if is_policy else None
    _, driver, cameras = open_driver(path, result.policy, env, trust=trust)
    if path is not None and result.policy_sha256 not in ("", policy_sha256(path)):
        warn(f"{path} is not the policy of {file}: its files differ")
    here = env_fingerprint(env, cameras)
    warn(*compare_fingerprints(str(file), dict(result.fingerprint), "this machine", here))
    return RolloutJob(env, driver, settings.hold, label="last", conditions=settings.conditions)


def merge(files: Sequence[Path]) -> EvalResult:
    """Return the parts of an evaluation as one; warns if they were made with different versions or models."""
    parts = {str(path): EvalResult.read(path) for path in files}
    merged = merge_results(parts)
    (first, one), *others = parts.items()
    for name, other in others:
        warn(*compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
    return merged


def machine() -> str:
    """Return renderer, PyTorch and cores in one line. Raises what an evaluation without them would raise."""
    tempfile.TemporaryFile().close()
    multiprocessing.get_context("spawn").Lock()  # which lies in /dev/shm
    env = make_env()
    env.start(0)
    render.pictures(env.scene, env.data, CameraConfig(CAMERAS))
    from OpenGL import GL  # mujoco has chosen its platform

    names = (GL.glGetString(name) for name in (GL.GL_VENDOR, GL.GL_RENDERER))
    renderer = " ".join(name.decode(errors="replace") for name in names if name)
    return f"{renderer}; torch {metadata.version('torch')}; cores {default_workers()}"
