"""What the commands do.

`manip_il.cli` declares their options, without these imports, and calls `run_COMMAND`.
"""
