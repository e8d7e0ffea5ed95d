"""The `mlp` policy as a LeRobot plugin: `--policy.discover_packages_path=manip_il.learn.mlp`."""

from manip_il.learn.mlp.configuration_mlp import MLPConfig

__all__ = ["MLPConfig"]
