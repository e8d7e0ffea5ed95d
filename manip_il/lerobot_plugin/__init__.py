"""Our robots and policies in LeRobot's own commands, which import this package through the
distribution `lerobot_env_manip_il`, or by `--env.discover_packages_path=manip_il.lerobot_plugin`.

Importing it registers the environment type `manip_il`, the teleoperator type `recorded`, the
policies and their processors' steps, as LeRobot requires of plugins. It must be a package, because
LeRobot's parser fails on a module without `__path__`; it looks for `Recorded` here.
"""

from manip_il.learn import action_steps, cnn, mlp
from manip_il.lerobot_plugin.environment import ManipILEnv
from manip_il.lerobot_plugin.teleoperator import Recorded

__all__ = ["ManipILEnv", "Recorded", "action_steps", "cnn", "mlp"]
