"""Robot-arm imitation learning without a human at the controls.

Importing the package registers its environments with gymnasium, whose import takes a fifth of a
second. (Since 1.0 gymnasium no longer loads plugins from the entry point `gymnasium.envs`.) It also
selects the OpenGL backend, because mujoco reads MUJOCO_GL only when it is imported.
"""

import ctypes.util
import os
from importlib import import_module
from typing import Any

from manip_il.tasks import register_envs

if not os.environ.get("MUJOCO_GL") and ctypes.util.find_library("EGL"):
    os.environ["MUJOCO_GL"] = "egl"
register_envs()

__version__ = "1.0.0"
_HOMES = {  # public name -> module, and the name there if it differs
    "CameraConfig": "sim.config",
    "Checkpoint": "learn.checkpoint",
    "Dataset": "data.dataset",
    "Expert": "worlds.ladder.expert:LadderExpert",
    "GymWorld": "worlds.gym.world",
    "Label": "mdp",
    "FitConfig": "learn.fit_config",
    "LearnedPolicy": "learn.policy",
    "RunConfig": "algorithms.config",
    "State": "mdp",
    "dagger": "algorithms.imitation",
    "evaluate": "evaluation.measuring",
    "make_config": "worlds.table",
    "make_env": "worlds.ladder.world",
    "record": "collect.record",
    "train": "learn.train",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use; `__init__.pyi` has the types."""
    if name not in _HOMES:
        raise AttributeError(f"module 'manip_il' has no attribute {name!r}")
    home, _, own_name = _HOMES[name].partition(":")
    return getattr(import_module(f"manip_il.{home}"), own_name or name)


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]
