"""Robot-arm imitation learning without a human at the controls."""

__version__ = "0.1.0"
