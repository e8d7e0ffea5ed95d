"""Run `manip-il rl gail`, `airl`, `ppo`: reinforcement learning from demonstrations or a learnt
reward.
"""

from dataclasses import replace
from typing import Any

from manip_il.algorithms.results import validation_report, validations
from manip_il.chapter.config import LearningConfig
from manip_il.chapter.learning import LearningRun
from manip_il.chapter.reward import LearnedReward
from manip_il.cli.chapter import GailOptions, Learning, PpoOptions
from manip_il.cli.outputs import Stages, about, say
from manip_il.cli.run.imitation import say_best
from manip_il.collect.inputs import open_dataset
from manip_il.learn.checkpoint import Origin, find_policy
from manip_il.learn.samples import check_same_sources
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.table import env_spec, stored_config


def _run(options: Learning, config: LearningConfig) -> None:
    """Run all iterations, and write the report."""
    with options.open() as folder:
        with Stages() as stages, options.open_engine() as engine:
            stages.start(f"{options.method.upper()}, steps", config.steps)
            for result in LearningRun(config, folder, engine).results():
                stages.log({"step": result.steps} | result.metrics)
                if result.validated is not None:
                    say(f"{result.steps:,} steps: validation success {result.validated.success}")
        title = f"{options.method.upper()} on {config.env.robot} {config.env.task}"
        page = validation_report(folder, title, "initial policy", validations(folder))
        replace(page, **about(options)).write(folder)
    say_best(folder)


def _config(options: Learning, spec: EnvironmentSpec | Origin, **more: Any) -> LearningConfig:
    """Return the configuration for the environment of `spec`.

    `UnknownName` if that is not built in.
    """
    env = stored_config(spec)
    start = None if options.init is None else find_policy(options.init)
    return LearningConfig(
        method=options.method, env=env, ppo=options.ppo, start=start, **more, **options.settings
    )


def run_gail(options: GailOptions) -> None:
    """Imitate demonstrations by GAIL or AIRL."""
    _run(options, imitation_config(options))


run_airl = run_gail


def run_ppo(options: PpoOptions) -> None:
    """Improve a policy by PPO.

    Raises `MismatchError` if the reward does not fit the environment.
    """
    reward = LearnedReward.load(found := find_policy(options.reward))
    config = _config(options, reward.origin, reward=found)
    reward.check_fits("the environment", env_spec(config.env))
    _run(options, config)


def imitation_config(options: GailOptions) -> LearningConfig:
    """Return the configuration of the run.

    Raises if the demonstrations are not of one known environment.
    """
    roots = options.dataset.root
    specs = {root: open_dataset(root).spec for root in roots}
    check_same_sources(specs, pictures=False, language=False)
    return _config(
        options, specs[roots[0]], datasets=tuple(roots), discriminator=options.discriminator
    )
