"""Every kind of input that is fuzzed."""

from __future__ import annotations

from . import datasets, files, policies, preferences, remotes
from .target import Target

TARGETS: tuple[Target, ...] = (
    *datasets.TARGETS,
    *policies.TARGETS,
    *files.TARGETS,
    *preferences.TARGETS,
    *remotes.TARGETS,
)
