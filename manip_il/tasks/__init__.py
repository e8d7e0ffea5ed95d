"""Tasks, one file each. `NAMES` has the order of `table.py`, for help without the simulator."""

NAMES = (
    "reach",
    "lift",
    "pick_place",
    "push",
    "press",
    "stack",
    "drawer",
    "clear_table",
    "insert",
    "insert_tight",
    "sort",
    "carry",
)
SEVERAL = ("carry:REWARD",)  # tasks with an argument after a colon
