"""The servos of a real arm, from what was recorded of it."""
