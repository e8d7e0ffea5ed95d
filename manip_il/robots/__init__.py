"""Robots, each a YAML beside an MJCF."""

from pathlib import Path

HERE = Path(__file__).parent
ROBOTS = {"panda": HERE / "panda.yaml", "fetch": HERE / "fetch.yaml", "so101": HERE / "so101.yaml"}
