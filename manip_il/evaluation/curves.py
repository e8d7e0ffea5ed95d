"""Charts of validation success over costs: axes, marks and lines in percent of the chart.

Lines stretch with the page while text and marks keep their size: readable at any width, without scripts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from manip_il.errors import ManipError
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report_data import COSTS, Cost, CurvePoint, LearningCurve, format_amount

MAX_TICKS = 6
LOG_SPAN = 20  # amounts that differ by this factor or more are shown on a logarithmic axis
DODGE = 5  # px that DAgger and cloning are moved apart where they share a number of labels
SHAPES = 4  # that marks have, told apart without colour
_UNITS = ((3 * 3600.0, 3600.0, "h"), (300.0, 60.0, "min"), (0.0, 1.0, "s"))  # from so many seconds on; in seconds
_COST_NAMES: dict[Cost, str] = {
    "labels": "expert labels",
    "episodes": "episodes",
    "steps": "simulated steps",
    "seconds": "wall-clock",
}


@dataclass(frozen=True)
class Axis:
    """A map of values to 0 to 100 percent; on a logarithmic axis all values are above 0."""

    low: float
    high: float
    log: bool = False

    def percent(self, value: float) -> float:
        """Return the place of `value` [percent], clipped to the axis."""
        low, high, value = (math.log(v) if self.log else v for v in (self.low, self.high, value))
        return 100 * min(1.0, max(0.0, (value - low) / (high - low)))

    def ticks(self) -> list[float]:
        """Return round values on the axis, at most `MAX_TICKS`."""
        if self.log:
            return _log_ticks(self.low, self.high)
        least = (self.high - self.low) / (MAX_TICKS - 1)
        magnitude = 10.0 ** math.floor(math.log10(least))
        step = next(m * magnitude for m in (1, 2, 5, 10) if m * magnitude >= least - 1e-12 * magnitude)
        return [i * step for i in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)]

    @classmethod
    def around(cls, values: Sequence[float]) -> Axis:
        """Return an axis with a little room on both sides, logarithmic where values span a factor of 20 or more."""
        low, high = min(values), max(values)
        if low > 0 and high / low >= LOG_SPAN:
            room = max(1.15, (high / low) ** 0.05)
            return cls(low / room, high * room, log=True)
        room = 0.06 * (high - low) or max(1.0, 0.1 * abs(high))
        return cls(max(0.0, low - room) if low >= 0 else low - room, high + room)


@dataclass(frozen=True)
class CostAxis:
    """The axis of a cost. unit: in which it is shown, in labels, episodes or seconds; label: the words under it."""

    cost: Cost
    axis: Axis
    unit: float
    label: str

    @classmethod
    def around(cls, cost: Cost, amounts: Sequence[float]) -> CostAxis:
        """Return an axis for these amounts, seconds in a readable unit."""
        _, unit, name = next(one for one in _UNITS if max(amounts) >= one[0]) if cost == "seconds" else (0, 1.0, "")
        axis = Axis.around([amount / unit for amount in amounts])
        label = [_COST_NAMES[cost], f" [{name}]" if name else "", ", logarithmic" if axis.log else ""]
        return cls(cost, axis, unit, "".join(label))

    def percent(self, amount: float) -> float:
        """Return the place of an amount [percent]."""
        return self.axis.percent(amount / self.unit)


@dataclass(frozen=True)
class Series:
    """One curve: runs by their names, one for each training seed, each with its points in the order of rounds.

    kind: CSS class of its colour. shift: to the right [px].
    """

    name: str
    kind: str
    runs: Mapping[str, Sequence[CurvePoint]]
    shift: int = 0

    def __post_init__(self) -> None:
        if not self.runs or not all(self.runs.values()):
            raise ManipError(f"learning curve of {self.name!r} has a training seed without a round, or none at all")


@dataclass(frozen=True)
class Mark:
    """A point of a chart [percent from the left and from the top]. whisker: top and bottom of its interval."""

    x: float
    y: float
    words: str
    whisker: tuple[float, float] | None = None


@dataclass(frozen=True)
class DrawnSeries:
    """A series in a chart. lines: through its marks, drawn thin for single training seeds."""

    series: Series
    shape: int
    marks: tuple[Mark, ...]
    thin: tuple[tuple[Mark, ...], ...] = ()


@dataclass(frozen=True)
class Chart:
    """Success over one cost. y: success [percent of all episodes]."""

    x: CostAxis
    y: Axis
    series: tuple[DrawnSeries, ...]
    target: float | None

    @property
    def title(self) -> str:
        """Title of the chart."""
        return f"Validation success over {_COST_NAMES[self.x.cost]}"

    @property
    def x_ticks(self) -> list[tuple[str, float]]:
        """Labels and their places [percent from the left]."""
        return [(_format_count(tick), self.x.axis.percent(tick)) for tick in self.x.axis.ticks()]

    @property
    def y_ticks(self) -> list[tuple[str, float]]:
        """Labels and their places [percent from the top]."""
        return [(f"{tick:.0f} %", 100 - self.y.percent(tick)) for tick in self.y.ticks()]


@dataclass(frozen=True)
class CurveCharts:
    """Success of some series over every cost that is known. target: drawn as a level, in [0, 1]."""

    series: tuple[Series, ...]
    target: float | None = None

    @classmethod
    def of(cls, curve: LearningCurve) -> CurveCharts:
        """Return a run's rounds, and cloning beside them."""
        shared = {p.labels for p in curve.dagger} & {p.labels for p in curve.cloning}
        shift = DODGE if shared else 0
        series = [Series(curve.name, "dagger", {"": curve.dagger}, -shift)]
        if curve.cloning:
            series.append(Series("behaviour cloning", "cloning", {"": curve.cloning}, shift))
        return cls(tuple(series))

    @property
    def points(self) -> list[CurvePoint]:
        """All points of all series."""
        return [point for series in self.series for run in series.runs.values() for point in run]

    @property
    def costs(self) -> list[Cost]:
        """Costs that any point knows."""
        return [cost for cost in COSTS if any(point.amount(cost) is not None for point in self.points)]

    @property
    def heading(self) -> str:
        """Heading of the section."""
        return "Success against labels" if self.costs == ["labels"] else "Success against cost"

    @property
    def y(self) -> Axis:
        """Success from 0, or from as high as nothing is left out, to 100 [percent]."""
        # Points, unlike bars, may start above 0: where all succeed, the differences are of interest.
        lowest = 100 * min(point.success.interval[0] for point in self.points)
        if self.target is not None:
            lowest = min(lowest, 100 * self.target)
        return Axis(10.0 * math.floor(lowest / 10) if lowest > 50 else 0.0, 100.0)

    @property
    def charts(self) -> list[Chart]:
        """One chart a cost; the first series is drawn last, on top."""
        charts: list[Chart] = []
        for cost in self.costs:
            x = CostAxis.around(cost, [amount for p in self.points if (amount := p.amount(cost)) is not None])
            drawn = [_draw(series, x, self.y, index % SHAPES) for index, series in enumerate(self.series)]
            charts.append(Chart(x, self.y, tuple(reversed(drawn)), self.target))
        return charts

    @property
    def note(self) -> str:
        """Meaning of the marks, of wall-clock, and of an axis that does not start at 0."""
        if any(len(series.runs) > 1 for series in self.series):
            note = "Validation success by round, the mean over training seeds; thin lines are the seeds."
        else:
            confidence = f"{100 * self.points[0].success.confidence:g} %"
            note = f"Validation success by round; bars are {confidence} intervals."
        if "seconds" in self.costs:
            note += " Wall-clock is collecting and fitting, without validating."
        if self.y.low > 0:
            note += f" The axis of success starts at {self.y.low:.0f} %."
        return note

    @property
    def numbers(self) -> dict[str, str]:
        """Every point's name and costs, and its success."""
        points = [(series.name, name, p) for series in self.series for name, run in series.runs.items() for p in run]
        numbers: dict[str, str] = {}
        for series, name, point in points:
            costs = [format_amount(cost, amount) for cost in COSTS if (amount := point.amount(cost)) is not None]
            numbers[", ".join(filter(None, [series, name, point.name, *costs]))] = str(point.success)
        return numbers


