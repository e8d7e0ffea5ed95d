"""Whether an evaluation fits into memory, asked before it starts: the kernel would end it in the middle."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from manip_il.errors import ManipError

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
_MB, _GB = 1_000_000, 1_000_000_000

# Measured as the peak of anonymous memory of a container's control group, over 20 to 50 episodes of Panda pick_place:
# 244 MB the expert, 556 MB an mlp, 861 MB a cnn with two cameras, each with one worker; with two, 1,459 MB an mlp and
# 2,391 MB a cnn, as the process that asks is then one more. An mlp ran in 580 MB and was killed in 500, a cnn ran in
# 900 MB and was killed in 700. An act with 161 MB of weights took 345 MB more than the cnn.
_PROCESS = 260 * _MB  # simulator, expert, Python
_LEARNED = 320 * _MB  # torch and a small network
_CAMERAS = 300 * _MB  # OpenGL, LeRobot's code around a network of pictures
# Once, whatever the number of workers: films and report (127 MB), and a health check that comes in between (310 MB).
_BESIDE = 450 * _MB


def check_memory(
    workers: int,
    cameras: bool,
    *,
    learned: bool = True,
    weights: int = 0,
    proc: Path = PROC,
    cgroups: Path = CGROUPS,
) -> None:
    """Raise `ManipError` where an evaluation in so many processes would run out of memory.

    Best before a policy is loaded, which may be too much already; what this process holds counts as free, as it is
    part of what is needed. cameras: whether the policy looks at pictures. learned: whether it is a network. weights:
    the size of its file [bytes]. Says nothing where the system does not tell what is free.
    """
    free, need = available_memory(proc, cgroups), needed_memory(workers, cameras, learned=learned, weights=weights)
    if free is None:
        return
    free += 1024 * _fields(proc / "self" / "status").get("RssAnon:", 0)
    if free >= need:
        return
    fitting = [n for n in range(1, workers) if needed_memory(n, cameras, learned=learned, weights=weights) <= free]
    fewer = f"use --workers={fitting[-1]}, or " if fitting else ""
    raise ManipError(
        f"too little memory: {workers} worker{'s' if workers > 1 else ''} {'with' if cameras else 'without'} cameras "
        f"need about {math.ceil(10 * need / _GB) / 10} GB, {math.floor(10 * free / _GB) / 10} GB are free; "
        f"{fewer}give it more (docker run --memory=...)"
    )


def needed_memory(workers: int, cameras: bool, *, learned: bool = True, weights: int = 0) -> int:
    """What an evaluation takes, with a margin [bytes]. One worker is the command's own process, more are beside it."""
    processes = 1 if workers == 1 else workers + 1
    each = _PROCESS + (_LEARNED + 2 * weights if learned else 0) + (_CAMERAS if cameras else 0)
    return _BESIDE + processes * each


def available_memory(proc: Path = PROC, cgroups: Path = CGROUPS) -> int | None:
    """What this process and its children may still take [bytes]; None where the system does not tell.

    The least of what the machine has free and of what each control group above this process (a container's limit)
    leaves. proc, cgroups: where those file systems are mounted.
    """
    rooms = [_machine(proc), *(_room(group) for group in _groups(proc, cgroups))]
    return min((room for room in rooms if room is not None), default=None)


def _machine(proc: Path) -> int | None:
    kilobytes = _fields(proc / "meminfo").get("MemAvailable:")
    return None if kilobytes is None else 1024 * kilobytes


def _groups(proc: Path, cgroups: Path) -> Iterator[Path]:
    """Folders of the memory control groups that hold this process, from its own up to the outermost one seen here.

    A line of `/proc/self/cgroup` is `0::/path` (version 2) or `4:memory:/path` (version 1). Within a container the
    path may be the host's, which is not to be seen there: what is, is the root, and that is the container's own.
    """
    for line in _lines(proc / "self" / "cgroup"):
        number, controllers, path = (*line.split(":", 2), "", "")[:3]
        if number == "0":
            root = cgroups
        elif "memory" in controllers.split(","):
            root = cgroups / "memory"
        else:
            continue
        group = root / path.lstrip("/")
        while group != root:
            yield group
            group = group.parent
        yield root


def _room(group: Path) -> int | None:
    """What a control group leaves [bytes]: its limit less what it holds, without the files that it only caches."""
    for limit_file, usage_file, prefix in (
        ("memory.max", "memory.current", ""),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
    ):
        limit, usage = _number(group / limit_file), _number(group / usage_file)
        if limit is not None and usage is not None:
            held = _fields(group / "memory.stat")
            cached = sum(held.get(f"{prefix}{kind}_file", 0) for kind in ("active", "inactive"))
            return max(0, limit - usage + min(cached, usage))
    return None


def _number(file: Path) -> int | None:
    """The number in a file; None for `max`, and where there is no such file."""
    text = "".join(_lines(file)).strip()
    return int(text) if text.isdigit() else None


def _fields(file: Path) -> dict[str, int]:
    """Name -> number of the lines of a file that begin so."""
    words = (line.split() for line in _lines(file))
    return {pair[0]: int(pair[1]) for pair in words if len(pair) > 1 and pair[1].isdigit()}


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # another system, or one that does not tell
        return []
