"""Proven bounds of imitation learning, beside exactly solved MDPs, linear systems and a robot
arm.
"""
