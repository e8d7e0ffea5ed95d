"""Rewards inferred from demonstrations: weights of the costs of paths."""
