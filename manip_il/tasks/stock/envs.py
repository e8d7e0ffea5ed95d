"""Stock environments and their experts by the names of robot and task."""

from __future__ import annotations

from collections.abc import Sequence

from manip_il.caching import cached_per_thread
from manip_il.errors import UsageError
from manip_il.option import NameOrPath
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS, CameraConfig, require_cameras
from manip_il.tasks.stock.aloha.environment import AlohaEnv
from manip_il.tasks.stock.aloha.expert import AlohaExpert
from manip_il.tasks.stock.environment import StockEnv
from manip_il.tasks.stock.expert import StockExpert
from manip_il.tasks.stock.table import ALOHA, ROBOTS

StockEnvironment = StockEnv | AlohaEnv
StockLabeller = StockExpert | AlohaExpert


def make_stock(
    robot: NameOrPath, task: NameOrPath, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
) -> StockEnvironment:
    """Make a stock environment. Raises `UsageError` for a camera that it lacks, or a condition that has ranges."""
    check_cameras(robot, cameras)
    if changed := [one.name for one in conditions if one.ranges]:
        raise UsageError(
            f"{robot} runs unmodified, without {', '.join(changed)}; use --suite=nominal, or --disturbed_share=0 for "
            "manip-il dagger"
        )
    return AlohaEnv(str(task), cameras) if robot == ALOHA else StockEnv(str(task))


def make_stock_expert(robot: NameOrPath, task: NameOrPath) -> StockLabeller:
    """Make the expert of a stock task."""
    return AlohaExpert(str(task)) if robot == ALOHA else StockExpert(str(task))


def check_cameras(robot: NameOrPath, cameras: CameraConfig | None) -> None:
    """Raise `UsageError` for cameras that a robot, stock or not, does not have."""
    known = ROBOTS[robot].cameras if robot in ROBOTS else CAMERAS
    if cameras is not None and not known:
        raise UsageError(f"{robot} has no cameras here; omit --cameras={','.join(cameras.names)}")
    require_cameras(cameras, known)


@cached_per_thread()
def described_stock(robot: NameOrPath, task: NameOrPath) -> StockEnvironment:
    """Return an environment, cached for this thread, to read names and sizes from; no episode runs in it."""
    return make_stock(robot, task)
