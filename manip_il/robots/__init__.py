"""The robots that ship with the package, each described by a YAML."""

from pathlib import Path

HERE = Path(__file__).parent
# servos whose YAML is there, the usual ones first
NAMED_SERVOS = ("sts3215", "ideal")
ROBOTS = {"panda": HERE / "panda.yaml", "fetch": HERE / "fetch.yaml", "so101": HERE / "so101.yaml"}
