"""The machine that a measurement ran on, printed above every table."""

import os
import platform
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("mujoco", "mink", "daqp", "torch", "lerobot")


def describe_machine() -> str:
    """Return one line: cores that this process may use, CPU model, load, versions."""
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    return (
        f"{cores} cores of {_cpu_model()}, load {load:.1f}; Python {platform.python_version()},"
        f" {versions}"
    )


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
