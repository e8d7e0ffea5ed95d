"""Methods of the chapter beyond cloning and DAgger: theory, inverse RL, preferences, GAIL, AIRL,
PPO.
"""
