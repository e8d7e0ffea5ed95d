"""Groups of options that several commands share, and what commands do with them before and after the work."""

from __future__ import annotations

import functools
import json
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.folders import atomic_write
from manip_il.cli.options import Open, dump_yaml, from_yaml, options_of, to_plain
from manip_il.cli.paths import hub_hint
from manip_il.errors import MismatchError, UnknownName, UsageError

if TYPE_CHECKING:  # the environment and the learner take a second to import
    from manip_il.data.schema import RobotTaskSpec
    from manip_il.sim.env import EnvConfig
    from manip_il.sim.look import CameraConfig, Look

CONFIG_FILE = "config.yaml"
POLICY_TYPES = ("mlp",)
DEFAULT_ROBOT, DEFAULT_TASK, DEFAULT_HZ = "panda", "pick_place", 20
ENGINE_HELP = "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, or one started here)"
WORKERS_HELP = "processes, or tasks at once on Ray; by default one per core"
WHERE_POLICIES_LIE = (".", "pretrained_model", "best/pretrained_model", "checkpoints/last/pretrained_model")
NEWEST_LIES = ("checkpoints/*/pretrained_model", "round_*/policy/checkpoints/*/pretrained_model")
TRUST_HELP = (
    "load models, and run code, that a checkpoint names (smolvla, pi0, groot, ...): only for sources that you trust; "
    "only on the command line"
)


def option(default: Any, text: str) -> Any:
    """Return a field with one line of help."""
    return field(default=default, metadata={"help": text})


def trust_option() -> Any:
    """`--trust`: a field that only the command line may set."""
    return field(default=False, metadata={"help": TRUST_HELP, "command_line_only": True})


@dataclass
class RobotGroup:
    """`--robot.*`."""

    type: str = option(DEFAULT_ROBOT, "panda or fetch")


@dataclass
class TaskGroup:
    """`--task.*`."""

    type: str = option(DEFAULT_TASK, "reach, lift or pick_place")


@dataclass
class MaybeRobotGroup:
    """`--robot.*` where a checkpoint may say it."""

    type: str | None = option(None, f"panda or fetch; by default the policy's, else {DEFAULT_ROBOT}")


@dataclass
class MaybeTaskGroup:
    """`--task.*` where a checkpoint may say it."""

    type: str | None = option(None, f"reach, lift or pick_place; by default the policy's, else {DEFAULT_TASK}")


@dataclass
class EnvGroup:
    """`--env.*`: what makes an environment beside robot and task. Defaults are `EnvConfig`'s."""

    tolerance: float = option(0.02, "distance to the goal that counts as success [m]")
    horizon: int = option(100, "control steps in an episode")
    control_hz: int | None = option(None, f"control steps a second; by default the policy's, else {DEFAULT_HZ}")
    success_steps: int = option(5, "consecutive control steps within the tolerance that count as success")

    def config(self, robot: str, task: str, control_hz: int = DEFAULT_HZ) -> EnvConfig:
        """Return the environment; `UnknownName` for a robot or task, `UsageError` for a value."""
        from manip_il.robots.robot import get_robot
        from manip_il.sim.env import EnvConfig
        from manip_il.tasks.table import get_task

        get_robot(robot)
        get_task(task)
        hz = control_hz if self.control_hz is None else self.control_hz
        return EnvConfig(robot, task, hz, self.tolerance, self.success_steps, self.horizon)


@dataclass
class ImageGroup:
    """`--image.*`: the pictures of every camera."""

    height: int = option(128, "of a picture [pixels]")
    width: int = option(128, "of a picture [pixels]")

    def config(self, cameras: Sequence[str], look: Look | None = None) -> CameraConfig | None:
        """What is pictured; None without cameras. `UnknownName` for a camera, `UsageError` for a size."""
        from manip_il.sim.look import CameraConfig, Look

        return CameraConfig(tuple(cameras), self.height, self.width, look or Look()) if cameras else None


@dataclass
class LookGroup:
    """`--look.*`: the light that pictures are made in. Defaults are `Look`'s."""

    shadows: bool = option(False, "cast shadows; rendering then takes two to six times as long")
    brightness: float = option(1.0, "factor on every lamp, 0.1 to 2")
    light_turn: float = option(0.0, "turn the lamps about the vertical, -180 to 180 [deg]")

    def config(self) -> Look:
        """Return the look; `UsageError` for a value out of range."""
        from manip_il.sim.look import Look

        return Look(self.shadows, self.brightness, self.light_turn)


@dataclass
class PolicyGroup:
    """`--policy.*` of what is fitted."""

    type: str = option("mlp", "the policy; `manip-il train` trains every other LeRobot policy")
    loss: str = option("mse", "mse, l1, gaussian, mixture or categorical")
    width: int = option(256, "units per layer")
    depth: int = option(3, "hidden layers")

    def settings(self) -> dict[str, Any]:
        """As `--policy.*` of `manip-il train` has them; `UsageError` for another type."""
        if self.type not in POLICY_TYPES:
            raise UsageError(
                f"{UnknownName('policy', self.type, POLICY_TYPES)}; LeRobot's policies (act, diffusion) are trained by "
                "manip-il train and manip-il dagger, with --policy.type=..."
            )
        return to_plain(self)


