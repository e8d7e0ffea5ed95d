"""A small command that does what it is told, for the tests of the command line."""

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from manip_il.cli.outputs import Stages, say
from manip_il.errors import ManipError, UsageError


@dataclass
class Group:
    root: Path | None = None
    num_episodes: int = field(default=50, metadata={"help": "how many episodes"})


@dataclass
class FakeOptions:
    """Do what the tests ask.

    And say so.

    Example: manip-il fake --act=say
    """

    act: Literal["say", "fail", "usage", "bug", "stop", "interrupt"] = "say"
    dataset: Group = field(default_factory=Group)
    resume: bool = False


def run_fake(options: FakeOptions) -> None:
    match options.act:
        case "say":
            say(f"episodes {options.dataset.num_episodes}")
        case "fail":
            raise ManipError("the work\nfailed")
        case "usage":
            raise UsageError("0 episodes; expected 1 or more")
        case "bug":
            raise ZeroDivisionError("by\nzero")
        case "stop":
            with Stages("1 of 50 episodes in x") as stages:
                os.kill(os.getpid(), signal.SIGTERM)
                stages.check()
        case "interrupt":
            raise KeyboardInterrupt
