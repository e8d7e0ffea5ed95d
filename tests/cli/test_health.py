"""`manip-il eval --check` says in one line what there is, or what is missing."""

from __future__ import annotations

import re

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.errors import RenderError
from manip_il.sim.config import CAMERAS


@pytest.mark.gl
def test_a_healthy_machine_says_what_it_has(capsys):
    assert main(["eval", "--check"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert re.fullmatch(r"healthy: \S.*; torch 2\.\d\S+; cores [1-9]\d*\n", out)


def test_a_wrong_backend_is_named_with_the_right_ones(monkeypatch, error):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    assert main(["eval", "--check"]) == 1
    assert "MUJOCO_GL is 'nonsense'; expected egl or osmesa" in error()


def test_opengl_that_fails_or_draws_nothing_is_one_line(monkeypatch, error):
    def fail(*_, **__):
        raise RenderError("no off-screen OpenGL here")

    monkeypatch.setattr("manip_il.sim.render.pictures", fail)
    assert main(["eval", "--check"]) == 1
    assert "no off-screen OpenGL here" in error()
    blank = {name: np.zeros((8, 8, 3), dtype=np.uint8) for name in CAMERAS}
    monkeypatch.setattr("manip_il.sim.render.pictures", lambda *_, **__: blank)
    assert main(["eval", "--check"]) == 1
    assert "camera front sees nothing" in error()


def test_a_folder_for_temporary_files_that_is_missing_is_said(monkeypatch, error):
    def fail(*_):
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr("tempfile.TemporaryFile", fail)
    assert main(["eval", "--check"]) == 1
    assert "docker run --tmpfs /tmp: [Errno 2] No usable temporary directory" in error()
