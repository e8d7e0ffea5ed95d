"""Rewards from preferences between clips: choosing pairs, collecting answers, fitting a reward,
scoring datasets.
"""
