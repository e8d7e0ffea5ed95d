"""Where hand and object went, seen from above and from the side: pictures that need no renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manip_il.evaluation.report_data import Paths
from manip_il.evaluation.svg import element, text, title
from manip_il.mdp import F64

WIDTH, HEIGHT, MARGIN = 320.0, 230.0, 26.0  # of one view [px]
MAX_POINTS = 160  # of one line; more would only make the file larger
AXES = "xyz"


@dataclass(frozen=True)
class View:
    """A flat picture of the world: axis numbers to the right and upwards, and one scale for both."""

    right: int
    up: int
    low: F64  # (2,) [m], lower left corner
    scale: float  # [px/m]
    height: float = HEIGHT  # [px]

    def project(self, points: F64) -> F64:
        """World (T, 3) [m] to pixels (T, 2)."""
        flat = (points[:, [self.right, self.up]] - self.low) * self.scale
        return np.column_stack([MARGIN + flat[:, 0], self.height - MARGIN - flat[:, 1]])


def fit_view(points: F64, right: int, up: int, height: float = HEIGHT) -> View:
    """Return the view that has all `points` (T, 3) [m] inside, as large as they allow."""
    flat = points[:, [right, up]]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = np.array([WIDTH, height]) - 2 * MARGIN
    size = np.maximum(high - low, 0.02)  # [m]: where nothing moved there is still a picture
    scale = float((room / size).min())
    middle = (low + high) / 2
    return View(right, up, middle - room / scale / 2, scale, height)


def top_view(paths: Paths) -> str:
    """Return seen from above: x to the right, y upwards."""
    return _draw(paths, fit_view(_everything(paths), 0, 1), "from above")


def side_view(paths: Paths) -> str:
    """Return seen from the side: height over x or y, whichever the episode uses more."""
    spread = np.ptp(_everything(paths), axis=0)
    return _draw(paths, fit_view(_everything(paths), 0 if spread[0] >= spread[1] else 1, 2), "from the side")


def _everything(paths: Paths) -> F64:
    return np.vstack([paths.hand, paths.obj, paths.goal[None]])


def _draw(paths: Paths, view: View, seen: str) -> str:
    goal = view.project(paths.goal[None])[0]
    return element(
        "svg",
        title(f"Paths of hand and object {seen}: {paths.policy}"),
        element("circle", class_="goal", cx=goal[0], cy=goal[1], r=9.0),
        element("circle", class_="goal-dot", cx=goal[0], cy=goal[1], r=2.5),
        _line(view.project(_thin(paths.hand)), "hand"),
        _line(view.project(_thin(paths.obj)), "object"),
        frame(view),
        class_="paths",
        viewBox=f"0 0 {WIDTH:.0f} {HEIGHT:.0f}",
        role="img",
    )


def _line(points: F64, kind: str) -> str:
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    first, last = points[0], points[-1]
    return element(
        "g",
        element("polyline", points=corners),
        element("circle", class_="start", cx=first[0], cy=first[1], r=4.0),
        element("circle", class_="end", cx=last[0], cy=last[1], r=4.0),
        class_=f"path {kind}",
    )


def frame(view: View) -> str:
    """What tells directions and lengths: the axes' names and a bar of a round length."""
    wanted = 60 / view.scale  # [m] that 60 px stand for
    length = max((m for m in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if m <= wanted), default=0.01)
    y, pixels = view.height - 10, length * view.scale
    bar = element(
        "g",
        element("line", x1=6, x2=6 + pixels, y1=y, y2=y),
        text(f"{100 * length:.0f} cm", class_="tick", x=12 + pixels, y=y, dy="0.35em"),
        class_="scale",
    )
    across = text(f"{AXES[view.right]} →", class_="tick", x=WIDTH - 4, y=view.height - 6, text_anchor="end")
    return bar + across + text(f"{AXES[view.up]} ↑", class_="tick", x=6, y=16)


def _thin(points: F64) -> F64:
    keep = np.unique(np.linspace(0, len(points) - 1, min(len(points), MAX_POINTS)).round().astype(int))
    return points[keep]
