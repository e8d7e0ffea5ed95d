"""Our robots and policies in LeRobot's own commands:
`--env.discover_packages_path=manip_il.lerobot_plugin`.

Importing it registers the environment type `manip_il`, the teleoperator type `recorded` and the
policies, as LeRobot requires of plugins. It must be a package, because LeRobot's parser fails on a
module without `__path__`.
"""

from manip_il.learn.action_steps import JointTargetsStep, MeasuredJointsStep
from manip_il.learn.cnn import CNNConfig
from manip_il.learn.mlp import MLPConfig
from manip_il.lerobot_plugin.environment import ManipILEnv
from manip_il.lerobot_plugin.teleoperator import Recorded

__all__ = [
    "CNNConfig",
    "JointTargetsStep",
    "MLPConfig",
    "ManipILEnv",
    "MeasuredJointsStep",
    "Recorded",
]
