"""No network, as LeRobot's writer asks the Hub."""

from __future__ import annotations

from ..synthetic import offline

__all__ = ["offline"]
