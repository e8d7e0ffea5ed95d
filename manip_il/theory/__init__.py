"""Theorems on imitation, compared with exactly solved processes, linear systems and an arm."""
