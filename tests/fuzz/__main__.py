"""The program; processes are started anew, and find what they run in `run`, not here."""

from __future__ import annotations

import sys

from .run import main

sys.exit(main())