def _draw(series: Series, x: CostAxis, y: Axis, shape: int) -> DrawnSeries:
    runs = [[(amount, p) for p in run if (amount := p.amount(x.cost)) is not None] for run in series.runs.values()]
    lines = tuple(tuple(_mark(series, amount, point, x, y) for amount, point in run) for run in runs)
    if len(runs) == 1:
        return DrawnSeries(series, shape, lines[0])
    marks: list[Mark] = []
    # Only rounds that every seed has: else the mean would jump where a seed ends.
    for points in zip(*runs, strict=False):
        amount, rate = fmean(amount for amount, _ in points), fmean(point.success.rate for _, point in points)
        words = f"{series.name}, {points[0][1].name}, {format_amount(x.cost, amount)}"
        marks.append(
            Mark(x.percent(amount), 100 - y.percent(100 * rate), f"{words}: {format_percent(rate)} on average")
        )
    return DrawnSeries(series, shape, tuple(marks), lines)


def _mark(series: Series, amount: float, point: CurvePoint, x: CostAxis, y: Axis) -> Mark:
    words = ", ".join(filter(None, [series.name, point.name, format_amount(x.cost, amount)]))
    low, high = (100 - y.percent(100 * end) for end in point.success.interval)
    return Mark(x.percent(amount), 100 - y.percent(100 * point.success.rate), f"{words}: {point.success}", (high, low))


def _log_ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for multiples in ((1, 2, 5), (1, 3), (1,)):
        ticks = [m * 10.0**d for d in decades for m in multiples if low <= m * 10.0**d <= high]
        if len(ticks) <= MAX_TICKS:
            return ticks
    return ticks[:: math.ceil(len(ticks) / MAX_TICKS)]


def _format_count(value: float) -> str:
    if value >= 1000:
        return f"{value / 1000:g}k"
    return f"{value:.0f}" if value >= 10 or value == round(value) else f"{value:g}"
