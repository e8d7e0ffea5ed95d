"""Carry: move an object past obstacles on the table as cheaply as possible.

`carry:REWARD` sets another reward.

`task.py` is the task and its starts; `layout.py` has the obstacles' places, the cost of a metre of
path and rewards; `grid.py` plans in a layout; `obstacles.py` has the obstacles' bodies, and the
parts of the hand that may hit them.
"""
