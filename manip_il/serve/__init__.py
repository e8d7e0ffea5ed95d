"""A virtual arm on serial ports, which LeRobot's unmodified drivers use like a real one."""
