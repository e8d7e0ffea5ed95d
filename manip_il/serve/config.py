"""Settings of sessions. Importing this module does not load the simulator."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from manip_il.option import Seeded, option
from manip_il.robots import NAMED_SERVOS


@dataclass(frozen=True)
class SessionConfig(Seeded):
    """Options of a session: how the follower's servos move, when a new world is drawn, and what
    is saved.
    """

    output_dir: Path = option(
        Path("runs/serve"), "folder of the ports follower and leader, and of their calibrations"
    )
    leader: Literal["expert", "none"] = option("expert", "who moves the leader arm")
    speed: float = option(
        1.0,
        "how fast time passes in the world; 2: twice as fast as real time",
        at_least=0.1,
        at_most=10,
    )
    servo: str = option(
        "",
        f"{' or '.join(NAMED_SERVOS)} (strong, fast and exact); by default those of the robot's"
        f" YAML, or {NAMED_SERVOS[0]} if it has none",
    )
    latency: float = option(
        0.0,
        "how late the client's commands, and what it reads and sees, arrive [s]",
        at_least=0,
        at_most=2,
    )
    jitter: float = option(
        0.0, "longest further delay, drawn for every message [s]", at_least=0, at_most=2
    )
    drop: float = option(0.0, "share of messages that are lost", at_least=0, at_most=0.99)
    camera_port: int = option(5599, "TCP port of the cameras (ZMQ)", at_least=1, at_most=65_535)
    reset: Literal["solved", "enter"] = option(
        "solved",
        "when to draw a new world if no COMMAND runs: on Enter, or also one second after the task"
        " is solved",
    )
    intervene: float = option(
        0.15,
        "with LeRobot's DAgger: correct the policy if its targets differ from the expert's by more"
        " than this [rad]",
        at_least=0,
    )
    log: Path | None = option(
        None, "folder for journals with what the client cannot see: states, labels, who drove"
    )
    varies: bool = False  # whether to redraw the servos for each world
