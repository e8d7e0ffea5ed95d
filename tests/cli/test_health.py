"""`manip-il eval --check` says in one line what there is, or what is missing."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest

from manip_il.cli import health
from manip_il.cli.main import main
from manip_il.errors import ManipError, RenderError


@pytest.fixture
def undrawn(monkeypatch):
    """No pictures: what is looked at comes before or after them."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(health, "_draw", lambda: "a picture")


@pytest.mark.gl
def test_a_healthy_machine_says_what_it_has(capsys):
    assert main(["eval", "--check"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    [line] = out.splitlines()
    assert re.match(r"healthy: \S.*, \d+\.\d ms a picture of 128 x 128; torch 2\.\d+", line)
    assert re.search(r"graphics cards for CUDA \d+; cores [1-9]", line)


def test_torch_is_not_imported_to_say_its_version():
    code = "import sys; from manip_il.cli.health import describe_torch; print(describe_torch()); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    described, modules = done.stdout.splitlines()
    assert re.match(r"torch 2\.\d+\.\d+", described)
    assert "torch" not in modules.split()


@pytest.mark.parametrize("backend", ["nonsense", "", "disable"])
def test_a_wrong_backend_is_named_with_the_right_ones(backend, monkeypatch, error):
    monkeypatch.setenv("MUJOCO_GL", backend)
    assert main(["eval", "--check"]) == 1
    assert f"MUJOCO_GL is {backend!r}; expected egl or osmesa" in error()


def test_without_any_backend_the_packages_are_named():
    with pytest.raises(RenderError, match=r"neither EGL nor OSMesa is installed.*libegl1"):
        health.check_backend(None)


def test_opengl_that_fails_is_one_line(monkeypatch, error):
    def fail(*_, **__):
        raise RenderError("no off-screen OpenGL here")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr("manip_il.sim.render.pictures", fail)
    assert main(["eval", "--check"]) == 1
    assert "no off-screen OpenGL here" in error()


def test_pictures_of_one_colour_are_no_pictures(monkeypatch):
    monkeypatch.setattr(health, "_renderer", lambda: "some driver")
    scene = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    health.check_pictures({"front": scene})
    with pytest.raises(RenderError, match=r"camera wrist sees 1 colour, .*some driver"):
        health.check_pictures({"front": scene, "wrist": np.zeros((8, 8, 3), dtype=np.uint8)})


def test_temporary_files_that_end_up_in_the_current_folder_are_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ManipError, match="temporary files would go into"):
        health.check_temporary_folder()


def fails(error: OSError):
    def fail(*_):
        raise error

    return fail


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("place", "stand_in", "says"),
    [
        (
            "tempfile.TemporaryFile",
            fails(FileNotFoundError(2, "No usable temporary directory found")),
            "cannot create a temporary file (No usable temporary directory found); make /tmp writable",
        ),
        (
            "multiprocessing.get_context",
            lambda _: SimpleNamespace(Lock=fails(PermissionError(13, "Permission denied"))),
            "/dev/shm writable",
        ),
    ],
)
def test_what_cannot_be_written_is_said(place, stand_in, says, monkeypatch, error):
    monkeypatch.setattr(place, stand_in)
    assert main(["eval", "--check"]) == 1
    assert says in error()
