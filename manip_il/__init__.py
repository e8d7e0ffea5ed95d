"""Robot-arm imitation learning without a human at the controls.

Importing the package registers its environments with gymnasium, as packages of environments do: at once where
gymnasium is loaded, else when somebody imports it, so that a command that needs no environment starts without it.
(Since 1.0 gymnasium loads no plugins by the entry point `gymnasium.envs`.)
The OpenGL for pictures is chosen too, as mujoco reads MUJOCO_GL when it is imported, never after.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

from manip_il.sim.gl import choose_backend, require_known_backend

choose_backend()

__version__ = "0.1.0"
_HOMES = {"Expert": "collect.expert", "make_env": "sim.env", "record": "collect.record"}


def __getattr__(name: str) -> Any:
    """Return what a user wants first, imported when it is asked for; `__init__.pyi` has the types."""
    if name not in _HOMES:
        raise AttributeError(f"module 'manip_il' has no attribute {name!r}")
    return getattr(import_module(f"manip_il.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]


def _register() -> None:
    require_known_backend()  # before mujoco is imported
    import_module("manip_il.sim.register").register_envs()


class _WaitForGymnasium:
    """First on `sys.meta_path` until gymnasium is imported."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: object = None) -> ModuleSpec | None:
        """Find gymnasium as the finders behind this one do, and nothing else."""
        if name != "gymnasium":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)  # pyright: ignore[reportArgumentType]
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                _register()

            spec.loader.exec_module = load_and_register
        return spec


if "gymnasium" in sys.modules:
    _register()
else:
    sys.meta_path.insert(0, _WaitForGymnasium())  # pyright: ignore[reportArgumentType]
