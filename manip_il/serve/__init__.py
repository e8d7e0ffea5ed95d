"""A virtual arm behind serial ports: LeRobot's own drivers, unmodified, cannot tell it from a real one."""
