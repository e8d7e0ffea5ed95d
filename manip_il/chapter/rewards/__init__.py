"""Rewards inferred from demonstrations, as weights of path features."""
