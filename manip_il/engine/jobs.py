"""One rollout job: all that a worker must know to turn seeds into episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal, cast

from manip_il.data.episodes import group_rollouts, to_episode
from manip_il.engine.branches import Brancher
from manip_il.engine.choose import choose_driver
from manip_il.engine.query import LabelMode, QueryRule, drawn_step
from manip_il.engine.sight import drawn_cameras
from manip_il.errors import UsageError
from manip_il.expert.expert import Expert
from manip_il.mdp import Actor, Episode, Transition
from manip_il.rollout import Environment, Intruder, Rules, rollout
from manip_il.sim.conditions import Condition, changes_object, draw
from manip_il.sim.disturb import Disturbance, Disturber, disturbance_of
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.look import CameraConfig
from manip_il.sim.perturb import Perturbation, Perturber
from manip_il.sim.scene import build_scene
from manip_il.sim.varied import VariedEnv

LOCKSTEP = 25  # environments that share one call of the policy
OWN_MODELS = 8  # at most so many where each needs a model of its own, which is 26 MB for the Panda


@dataclass(frozen=True)
class RolloutJob:
    """Who drives in which environment, for how long, and what is kept.

    policy: a checkpoint's `pretrained_model` folder, needed where a learner drives; ensemble: others that answer with
    it where `query` wants their disagreement. beta: the share of steps that the expert drives (`mixture`). noise: the
    covariance (n, n) of a noisy expert's actions. hold: end an episode this many steps after success; None: at the
    horizon.

    label: what the expert gives in the states that `query` selects. `per_state`: its label. `takeover`: from the
    first one on it drives to the end, for which it has a horizon of its own. `branch`: in a copy of the simulator it
    drives `branch_steps` ahead. `last`: none of this, but the label of the last state, for its phase.

    perturbation: what happens once, in place of a disturbance. conditions: what an evaluation's episodes meet, in turn
    by their seeds, in place of both.

    batch: episodes that share one call of the policy, at most; it changes no outcome. trust: whether models that the
    policies' checkpoints name may be loaded.

    cameras: what is pictured in every step and kept; None for nothing. A policy that looks at cameras is shown them
    all the same.
    """

    env: EnvConfig
    driver: Literal["expert", "noisy_expert", "policy", "mixture", "random"]
    policy: Path | None = None
    ensemble: tuple[Path, ...] = ()
    beta: float = 0.0
    noise: tuple[tuple[float, ...], ...] = ()
    hold: int | None = None
    label: LabelMode = "per_state"
    query: QueryRule = field(default_factory=QueryRule)
    branch_steps: int = 1
    disturbance: Disturbance = field(default_factory=Disturbance)
    perturbation: Perturbation | None = None
    conditions: tuple[Condition, ...] = ()
    batch: int = LOCKSTEP
    round: int = 0
    cameras: CameraConfig | None = None
    trust: bool = False

    def __post_init__(self) -> None:
        if self.driver in ("policy", "mixture") and self.policy is None:
            raise UsageError(f"a rollout driven by {self.driver!r} needs a policy's folder")
        if self.driver == "noisy_expert" and not self.noise:
            raise UsageError("a rollout driven by 'noisy_expert' needs its noise")
        if self.label == "takeover" and self.driver != "policy":
            raise UsageError(f"the expert takes over from a policy; this rollout is driven by {self.driver!r}")
        if self.query.kind == "ensemble" and not self.ensemble:
            raise UsageError("query=ensemble needs other policies to disagree with")
        if self.perturbation is not None and self.disturbance != Disturbance():
            raise UsageError("a rollout has a disturbance or a perturbation, not both")
        if self.conditions and (self.perturbation is not None or self.disturbance != Disturbance()):
            raise UsageError("a rollout has conditions, or a disturbance or perturbation, not both")
        if self.batch < 1:
            raise UsageError(f"batch is {self.batch}; expected at least 1")
        if self.branch_steps < 1:
            raise UsageError(f"branch_steps is {self.branch_steps}; expected at least 1")


def run_job(job: RolloutJob, seeds: Sequence[int]) -> Iterator[Episode]:
    """Yield one episode a seed, in the order in which they end."""
    if not seeds:
        return
    cameras = drawn_cameras(job)
    envs = [_environment(job.env, cameras, job.conditions) for _ in range(min(side_by_side(job), len(seeds)))]
    expert = _expert(job.env.robot, job.env.task)
    driver = choose_driver(job, envs[0])
    transitions = rollout(envs, seeds, driver, _rules(job), expert, _intrude(job))
    if job.cameras is None and cameras is not None:
        transitions = map(_without_pictures, transitions)
    brancher = Brancher(_environment(job.env, job.cameras), expert, job.branch_steps) if job.label == "branch" else None
    for frames in group_rollouts(transitions):
        yield _finish(job, frames, expert, brancher)


def side_by_side(job: RolloutJob) -> int:
    """Environments of a job that run in lockstep in one process."""
    if job.policy is None:
        return 1  # alone, an environment has the processor's cache
    own_models = any(changes_object(condition.ranges) for condition in job.conditions)
    return min(job.batch, OWN_MODELS) if own_models else job.batch


def _rules(job: RolloutJob) -> Rules:
    if job.label == "last":
        return Rules(job.env.horizon, job.hold, "last")
    twice = 2 if job.label == "takeover" else 1  # a horizon for the learner, and one for the expert
    everywhere = job.label == "per_state" and job.query.kind == "every"
    return Rules(twice * job.env.horizon, job.hold, "every" if everywhere else "driver")


def _finish(job: RolloutJob, frames: list[Transition], expert: Expert, brancher: Brancher | None) -> Episode:
    if job.label == "last":
        return to_episode(frames, job.round, job.beta, labelled=False)
    if job.query.kind == "one" and job.label != "takeover":
        chosen = drawn_step(frames[0].seed, len(frames))
        frames[chosen] = replace(frames[chosen], label=expert.label(frames[chosen].state))
    if job.label == "takeover":
        return to_episode(_cut_at_takeover(frames, job.env.horizon), job.round, job.beta)
    if brancher is None:
        return to_episode(frames, job.round, job.beta)
    path = [replace(frame, label=None) for frame in frames]
    return to_episode([*path, *brancher.from_labelled(frames)], job.round, job.beta, path=len(path))


def _cut_at_takeover(frames: list[Transition], horizon: int) -> list[Transition]:
    """The learner's frames as a part of their own, with its end; all of them, up to the horizon, where it drove on."""
    taken = next((i for i, frame in enumerate(frames) if frame.actor != Actor.LEARNER), None)
    if taken == 0:
        return frames
    last = min(len(frames) if taken is None else taken, horizon) - 1
    rest = [] if taken is None else frames[taken:]
    return [*frames[:last], replace(frames[last], done=True), *rest]


