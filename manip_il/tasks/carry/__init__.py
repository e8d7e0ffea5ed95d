"""Carry: an object past what stands on the table, as a reward likes it; `carry:REWARD` for another reward.

`task.py` is the task, `starts.py` its starts; `layout.py` is what stands where and what a metre of path costs there,
`grid.py` plans on it, `reward.py` reads rewards; `things.py` has the things as bodies, and what of the hand may meet
them.
"""
