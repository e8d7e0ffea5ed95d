"""The few pieces of SVG that the charts are made of.

Charts are laid out in percent of their own box, so that lines stretch with the page while text
and marks keep their size: readable at any width, without scripts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

MAX_TICKS = 6


def element(tag: str, *children: str, **attributes: object) -> str:
    """`<tag attribute="value">children</tag>`; `_` in a name stands for `-`, a trailing one is dropped."""
    inside = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(_text(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return f"<{tag}{inside}>{''.join(children)}</{tag}>"


def text(content: str, **attributes: object) -> str:
    """Return a `<text>` with its content escaped."""
    return element("text", escape(content), **attributes)


def title(content: str) -> str:
    """What a pointer that rests on a mark is told, and a screen reader too."""
    return element("title", escape(content))


@dataclass(frozen=True)
class Axis:
    """Maps values onto 0 to 100 percent; on a logarithmic axis all values are above 0."""

    low: float
    high: float
    log: bool = False

    def percent(self, value: float) -> float:
        """Return where `value` lies [percent], clipped to the axis."""
        low, high, value = (self._scale(v) for v in (self.low, self.high, value))
        return 100 * min(1.0, max(0.0, (value - low) / (high - low)))

    def ticks(self) -> list[float]:
        """Round values on the axis, at most `MAX_TICKS`."""
        return _log_ticks(self.low, self.high) if self.log else _linear_ticks(self.low, self.high)

    def _scale(self, value: float) -> float:
        return math.log(value) if self.log else value


def axis_for(values: Sequence[float], log: bool | None = None) -> Axis:
    """Return an axis with a little room on both sides; `log` None decides by the values' span."""
    low, high = min(values), max(values)
    if log is None:
        log = low > 0 and high / low >= 20
    if log and low > 0:
        room = max(1.15, (high / low) ** 0.05)
        return Axis(low / room, high * room, log=True)
    room = 0.06 * (high - low) or max(1.0, 0.1 * abs(high))
    return Axis(max(0.0, low - room) if low >= 0 else low - room, high + room)


def percent(value: float) -> str:
    """`12.34%` for an SVG length."""
    return f"{value:.2f}%"


def _linear_ticks(low: float, high: float) -> list[float]:
    step = _round_step((high - low) / (MAX_TICKS - 1))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for multiples in ((1, 2, 5), (1, 3), (1,)):
        ticks = [m * 10.0**d for d in decades for m in multiples if low <= m * 10.0**d <= high]
        if len(ticks) <= MAX_TICKS:
            return ticks
    return ticks[:: math.ceil(len(ticks) / MAX_TICKS)]


def _round_step(step: float) -> float:
    magnitude = 10.0 ** math.floor(math.log10(step))
    return next(m * magnitude for m in (1, 2, 5, 10) if m * magnitude >= step - 1e-12 * magnitude)


def _text(value: object) -> str:
    return f"{float(value):.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
