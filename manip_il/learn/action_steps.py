"""Our LeRobot processor steps: two convert actions, see `action_spaces`, one is for policies that
see only joints.

`MeasuredJointsStep`, in the preprocessor, stores the measured joints of an observation;
`JointTargetsStep`, at the end of the postprocessor, uses them to convert the policy's output to
joint targets. A checkpoint with both works wherever LeRobot calls each once per step, as
lerobot-eval does. These two are subclasses of steps in LeRobot, which convert a whole plan relative
to the joints at its start, so LeRobot connects the two when it loads them.
"""

from dataclasses import dataclass
from typing import Any, cast

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    NormalizerProcessorStep,
    ObservationProcessorStep,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    RelativeActionsProcessorStep,
)

from manip_il.data.schema import ENVIRONMENT_STATE, STATE
from manip_il.errors import ManipError
from manip_il.learn.action_spaces import LAST, Conversion
from manip_il.learn.checkpoint import DECODER, JOINTS_ALONE, MEASURED
from manip_il.learn.names import EE_DELTA, JOINT_DELTA, JOINT_TARGET, OWN_SPACE

Pipeline = PolicyProcessorPipeline[Any, Any]


@ProcessorStepRegistry.register(MEASURED)
@dataclass
class MeasuredJointsStep(RelativeActionsProcessorStep):
    """Stores the raw joint state (B, n) of an observation; changes nothing.

    Attributes:
        converted: Whether actions that come with observations are already converted, as in our
            training.
    """

    converted: bool = False

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the same transition.

        Raises:
            ManipError: The transition has an action that is not converted yet.
        """
        if transition.get(TransitionKey.ACTION) is not None and not self.converted:
            raise ManipError(
                "this policy learns converted actions, which the dataset does not have; continue"
                " with manip-il train --resume=true"
            )
        self._last_state = (transition.get(TransitionKey.OBSERVATION) or {}).get(STATE)
        return transition

    def get_config(self) -> dict[str, Any]:
        """Return an empty configuration: the robot is stored with the postprocessor's step."""
        return {}


@ProcessorStepRegistry.register(DECODER)
@dataclass
class JointTargetsStep(AbsoluteActionsProcessorStep):
    """Converts a policy's output (B, n), relative to the joints measured now, to joint targets
    and opening (B, n).

    Attributes:
        action_space: One of `ACTION_SPACES`.
        robot: The arm, for `ee_delta` only.
        grippers: Indices of the gripper openings, see `Conversion`.
    """

    action_space: str = JOINT_TARGET
    robot: str = ""
    grippers: tuple[int, ...] = LAST

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with joint targets.

        Raises:
            ManipError: The output is not for a single step, or its observation is missing.
        """
        targets = transition.get(TransitionKey.ACTION)
        states = self.relative_step.get_cached_state() if self.relative_step is not None else None
        if not isinstance(targets, torch.Tensor) or states is None or targets.shape != states.shape:
            raise ManipError(
                f"{self.action_space}: an action is converted with the joints measured at its own"
                " step; expected the output of one step and its observation, both (B, n)"
            )
        rows = targets.detach().to("cpu", torch.float32).numpy()
        conversion = Conversion(self.action_space, self.robot, tuple(self.grippers))
        actions = conversion.decode(rows, states.to("cpu", torch.float32).numpy())
        return cast(
            EnvTransition,
            {**transition, TransitionKey.ACTION: torch.from_numpy(actions).to(targets)},
        )

    def get_config(self) -> dict[str, Any]:
        """Return the options that are saved in a checkpoint."""
        return {
            "action_space": self.action_space,
            "robot": self.robot,
            "grippers": list(self.grippers),
        }


@ProcessorStepRegistry.register(JOINTS_ALONE)
class JointsAloneStep(ObservationProcessorStep):
    """Adds an environment state of no numbers: without pictures, LeRobot's policies do not act
    without any.
    """

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with an environment state (..., 0)."""
        return {**observation, ENVIRONMENT_STATE: observation[STATE][..., :0]}

    def transform_features(self, features: Any) -> Any:
        """Return the features of a policy's inputs as they are."""
        return features


def is_in_processors(kind: str, found: Conversion) -> bool:
    """Return whether a policy type's processors do a conversion.

    If not, its network does, or none is needed.
    """
    return found.space == EE_DELTA or (found.space == JOINT_DELTA and kind not in OWN_SPACE)


def add_steps(before: Pipeline, after: Pipeline, found: Conversion) -> None:
    """Add a conversion's steps to a policy's pre- and postprocessor, in place.

    The policy then sees only converted actions.

    Args:
        before: The preprocessor, which has a normaliser step.
        after: The postprocessor.
        found: The conversion.
    """
    measured = MeasuredJointsStep(converted=True)
    place = next(
        i for i, step in enumerate(before.steps) if isinstance(step, NormalizerProcessorStep)
    )
    before.steps = [*before.steps[:place], measured, *before.steps[place:]]
    decoder = JointTargetsStep(
        relative_step=measured, action_space=found.space, robot=found.robot, grippers=found.grippers
    )
    after.steps = [*after.steps, decoder]
