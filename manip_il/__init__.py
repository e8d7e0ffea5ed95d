"""Robot-arm imitation learning without a human at the controls.

Importing the package registers its environments with gymnasium, as packages of environments do: at once where
gymnasium is loaded, else when somebody imports it, so that a command that needs no environment starts without it.
(Since 1.0 gymnasium loads no plugins by the entry point `gymnasium.envs`.)
The OpenGL for pictures is chosen too, as mujoco reads MUJOCO_GL when it is imported, never after.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from manip_il.child_processes import obey_parent

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.abc import Loader
    from importlib.machinery import ModuleSpec
    from types import ModuleType

obey_parent()  # before all other imports: they take a second, in which the process that started this one may be killed

from manip_il.sim.gl import choose_backend, require_known_backend  # noqa: E402

choose_backend()

__version__ = "0.1.0"


def _register() -> None:
    require_known_backend()  # before mujoco is imported
    from manip_il.sim.register import register_envs

    register_envs()


class _ThenRegister:
    """gymnasium's own loader, and after it our environments' registration."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """As the own loader does."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Load gymnasium as if nobody had been waiting for it, then register."""
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        module.__loader__ = self._loader
        self._loader.exec_module(module)
        _register()


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
            spec.loader = _ThenRegister(spec.loader)  # pyright: ignore[reportAttributeAccessIssue]
        return spec


if "gymnasium" in sys.modules:
    _register()
else:
    sys.meta_path.insert(0, _WaitForGymnasium())  # pyright: ignore[reportArgumentType]
