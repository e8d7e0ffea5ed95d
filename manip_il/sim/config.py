"""Settings of episodes and their pictures; importing this module loads no simulator."""

from dataclasses import dataclass, field

from manip_il.errors import UnknownName, UsageError
from manip_il.option import check_bounds, option

DT_SIM = 0.002  # longest physics step [s]
MOST_HZ = round(1 / DT_SIM)
LONGEST_EPISODE = 10_000  # [control steps]; eight minutes at 20 Hz


@dataclass(frozen=True)
class Episodes:
    """Timing, success criterion and length of episodes. 0 means the robot's or task's own value."""

    control_hz: int = option(
        0,
        "control steps per second; 0: the robot's own (so101: 30, others: 20)",
        at_least=0,
        at_most=MOST_HZ,
    )
    tolerance: float = option(
        0.0,
        "distance to the goal that counts as success [m]; 0: the task's own",
        at_least=0,
        at_most=1,
    )
    success_steps: int = option(
        0,
        "consecutive control steps within the tolerance that count as success; 0: the task's own",
        at_least=0,
    )
    horizon: int = option(
        0,
        "length of an episode [control steps]; 0: the task's own",
        at_least=0,
        at_most=LONGEST_EPISODE,
    )

    @property
    def physics_steps(self) -> int:
        """MuJoCo steps in one control step."""
        return -(-MOST_HZ // self.control_hz)

    @property
    def physics_step(self) -> float:
        """Physics time step [s].

        It is `DT_SIM`, or a little less if that does not divide a control step.
        """
        return 1 / (self.control_hz * self.physics_steps)


CAMERAS = ("front", "side", "wrist")
MIN_SIDE, MAX_SIDE = 16, 2048  # sides of a picture [pixels]


@dataclass(frozen=True)
class Look:
    """Lighting of a scene, which can be changed when pictures are rendered again.

    It is part of a dataset's fingerprint.

    Attributes:
        shadows: Whether to draw the main lamp's shadows; a picture then takes two to six times as
            long.
        brightness: Factor on every lamp.
        light_turn: Rotation of the lamps about the vertical through the world's origin, -180 to
            180 [deg].

    Raises:
        UsageError: If a value is out of range.
    """

    shadows: bool = option(False, "draw shadows; rendering then takes two to six times as long")
    brightness: float = option(
        1.0, "factor on the brightness of every lamp, 0.1 to 2", at_least=0.1, at_most=2
    )
    light_turn: float = option(
        0.0,
        "rotation of the lamps about the vertical, -180 to 180 [deg]",
        at_least=-180,
        at_most=180,
    )

    def __post_init__(self) -> None:
        check_bounds(self)


FILM = Look(shadows=True)  # for people: shadows show how high things are


@dataclass(frozen=True)
class CameraConfig:
    """Cameras that take a picture at every step.

    Attributes:
        names: Names of the cameras.
        height: Height of their pictures [pixels].
        width: Width of their pictures [pixels].
        look: Lighting of their pictures.

    Raises:
        UsageError: If no camera is named or one is named twice, or if a height or width is odd
            (which 4:2:0 video does not allow) or out of range.
    """

    names: tuple[str, ...]
    height: int = option(128, "picture height [pixels]")
    width: int = option(128, "picture width [pixels]")
    look: Look = field(default_factory=Look)

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) < len(self.names):
            raise UsageError(
                f"cameras are {', '.join(self.names) or 'none'}; expected at least one, each named"
                " once"
            )
        if any(side % 2 or not MIN_SIDE <= side <= MAX_SIDE for side in self.size):
            raise UsageError(
                f"pictures have height {self.height} and width {self.width}; "
                f"expected even numbers from {MIN_SIDE} to {MAX_SIDE}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return self.height, self.width


def require_cameras(cameras: CameraConfig | None, known: tuple[str, ...]) -> None:
    """Raise `UnknownName` for cameras that an environment does not have."""
    for name in cameras.names if cameras else ():
        if name not in known:
            raise UnknownName("camera", name, known)
