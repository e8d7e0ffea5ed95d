"""Synthetic episodes, and no network."""

from ..synthetic import episodes, make_episode, offline, spec

__all__ = ["episodes", "make_episode", "offline", "spec"]
