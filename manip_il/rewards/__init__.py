"""Finite Markov decision processes, solved exactly, and rewards inferred from demonstrations in them."""
