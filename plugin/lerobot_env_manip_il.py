"""Registers manip_il's environments, policies and teleoperator with LeRobot, whose commands import
this module because of its name.
"""

import manip_il.lerobot_plugin  # noqa: F401
