"""`manip-il gail` and `manip-il airl`: a policy by reinforcement learning from demonstrations alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.inputs import check_dataset, require_dataset
from manip_il.cli.learning import LearningOptions, resumed
from manip_il.errors import UsageError
from manip_il.learn.adversarial_config import DiscriminatorConfig
from manip_il.learn.fit_config import check_weights
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.algorithms.learning_config import LearningConfig
    from manip_il.algorithms.learning_run import Iteration, LearningRun
    from manip_il.algorithms.run import Watch
    from manip_il.collect.workers import Engine
    from manip_il.sim.config import EnvConfig


@dataclass
class DatasetGroup:
    """`--dataset.*`."""

    root: list[Path] = option(MISSING, "demonstrations; several are joined")


@dataclass
class AdversarialOptions(LearningOptions):
    """Options of both commands."""

    dataset: DatasetGroup = field(default_factory=lambda: DatasetGroup([]))
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)

    @property
    def roots(self) -> tuple[Path, ...]:
        """Datasets of demonstrations."""
        return tuple(self.dataset.root)

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        super().check()
        check_weights(self.dataset.root, ())
        for root in self.dataset.root:
            require_dataset(root)

    def environment(self) -> EnvConfig:
        """Return the environment of the demonstrations, which must be known here and one and the same."""
        from manip_il.collect.environments import is_known
        from manip_il.data.dataset import Dataset
        from manip_il.learn.sources import check_same_sources
        from manip_il.sim.config import EnvConfig

        roots = self.roots
        opened = [Dataset.open(root) for root in roots]
        specs = [one.spec for one in opened]
        check_same_sources(roots, specs, pictures=False, language=False)
        spec = specs[0]
        if not is_known(spec.robot, spec.task):
            raise UsageError(f"{roots[0]} is for {spec.robot} {spec.task}, which cannot be simulated here")
        for one in opened:
            check_dataset(one.root, one.spec, one.fingerprint)
        return EnvConfig(spec.robot, spec.task, spec.fps, object=spec.object)

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return the loop."""
        raise NotImplementedError

    def iterations(self, config: LearningConfig, folder: Path, engine: Engine, watch: Watch) -> Iterator[Iteration]:
        """Return the run's iterations, the last finished one of a resumed run first."""
        from manip_il.algorithms.learning_run import LearningRun

        run = LearningRun(config, folder, engine, watch)
        return resumed(run, self.algorithm()(run, config))


@dataclass
class GailOptions(AdversarialOptions):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the demonstrations', and PPO learns to be taken for the
    expert. OUTPUT_DIR/best holds the policy with the highest validation success: an mlp like that of `manip-il train`.
    """

    title: ClassVar[str] = "GAIL"
    name: ClassVar[str] = "gail"
    example: ClassVar[str] = "manip-il gail --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/gail"
    reward_form: Literal["logit", "log_d", "minus_log_one_minus_d"] = option(
        "logit", "of a step: log D - log(1 - D), log D, or -log(1 - D)"
    )

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return GAIL's loop."""
        from manip_il.algorithms.gail import gail

        return gail


@dataclass
class AirlOptions(AdversarialOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il gail`, with a discriminator in the form of a reward: exp f / (exp f + pi).
    """

    title: ClassVar[str] = "AIRL"
    name: ClassVar[str] = "airl"
    example: ClassVar[str] = "manip-il airl --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/airl"

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return AIRL's loop."""
        from manip_il.algorithms.airl import airl

        return airl
