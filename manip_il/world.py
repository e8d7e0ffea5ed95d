"""What an environment and an expert of one's own are written against."""

from manip_il.mdp import Label, Observation, State
from manip_il.worlds.contract import Environment, EnvironmentSpec, Expert, Outcome

__all__ = ["Environment", "EnvironmentSpec", "Expert", "Label", "Observation", "Outcome", "State"]
