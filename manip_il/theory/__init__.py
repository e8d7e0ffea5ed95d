"""Theorems on imitation, seen: on processes solved exactly, on linear systems, and on an arm."""
