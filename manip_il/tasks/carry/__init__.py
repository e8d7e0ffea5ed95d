"""Carry: move an object past things on the table as cheaply as possible; `carry:REWARD` sets another reward.

`task.py` is the task, `starts.py` its starts; `layout.py` has the things' places and the cost of a metre of path,
`grid.py` plans on it, `reward.py` reads rewards; `things.py` has the things' bodies, and the parts of the hand that
may hit them.
"""