def _environment(env: EnvConfig, cameras: CameraConfig | None, conditions: tuple[Condition, ...] = ()) -> ManipEnv:
    make = partial(VariedEnv, conditions) if any(condition.ranges for condition in conditions) else ManipEnv
    if cameras is None:
        return make(config=env)
    return make(config=env, cameras=cameras.names, image_size=cameras.size, look=cameras.look)


def _without_pictures(transition: Transition) -> Transition:
    final = replace(transition.final, images={}) if transition.final else None
    return replace(transition, observation=replace(transition.observation, images={}), final=final)


@cache
def _expert(robot: str, task: str) -> Expert:
    return Expert(build_scene(robot, task))


def _intrude(job: RolloutJob):
    disturbing = any({"knock", "action_noise"} & condition.ranges.keys() for condition in job.conditions)
    if job.disturbance == Disturbance() and job.perturbation is None and not disturbing:
        return None

    def make(env: Environment, seed: int) -> Intruder | None:
        if disturbing:
            asked = disturbance_of(draw(job.conditions, seed))
            return None if asked == Disturbance() else Disturber(cast(ManipEnv, env), asked, seed)
        if job.perturbation is not None:
            return Perturber(cast(ManipEnv, env), job.perturbation, seed)
        return Disturber(cast(ManipEnv, env), job.disturbance, seed)

    return make
