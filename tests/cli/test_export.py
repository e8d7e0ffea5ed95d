"""`manip-il export`: one file, refused early where it cannot be, and run without this package as
the docs show.
"""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.data.fingerprint import policy_sha256
from manip_il.learn.checkpoint import Origin
from manip_il.learn.policy import LearnedPolicy
from manip_il.worlds.table import env_spec, make_config

from ..learn.tiny_policies import write_checkpoint

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
(SNIPPET,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
SPEC = env_spec(make_config("panda", "pick_place"))
# Before the snippet: these packages cannot be imported, as if they were not installed.
WITHOUT = "import sys; sys.modules |= dict.fromkeys(('manip_il', 'lerobot', 'torch', 'onnx'))\n"


def write_run(folder: Path, kind: str = "mlp", observation: str = "state") -> Path:
    """A run with a policy where `train` leaves it; returns that policy's folder."""
    spec = (
        SPEC if observation == "state" else replace(SPEC, cameras=("front",), image_size=(32, 48))
    )
    meta = Origin.of(spec, observation=observation)
    place = folder / "checkpoints" / "last" / "pretrained_model"
    return write_checkpoint(place, kind, spec, observation, origin=meta)


def test_it_tells_how_near_the_checkpoint_the_file_is(here, capsys):
    policy = write_run(here / "run", "cnn", "both")
    assert main(["export", "run"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    first, last = out.splitlines()
    difference = re.fullmatch(
        rf"largest difference from {policy.relative_to(here)} over random .*: (\S+)", first
    )
    assert difference
    assert float(difference[1]) <= 1e-5
    assert last == f"exported: policy.onnx ({(here / 'policy.onnx').stat().st_size:,} bytes)"
    assert policy_sha256(policy).encode() in (here / "policy.onnx").read_bytes()


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("act", "POLICY is a policy of type 'act'; only mlp and cnn can be exported"),
        (
            "mlp",
            "an ONNX file needs onnxruntime, which is not installed: pip install 'manip_il[export]'",
        ),
    ],
)
def test_what_cannot_be_exported_is_one_line(here, error, monkeypatch, kind, line):
    policy = str(write_run(here / "run", kind).relative_to(here))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["export", "run"]) == 1
    assert error() == f"manip-il: error: {line}".replace("POLICY", policy)
    assert [path.name for path in here.iterdir()] == ["run"]


@pytest.mark.parametrize(("kind", "observation"), [("mlp", "state"), ("cnn", "both")])
@pytest.mark.slow
def test_the_docs_snippet_runs_it_without_this_package(here, kind, observation):
    policy = LearnedPolicy.load(write_run(here / "run", kind, observation))
    assert main(["export", "run"]) == 0
    (here / "snippet.py").write_text(WITHOUT + SNIPPET)
    done = subprocess.run(
        [sys.executable, "-I", "snippet.py"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    said = [line.split(": ") for line in done.stdout.splitlines()]
    assert [name for name, _ in said] == list(SPEC.joint_names)
    images = {camera: np.zeros((1, 32, 48, 3), np.uint8) for camera in policy.cameras}
    expected = policy.act(np.zeros((1, 8), np.float32), np.zeros((1, 25), np.float32), images)[0]
    assert np.abs(np.array([float(value) for _, value in said]) - expected).max() <= 1.1e-5
    assert np.abs(expected).max() > 1e-3
