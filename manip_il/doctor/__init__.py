"""Examine any folder of a LeRobot v3.0 dataset (`examine.examine`), and repair what can be repaired (`repair.repair`).

`files.py`, `pictures.py` and `motion.py` are the checks: of files and rows, of cameras, and of what keeps a policy from
learning. No content of a folder ends an examination: what `Dataset` cannot read is a finding, and other checks go on.
"""
