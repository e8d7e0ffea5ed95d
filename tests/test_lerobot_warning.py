"""Where FFmpeg's libraries are missing LeRobot says so with a traceback; here it is one line, once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from manip_il.errors import NO_FFMPEG

ROOT = Path(__file__).resolve().parents[1]
STUB = r"raise RuntimeError('Could not load libtorchcodec.\n' + 'Traceback (most recent call last):\n' * 90)"
CODE = """
from manip_il.cli import main as program
from manip_il.cli.main import Command, main
program.COMMANDS["fake"] = Command("__main__:Fake", "ask LeRobot twice for its decoder")

from dataclasses import dataclass

@dataclass
class Fake:
    def run(self):
        from lerobot.utils.import_utils import get_safe_default_video_backend
        print(get_safe_default_video_backend(), get_safe_default_video_backend())

raise SystemExit(main(["fake"]))
"""


def test_a_torchcodec_without_ffmpeg_is_one_line(tmp_path):
    (tmp_path / "torchcodec").mkdir()
    (tmp_path / "torchcodec" / "__init__.py").write_text(STUB)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    run = [sys.executable, "-c", CODE]
    done = subprocess.run(run, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "pyav pyav\n"
    assert done.stderr == f"{NO_FFMPEG}\n"
