"""A window needs a display, and keeps real time."""

import pytest

from manip_il.errors import RenderError, UsageError
from manip_il.sim.view import Clock, require_display
from manip_il.worlds.ladder.world import make_env


@pytest.mark.parametrize("display", ["", ":99"])
def test_without_a_display_a_window_is_refused_in_one_line(display, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    says = rf"^no display: DISPLAY={display}, WAYLAND_DISPLAY=; .* manip-il view --output=.*$"
    with pytest.raises(RenderError, match=says):
        require_display()


def test_a_render_mode_that_does_not_exist_is_refused():
    with pytest.raises(UsageError, match="unknown render_mode 'human'"):
        make_env(render_mode="human")


def test_a_clock_keeps_real_time_and_makes_up_for_30_ms_at_most(monkeypatch):
    now, slept = [100.0], list[float]()
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("time.sleep", slept.append)
    clock = Clock(20)
    for taken in (0.0, 0.02, 5.0, 0.01):
        now[0] += taken
        clock.wait()
        now[0] += slept[-1]
    assert slept == pytest.approx([0.0, 0.0, 0.0, 0.01])
