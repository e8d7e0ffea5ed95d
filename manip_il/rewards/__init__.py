"""Finite Markov decision processes, the chapter's theorems on them, and rewards inferred from demonstrations."""
