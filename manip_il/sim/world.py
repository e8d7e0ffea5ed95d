"""What every scene has in common, as plain numbers and names: for what must know them without a simulator."""

CAMERAS = ("front", "wrist")
CUBE_HALF_SIZE = 0.025  # [m]
CUBE_MASS = 0.1  # [kg]
CUBE_FRICTION = 1.0  # sliding, against anything
