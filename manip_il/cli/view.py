"""`manip-il view`: a robot at its task, live in MuJoCo's viewer, or in Rerun if there is no display."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.cli.common_options import OF_POLICY, Tested, Trusting
from manip_il.cli.options import Given, given
from manip_il.option import Seeded, option
from manip_il.worlds.config import EnvConfig

IN_A_FILE = 3  # episodes written to a file by default


@dataclass(frozen=True)
class WatchedPolicyGroup:
    """`--policy.*`: the policy that drives."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random", "sliders"] | None = option(
        None, "who drives instead of a checkpoint, by default the expert; sliders: you, in the window"
    )


@dataclass(frozen=True)
class ViewOptions(Tested, Seeded, Trusting):
    """Watch a robot at its task in MuJoCo's viewer; without a display, in a browser (Rerun) or from a file.

    Episodes run in real time until --n_episodes have ended, the window is closed or Ctrl-C is pressed. The browser
    shows pictures, joints, actions, phase and progress. --output writes these as fast as possible to a file, which
    `rerun FILE.rrd` opens on any machine.

    Example: manip-il view --robot.type=panda --task.type=stack --n_episodes=1 --output=stack.rrd
    """

    first: ClassVar[str] = "policy.path policy.type robot.type task.type n_episodes output"
    policy: WatchedPolicyGroup = field(default_factory=WatchedPolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    n_episodes: int | None = option(None, f"episodes; by default unlimited, or {IN_A_FILE} with --output", at_least=1)
    output: Path | None = option(None, "write a Rerun file, FILE.rrd, instead of showing episodes")
