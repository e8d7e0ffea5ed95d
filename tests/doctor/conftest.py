"""No network, as LeRobot's writer asks the Hub."""

from ..synthetic import offline

__all__ = ["offline"]
