"""Which pictures a policy must be shown, by its folder."""

from __future__ import annotations

import pytest

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.errors import ManipError
from manip_il.learn.checkpoint import Origin, policy_cameras
from manip_il.sim.config import CameraConfig, Look
from manip_il.tasks.config import make_config

from .tiny_policies import edit_config, write_checkpoint

ENV = make_config("panda", "reach", horizon=8)
DIM = CameraConfig(("front",), 32, 32, Look(brightness=0.5))


def test_a_checkpoint_says_what_it_must_be_shown(tmp_path):
    assert policy_cameras(write_checkpoint(tmp_path / "blind", "act", env_spec(ENV))) is None
    spec = env_spec(ENV, DIM)
    meta = Origin.of(spec, env_fingerprint(ENV, DIM), observation="images", look={"brightness": 0.5})
    assert policy_cameras(write_checkpoint(tmp_path / "dim", "act", spec, "images", origin=meta)) == DIM
    spec = env_spec(ENV, CameraConfig(("wrist", "front"), 32, 64))
    other = write_checkpoint(tmp_path / "other", "act", spec, "both")  # as lerobot-train leaves it
    assert policy_cameras(other) == CameraConfig(("wrist", "front"), 32, 64)


def test_pictures_that_no_environment_has_are_refused(tmp_path):
    folder = write_checkpoint(tmp_path / "p", "act", env_spec(ENV, DIM), "images")
    features = {"observation.state": {"type": "STATE", "shape": [8]}}

    def look_at(**pictures: list[int]) -> None:
        visual = {f"observation.images.{name}": {"type": "VISUAL", "shape": shape} for name, shape in pictures.items()}
        edit_config(folder, input_features=features | visual)

    for pictures, words in (({"belly": [3, 32, 32]}, "camera 'belly'"), ({"front": [3, 33, 32]}, "height 33")):
        look_at(**pictures)
        with pytest.raises(ManipError, match=words):
            policy_cameras(folder)
