"""What runs in the children of the fault tests; imported by name there."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence


def run_command(words: Sequence[str], log: str) -> None:
    """In a child: one command, as from a shell, with all that it says in the file `log`."""
    from manip_il.cli.main import main

    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    sys.exit(main(words))
