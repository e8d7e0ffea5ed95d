"""Finite Markov decision processes, solved exactly."""
