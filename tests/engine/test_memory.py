"""Too little memory is said before the first episode, from what the machine and its control groups tell."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from manip_il.engine.local import available_memory, check_memory, needed_memory
from manip_il.errors import ManipError

GB = 10**9
KIB = 1024


def machine(folder: Path, *, free: int | None, groups: str = "", own: int = 0) -> Path:
    """A /proc whose machine has `free` bytes, and whose process holds `own` of its own and is in `groups`."""
    (folder / "self").mkdir(parents=True)
    if free is not None:
        (folder / "meminfo").write_text(f"MemTotal: 99 kB\nMemAvailable:   {free // KIB} kB\nHugePages_Total: 0\n")
    (folder / "self" / "cgroup").write_text(groups)
    (folder / "self" / "status").write_text(f"Name:\tpython\nRssAnon:\t{own // KIB} kB\n")
    return folder


def group(folder: Path, version: int, limit: int | str, used: int, cached: int = 0) -> None:
    """A control group that holds `used` bytes, of which it only caches `cached`, half of it in use lately."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    prefix = "" if version == 2 else "total_"
    for name, value in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    half = cached // 2
    (folder / "memory.stat").write_text(
        f"anon {used - cached}\n{prefix}active_file {half}\n{prefix}inactive_file {half}\n"
    )


@pytest.fixture
def groups(tmp_path) -> Path:
    return tmp_path / "cgroup"


@pytest.mark.parametrize(
    ("lines", "held", "left"),
    [
        ("0::/user.slice\n", {"user.slice": (2, "max", GB)}, 64 * GB),  # no limit: what the machine has free
        # A container's limit, less what it holds but does not merely cache.
        ("0::/\n", {".": (2, 4 * GB, 3 * GB, 2 * GB)}, 3 * GB),
        ("7:cpu:/\n4:memory:/\n", {"memory": (1, 4 * GB, 3 * GB, 2 * GB)}, 3 * GB),
        # Within a container the host's path leads nowhere, and the root counts.
        ("4:memory:/docker/0123456789ab\n0::/\n", {"memory": (1, 2 * GB, GB)}, GB),
        # Of nested groups the tightest counts.
        (
            "0::/job/step/task\n",
            {"job": (2, 5 * GB, 4 * GB), "job/step": (2, 3 * GB, GB), "job/step/task": (2, "max", GB)},
            GB,
        ),
        ("0::/\n", {".": (2, GB, 2 * GB)}, 0),  # beyond its limit
    ],
    ids=["no limit", "version 2", "version 1", "host's path", "nested", "beyond"],
)
def test_the_least_that_machine_and_control_groups_leave(tmp_path, groups, lines: str, held: dict, left: int):
    for folder, numbers in held.items():
        group(groups / folder, *numbers)
    proc = machine(tmp_path / "proc", free=64 * GB, groups=lines)
    assert available_memory(proc, groups) == (pytest.approx(left, abs=KIB) if left == 64 * GB else left)


def test_more_workers_cameras_networks_and_weights_each_need_more():
    assert needed_memory(1, False) < needed_memory(2, False) < needed_memory(3, False)
    assert needed_memory(2, False, learned=False) < needed_memory(2, False) < needed_memory(2, True)
    # in every process, two workers and the one that asks, as read and as loaded
    assert needed_memory(2, True, weights=GB) == needed_memory(2, True) + 3 * 2 * GB


def test_too_little_names_need_rest_and_the_number_of_workers_that_fits(tmp_path, groups):
    proc = machine(tmp_path / "proc", free=needed_memory(3, True) + KIB)
    check_memory(3, True, proc=proc, cgroups=groups)
    with pytest.raises(ManipError) as error:
        check_memory(8, True, proc=proc, cgroups=groups)
    text = str(error.value)
    assert "8 workers with cameras" in text
    need, free = (float(number) for number in re.findall(r"([\d.]+) GB", text))
    assert need == pytest.approx(needed_memory(8, True) / GB, abs=0.1)
    assert free == pytest.approx(needed_memory(3, True) / GB, abs=0.1)
    assert "--workers=3" in text
    assert "\n" not in text


def test_where_not_even_one_worker_fits_only_more_memory_helps(tmp_path, groups):
    proc = machine(tmp_path / "proc", free=GB // 4)
    with pytest.raises(ManipError, match=r"1 worker without cameras.*0\.2 GB are free; give it more") as error:
        check_memory(1, False, proc=proc, cgroups=groups)
    assert "--workers" not in str(error.value)


def test_what_this_process_holds_already_is_part_of_the_need(tmp_path, groups):
    need = needed_memory(1, True)
    with pytest.raises(ManipError):
        check_memory(1, True, proc=machine(tmp_path / "new", free=need - GB // 4), cgroups=groups)
    check_memory(1, True, proc=machine(tmp_path / "loaded", free=need - GB // 4, own=GB // 4 + 2 * KIB), cgroups=groups)


def test_where_nothing_is_told_nothing_is_said(tmp_path):
    assert available_memory(tmp_path / "none", tmp_path / "none") is None
    check_memory(10_000, True, proc=tmp_path / "none", cgroups=tmp_path / "none")


def test_this_machine_has_memory_and_no_end_of_workers_is_too_many():
    check_memory(1, False, learned=False)
    free = available_memory()
    if free is not None:
        with pytest.raises(ManipError, match="too little memory"):
            check_memory(10 + 10 * free // needed_memory(1, True), True)
