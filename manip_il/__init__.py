"""Robot-arm imitation learning without a human at the controls.

Importing the package registers its environments with gymnasium, as packages of environments do.
"""

from manip_il.sim.register import register_envs

__version__ = "0.1.0"

register_envs()
