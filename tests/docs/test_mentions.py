"""What README and docs mention is there: options, commands, files, headings."""

from __future__ import annotations

import dataclasses
import re
import typing
from functools import cache
from pathlib import Path

import pytest

from manip_il.cli.main import COMMANDS, GROUPS, load
from manip_il.cli.options import options_of

from .pages import PAGES, ROOT

_OPTION = re.compile(r"(?<![\w-])--([a-zA-Z][\w.-]*)")
_ALWAYS = {"help", "debug", "quiet", "version", "config_path"}
_OTHERS = {  # of other programs, by their own manuals
    "docker": {
        "build-arg", "cap-drop", "cpus", "gpus", "memory", "network", "read-only", "rm", "security-opt",
        "tmpfs", "user",
    },
    "pip": {"no-deps"},
    "accelerate": {"multi_gpu", "num_processes"},
    "lerobot-dataset-viz": {"episode-index", "output-dir", "repo-id", "root", "save"},
}  # fmt: skip
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_INLINE_COMMAND = re.compile(r"`manip-il ([a-z]+(?: [a-z-]+)?)")


@pytest.mark.parametrize("page", PAGES)
def test_every_option_is_one_of_a_command(page: str):
    known = _ALWAYS | _our_options() | _lerobots_options() | set().union(*_OTHERS.values(), _of_benchmarks())
    text = (ROOT / page).read_text(encoding="utf-8")
    unknown = {name.rstrip(".-") for name in _OPTION.findall(text)} - known
    assert [name for name in unknown if not _is_open(name)] == []


@pytest.mark.parametrize("page", PAGES)
def test_every_command_is_one_that_there_is(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    unknown = [words for words in _INLINE_COMMAND.findall(text) if not {words, words.split()[0]} & {*COMMANDS, *GROUPS}]
    assert unknown == []


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_heading_of_the_repository(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    for link in _LINK.findall(text):
        if link.startswith("https://"):
            continue
        name, _, heading = link.partition("#")
        target = (ROOT / page).parent / name if name else ROOT / page
        assert target.exists(), f"{page}: {link}"
        assert not heading or heading in _headings(target), f"{page}: {link}"


def test_every_page_of_the_docs_is_on_the_map():
    on_the_map = {link.partition("#")[0] for link in _LINK.findall((ROOT / "docs/README.md").read_text("utf-8"))}
    pages = {str(path.relative_to(ROOT / "docs")) for path in ROOT.glob("docs/**/*.md")}
    assert pages - {"README.md"} <= on_the_map


@cache
def _our_options() -> set[str]:
    return {option.name for name in COMMANDS for option in options_of(load(name))}


def _is_open(name: str) -> bool:
    """Whether it is an option of a policy, an optimiser and so on, which other programs name; checked where we can."""
    group, _, inner = name.partition(".")
    if group == "policy":
        return inner in _policies_options()
    return group in ("optimizer", "scheduler", "wandb") and bool(inner)


@cache
def _policies_options() -> set[str]:
    from manip_il.learn.lerobot_config import policy_class, policy_types

    return {field.name for kind in policy_types() for field in dataclasses.fields(policy_class(kind))} | {
        "type", "path", "discover_packages_path",
    }  # fmt: skip


@cache
def _lerobots_options() -> set[str]:
    """Of lerobot-train, lerobot-eval, lerobot-edit-dataset, and the programs for a real arm."""
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.scripts import lerobot_edit_dataset

    from manip_il.lerobot_plugin import ManipILEnv

    found = _leaves(TrainPipelineConfig) | _leaves(EvalPipelineConfig) | _leaves(lerobot_edit_dataset.EditDatasetConfig)
    found |= {f"env.{field.name}" for field in dataclasses.fields(ManipILEnv)} | {"env.type", "operation.type"}
    kinds = [kind for kind in vars(lerobot_edit_dataset).values() if isinstance(kind, type)]
    edits = [kind for kind in kinds if dataclasses.is_dataclass(kind) and kind.__name__.endswith("Config")]
    found |= {f"operation.{field.name}" for kind in edits for field in dataclasses.fields(kind)}
    return found | _of_a_real_arm() | {"env.discover_packages_path"}


def _of_a_real_arm() -> set[str]:
    from lerobot.robots.so_follower import SOFollowerRobotConfig
    from lerobot.rollout.configs import RolloutConfig
    from lerobot.scripts.lerobot_record import RecordConfig
    from lerobot.teleoperators.so_leader import SOLeaderTeleopConfig

    found = _leaves(RolloutConfig) | _leaves(RecordConfig) | {"robot.type", "teleop.type", "strategy.type"}
    parts = {"robot": SOFollowerRobotConfig, "teleop": SOLeaderTeleopConfig}
    return found | {f"{part}.{field.name}" for part, kind in parts.items() for field in dataclasses.fields(kind)}


def _leaves(kind: type, prefix: str = "") -> set[str]:
    found: set[str] = set()
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        choices = [one for one in (hints[field.name], *typing.get_args(hints[field.name])) if isinstance(one, type)]
        nested = [one for one in choices if dataclasses.is_dataclass(one)]
        found.add(prefix + field.name)
        for one in nested:
            found |= _leaves(one, f"{prefix}{field.name}.")
    return found


def _of_benchmarks() -> set[str]:
    texts = [path.read_text(encoding="utf-8") for path in ROOT.glob("benchmarks/*.py")]
    return {name for text in texts for name in re.findall(r'add_argument\(\s*"--([\w-]+)"', text)}


def _headings(page: Path) -> set[str]:
    """As GitHub names them in addresses."""
    lines = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}
