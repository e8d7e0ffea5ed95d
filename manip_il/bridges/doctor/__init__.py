"""Check any LeRobot v3.0 dataset, and repair what can be repaired (`examine.py`).

`files.py` checks files and rows, `learning.py` whether a policy can learn. Nothing in a dataset
stops the checks: what `Dataset` cannot read is a finding, and the other checks continue.
"""
