"""The `cnn` policy as a LeRobot plugin: `--policy.discover_packages_path=manip_il.learn.cnn`."""

from manip_il.learn.cnn.configuration_cnn import CNNConfig

__all__ = ["CNNConfig"]