def policy_help(words: Iterable[str]) -> str:
    """Return the options of the policy that `--policy.type=` in a command's words names; nothing where none does."""
    kind = next((word.partition("=")[2] for word in words if word.startswith("--policy.type=")), "")
    if not kind:
        return ""
    from manip_il.learn.lerobot_config import option_lines

    rows = option_lines(kind)
    width = max(len(left) for left, _ in rows) + 2
    lines = "\n".join(f"  {left:{width}}[{right}]" for left, right in rows)
    return f"\n\noptions of {kind}:\n{lines}"


def warn(lines: Iterable[str]) -> None:
    """Warnings on standard error, one line each."""
    for line in lines:
        print(f"manip-il: warning: {' '.join(line.split())}", file=sys.stderr, flush=True)


def command_line(name: str, options: Any) -> str:
    """Return the command with every option that is not its default, to copy."""
    words = ["manip-il", name]
    for known in options_of(type(options)):
        value = _value(options, known.name)
        if known.positional:
            words += map(str, value if isinstance(value, list) else [value])
        elif known.is_open:
            words += [f"--{known.name}.{inner}={_yaml(one)}" for inner, one in value.items()]
        elif (known.default is MISSING or value != known.default) and known.name not in ("resume", "overwrite"):
            words.append(_word(known.name, value))
    return shlex.join(words)


def save_options(folder: Path, options: Any) -> None:
    """Write the resolved options to `folder/config.yaml`."""
    atomic_write(folder / CONFIG_FILE, dump_yaml(options))


def check_same_options(folder: Path, options: Any, free: Iterable[str], may_grow: str | None = None) -> None:
    """Raise `MismatchError` naming the option unless the run in `folder` was started with the same options.

    free: options that may differ. may_grow: one that may be larger than it was. A folder that is not there or
    empty is no run yet; one without `config.yaml` is none of ours (`UsageError`).
    """
    path = folder / CONFIG_FILE
    # A run that was killed in its first moment leaves at most the half of a file, under a hidden name.
    if not folder.is_dir() or all(path.name.startswith(".") for path in folder.iterdir()):
        return
    if not path.is_file():
        raise UsageError(f"{folder} holds no {CONFIG_FILE}, so there is no run to continue; choose another folder")
    before = from_yaml(path, type(options))
    for known in options_of(type(options)):
        was, now = _value(before, known.name), _value(options, known.name)
        grown = known.name == may_grow and now >= was
        if was != now and known.name not in (*free, "resume", "overwrite") and not grown:
            raise MismatchError(f"--{known.name}", str(path), was, "the command line", now)


def find_policy(path: Path) -> Path:
    """Return the `pretrained_model` folder in `path`, which may be that folder, a checkpoint or a run.

    Of a run it is the best policy, else the newest checkpoint.
    """
    for place in WHERE_POLICIES_LIE:
        if (path / place / "config.json").is_file():
            return path / place
    for place in NEWEST_LIES:
        if found := sorted(path.glob(f"{place}/config.json")):
            return found[-1].parent
    raise UsageError(
        f"no policy in {path}; expected LeRobot's pretrained_model folder, or a run that holds one{hub_hint(path)}"
    )


def start_policy(settings: Open) -> Open:
    """`--policy.*` of what is fitted, with the `pretrained_model` folder that its `path` means (`find_policy`)."""
    if "path" not in settings:
        return settings
    path = settings["path"]
    if not isinstance(path, str) or not path:
        raise UsageError(f"--policy.path is {path!r}; expected a checkpoint or a run")
    return {**settings, "path": str(find_policy(Path(path).expanduser()))}


def check_dataset(root: Path, spec: RobotTaskSpec, fingerprint: Mapping[str, Any]) -> None:
    """Warn where a dataset was made by something else than this machine would make it by.

    Raises `MismatchError` where its numbers mean something else. A robot that is not known here is not compared.
    """
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.data.schema import check_same_spec
    from manip_il.engine.environments import env_fingerprint, env_spec
    from manip_il.robots.robot import ROBOTS
    from manip_il.sim.env import EnvConfig
    from manip_il.tasks.table import TASKS

    if spec.robot not in ROBOTS or spec.task not in TASKS:
        warn([f"{root} is for {spec.robot} {spec.task}, which is not known here"])
        return
    env = EnvConfig(spec.robot, spec.task, spec.fps)
    check_same_spec(str(root), spec, "this program", env_spec(env))
    # Tolerance and horizon do not matter to what is learnt, and a dataset does not say them; nor do pictures, unseen.
    here = {key: value for key, value in env_fingerprint(env).items() if key != "config_sha256"}
    theirs = {key: value for key, value in fingerprint.items() if key not in ("config_sha256", "cameras_sha256")}
    warn(compare_fingerprints(str(root), theirs, "this machine", here))


def _value(options: Any, name: str) -> Any:
    return functools.reduce(getattr, name.split("."), options)


def _yaml(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _word(name: str, value: Any) -> str:
    plain = to_plain(value)
    if isinstance(plain, list):
        plain = ",".join(map(str, plain))
    if isinstance(plain, bool):
        plain = str(plain).lower()
    return f"--{name}={'null' if plain is None else plain}"
