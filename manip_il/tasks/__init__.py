"""Tasks: a file each. Names in `table.py`'s order, for help that needs no simulator."""

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
SEVERAL = ("carry:REWARD",)  # tasks of which there are several, by what stands behind the colon
