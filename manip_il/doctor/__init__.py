"""Examine any folder of a LeRobot v3.0 dataset, and repair what can be repaired (`examine.py`).

`files.py` checks files and rows, `learning.py` what keeps a policy from learning. No content of a folder ends an
examination: what `Dataset` cannot read is a finding, and the other checks go on.
"""
