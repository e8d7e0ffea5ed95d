"""Robot-arm imitation learning without a human at the controls.

Importing the package registers its environments with gymnasium, as packages of environments do.
"""

from manip_il.child_processes import obey_parent

obey_parent()  # before all other imports: they take a second, in which the process that started this one may be killed

from manip_il.sim.register import register_envs  # noqa: E402

__version__ = "0.1.0"

register_envs()
