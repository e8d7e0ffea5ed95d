"""Robots, tasks and physics: MjSpec in, a gymnasium environment out."""

from manip_il.sim.gl import choose_backend

# The one thing that happens on import: mujoco reads MUJOCO_GL when it is imported, never after.
choose_backend()
