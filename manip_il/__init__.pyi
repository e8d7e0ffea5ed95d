from manip_il.collect.expert import Expert
from manip_il.collect.record import record
from manip_il.tasks.envs import make_env

__all__ = ["Expert", "make_env", "record"]
__version__: str
