"""`manip-il view`: a robot at its task, live in MuJoCo's viewer, or in a file of Rerun's.

`manip-il serve`: a virtual SO-101 behind serial ports, for LeRobot's own programs.

`manip-il robot new`, `check`, `certify`, `identify`, `excite`, `board`, `align`, `preflight`: a
YAML file for your own arm, what the arm and its expert can do, the servos of a real one, a motion
that tells them, its cameras and zeros by a printed board, and whether a policy fits the arm.
"""

from dataclasses import MISSING, dataclass, field
from pathlib import Path

from manip_il.cli.common_options import (
    OF_POLICY,
    EngineOptions,
    PolicyGroup,
    Tested,
    Trusting,
    Varied,
)
from manip_il.cli.outputs import Output, OutputFile, Replacing, output_file, output_folder
from manip_il.cli.parsing import Given, given
from manip_il.option import NameOrPath, Seeded, option
from manip_il.serve.config import SessionConfig
from manip_il.tasks import NAMES
from manip_il.worlds.config import EnvConfig

IN_A_FILE = 3  # episodes written to a file by default


@dataclass(frozen=True)
class ViewOptions(Tested, Seeded, Trusting):
    """Watch a robot at its task in MuJoCo's viewer, or write what happens to a file of Rerun's.

    The expert drives unless a policy is given.

    In the viewer, episodes run in real time until --n_episodes have ended, the window is closed or
    Ctrl-C is pressed. --output writes pictures, joints, actions, phase and progress as fast as
    possible to a file, which `rerun FILE.rrd` opens on any machine, and `rerun --web-viewer
    FILE.rrd` in a browser.

    Example: manip-il view --robot.type=panda --task.type=stack --n_episodes=1 --output=stack.rrd
    """

    policy: PolicyGroup = field(default_factory=PolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    n_episodes: int | None = option(
        None, f"episodes; by default unlimited, or {IN_A_FILE} with --output", at_least=1
    )
    output: Path | None = option(None, "write a Rerun file, FILE.rrd, instead of showing episodes")


@dataclass(frozen=True)
class ServeOptions(Varied):
    """Run a simulated SO-101 behind serial ports, which LeRobot's own programs open like those of a
    real arm.

    Prints both ports, the cameras, and a command line to copy. With `-- COMMAND ...` it runs that
    program on the ports and presses its keys as a person would: an episode ends when the task is
    solved, and a failed one is recorded again. --vary=servo also varies the servos.

    Example: manip-il serve --task.type=lift --cameras=front,wrist
    """

    command: list[str] = option(
        list, "a LeRobot program and its options, after `--`", positional=True
    )
    env: Given = given(EnvConfig, robot="so101")
    session: Given = given(SessionConfig, prefix="")


@dataclass(frozen=True)
class RobotNewOptions(Replacing):
    """Write a first YAML file for an arm's MJCF, with hand, fingers and workspace as suggested by
    the model.

    Comments in the file explain its values. Joints, home, gains and the hand's frame are not in it:
    they are taken from the model unless you add them. Then checks the robot, like `robot check
    --episodes=0`, and prints what to change. The exit code is 1 if the robot cannot do any task
    yet.

    Example: manip-il robot new my_arm.xml --output=my_arm.yaml
    """

    model: Path = option(MISSING, "the arm's MJCF", positional=True)
    gripper: Path | None = option(None, "the gripper's MJCF, if it is a separate file")
    output: Path | None = option(None, "the YAML file; by default next to the model, with its name")


@dataclass(frozen=True)
class RobotCheckOptions(Output):
    """Measure what an arm can do, before recording; writes report.html and check.json.

    Shows the arm with its hand frame and cameras, its reach, the expert's success at every task
    (also with a tenth of its actions random), and what to change if something does not work. The
    exit code is 1 if a task cannot be done.

    Example: manip-il robot check my_arm.yaml --tasks=reach,pick_place --output_dir=runs/my_arm
    """

    robot: NameOrPath = option(
        MISSING, "the robot's YAML file, or the name of a built-in robot", positional=True
    )
    tasks: list[str] = option(list, f"any of {', '.join(NAMES)}; by default all")
    episodes: int = option(
        50,
        "expert episodes per task, and as many with a tenth of the actions random; 0 for none",
        at_least=0,
        at_most=1_000_000,
    )
    output_dir: Path = output_folder("runs/robot_check")


@dataclass(frozen=True)
class CertifyOptions(Seeded, EngineOptions, Output):
    """Measure how the expert recovers from perturbed states and wrong actions.

    Writes certificate.json.

    Example: manip-il robot certify --task.type=stack --output_dir=runs/certificate
    """

    env: Given = given(EnvConfig)
    cases: int = option(
        500, "episodes for each kind of perturbation", at_least=1, at_most=1_000_000
    )
    output_dir: Path = output_folder("runs/certificate")


@dataclass(frozen=True)
class IdentifyOptions(Output):
    """Find the servos of an arm from a LeRobot dataset of it.

    Needs `action` and `observation.state` alone. Writes arm.yaml, the robot with these servos, for
    `--robot.type=` of record, dagger, eval and serve: a value and a 95 % interval of each parameter
    of each joint; and report.html. With `--vary=servo` each world has servos drawn from the
    intervals.

    Example: manip-il robot identify datasets/session --output_dir=runs/my_servos
    """

    dataset: Path = option(MISSING, "a dataset of an arm with servos", positional=True)
    robot: NameOrPath = option("so101", "the arm", flag="robot.type")
    output_dir: Path = output_folder("runs/servos")


@dataclass(frozen=True)
class ExciteOptions(Replacing, Seeded):
    """Write a motion that tells an arm's servos, for `robot identify`, as a LeRobot dataset.

    Every joint jumps, swings and slowly turns back, clear of the table and of the arm itself; the
    gripper must be empty. `lerobot-replay` plays it; `lerobot-record --teleop.type=recorded` also
    records what the arm does (docs/virtual-robot.md).

    Example: manip-il robot excite datasets/motion
    """

    dataset: Path = option(MISSING, "folder of the new dataset", positional=True)
    robot: NameOrPath = option("so101", "the arm", flag="robot.type")
    seconds: float = option(120.0, "length of the motion [s]", at_least=6, at_most=3600)


@dataclass(frozen=True)
class BoardOptions(OutputFile):
    """Write a board with a pattern for `robot align`, as a PDF to print on A4 at 100 %.

    Example: manip-il robot board --output=board.pdf
    """

    output: Path = output_file("board.pdf")


@dataclass(frozen=True)
class AlignOptions(Output):
    """Find the cameras and the joints' zeros of an arm from a LeRobot dataset of it.

    The board of `robot board` lies on the table, in another place in every episode, while the arm
    rests in one posture after another with its wrist camera above the board. Writes arm.yaml, the
    robot with these cameras and zeros, for `--robot.type=` of record, view and serve; and
    report.html. Prints what to correct in LeRobot's calibration.

    Example: manip-il robot align datasets/board --output_dir=runs/my_cameras
    """

    dataset: Path = option(MISSING, "a dataset of an arm with a wrist camera", positional=True)
    robot: NameOrPath = option("so101", "the arm", flag="robot.type")
    ruler: float = option(
        100.0, "measured length of the line on the printed board [mm]", at_least=20, at_most=500
    )
    output_dir: Path = output_folder("runs/cameras")


@dataclass(frozen=True)
class PreflightOptions(Trusting, Output):
    """Check a policy against a few recorded seconds of the real arm at rest: go, or no-go.

    Compares names, units and ranges of the joints, cameras, sizes, colours and rate, the pictures
    with simulated ones, and the policy's first target. Prints a line for each fault with what to
    do, and writes report.html with the pictures. Nothing moves. The exit code is 1 for no-go.

    Example: manip-il robot preflight datasets/rest --policy.path=runs/arm
    """

    dataset: Path = option(MISSING, "what lerobot-record made of the arm", positional=True)
    policy: Path = option(MISSING, "a checkpoint or a run", flag="policy.path")
    robot: NameOrPath = option("", "the arm; by default the policy's", flag="robot.type")
    limit: float = option(
        10.0,
        "as in LeRobot: largest distance of a target [deg]",
        flag="robot.max_relative_target",
        at_least=0,
    )
    output_dir: Path = output_folder("runs/preflight")


@dataclass(frozen=True)
class EnvCheckOptions:
    """Check that an environment and its expert keep the contract that everything else relies on.

    The same seed gives the same start; a restored state goes on the same; the expert is a function
    of the state, or says that it is not. Prints its success, and the time of a step with its label.
    The exit code is 1 if a part is not kept.

    Example: manip-il env check reacher.py
    """

    world: NameOrPath = option(
        MISSING, "the world's Python file (docs/new-env.md), or a name", positional=True
    )
    task: NameOrPath = option(EnvConfig.task, "its task, if it has several", flag="env.task")
    episodes: int = option(50, "episodes of the expert", at_least=0, at_most=1_000_000)
