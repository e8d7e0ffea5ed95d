"""Rewards from preferences between clips: pairs, who compares them, the fit, and scores of datasets by a reward."""
