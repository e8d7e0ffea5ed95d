"""No network, as LeRobot's writer asks the Hub."""

from __future__ import annotations

import pytest

from manip_il.doctor import examine

from ..synthetic import offline

__all__ = ["offline"]


@pytest.fixture
def no_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process for each examination would take most of the time; others test it."""
    monkeypatch.setattr(examine, "check_arrived", lambda root, strict: None)
