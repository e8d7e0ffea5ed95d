"""A few inputs of every kind on each run of the tests; `make fuzz` reads thousands."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import constants

from .table import TARGETS
from .target import Bench, bench

SETTINGS: dict[str, Any] = json.loads(os.environ.get("MANIP_IL_FUZZ", "{}"))  # of `make fuzz`
INPUTS = 6  # of each target where no others are asked for
STARTING = 900.0  # until a target's valid files are made and read [s]
LONGEST = 30.0 if SETTINGS else 600.0  # one input [s]: what takes longer hangs


def inputs() -> Iterator[Any]:
    """Every target with its numbers."""
    targets = [target for target in TARGETS if target.name in SETTINGS.get("targets", [target.name])]
    total = sum(target.share for target in targets)
    for target in targets:
        count = max(1, round(SETTINGS["inputs"] * target.share / total)) if SETTINGS else INPUTS
        number = SETTINGS.get("number")
        for place in range(count) if number is None else [number]:
            yield pytest.param(target, place, id=f"{target.name} {place}")


@contextlib.contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """End this process, with its stack, where it takes longer."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="module")
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        patch.chdir(folder)
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setattr(constants, "HF_HUB_OFFLINE", True)
        with ended_after(STARTING):
            one = stack.enter_context(bench(request.param, folder))
        yield one


@pytest.mark.parametrize(("made", "number"), inputs(), indirect=["made"])
def test_a_mutated_input_is_accepted_or_refused_in_one_line(
    made: Bench, number: int, record_property: Callable[[str, object], None]
) -> None:
    name, seed = made.target.name, SETTINGS.get("seed", 0)
    kept = Path(SETTINGS.get("output", made.base.parent), f"{name.replace(' ', '_')}-{number}")
    kept.mkdir(parents=True, exist_ok=True)
    data = made.mutated(seed, number)
    (kept / made.file.name).write_bytes(data)
    with ended_after(LONGEST):
        tried = made.attempt(data, number)
    print(f"{kept}: {tried.line or 'accepted'}\n{tried.seconds:.2f} s, {tried.megabytes:.0f} MB")
    record_property("accepted", not tried.line and not tried.problem)
    record_property("seconds", tried.seconds)
    record_property("megabytes", tried.megabytes)
    if tried.problem:
        again = f"python -m tests.fuzz --seed={seed} --target='{name}' --number={number}"
        (kept / "problem.txt").write_text(f"{again}\n\n{tried.problem}\n")
        pytest.fail(f"{again}\n{tried.problem}", pytrace=False)
    if SETTINGS.get("number") is None:
        shutil.rmtree(kept)
