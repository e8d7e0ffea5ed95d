"""Settings of pictures refuse what no video or lamp can be, and have one canonical text."""

from __future__ import annotations

import dataclasses
import json
import pickle
from functools import partial

import pytest

from manip_il.data.fingerprint import canonical_json
from manip_il.errors import UnknownName, UsageError
from manip_il.sim.config import FILM, CameraConfig, Look
from manip_il.tasks.envs import make_env

BRIGHTNESS, TURN = r"brightness is .*; expected a factor from 0\.1 to 2", r"light_turn is .* degrees"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CameraConfig(()), "cameras are none; expected at least one"),
        (lambda: CameraConfig(("front", "front")), "front, front; expected at least one, each once"),
        (lambda: CameraConfig(("front",), 127), "height 127 and width 128; expected even numbers from 16 to 2048"),
        (lambda: CameraConfig(("front",), width=14), "height 128 and width 14"),
        (lambda: CameraConfig(("front",), width=4096), "width 4096"),
        *((partial(Look, brightness=bad), BRIGHTNESS) for bad in (0.0, 2.1, -1.0, float("nan"), float("inf"))),
        *((partial(Look, light_turn=bad), TURN) for bad in (-181.0, 360.0, float("nan"))),
    ],
)
def test_pictures_that_no_video_takes_and_light_that_no_lamp_gives_are_refused(make, words: str):
    with pytest.raises(UsageError, match=words):
        make()


def test_an_unknown_camera_answers_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'wrist'"):
        make_env("panda", "reach", cameras=("wrst",))


def test_equal_configurations_have_one_canonical_text_and_others_another():
    config = CameraConfig(("front", "wrist"), 96, 128, FILM)
    same = pickle.loads(pickle.dumps(config))
    assert same == config
    assert canonical_json(same) == canonical_json(config)
    texts = {canonical_json(dataclasses.replace(config, look=look)) for look in (FILM, Look(), Look(light_turn=90))}
    assert len(texts) == 3
    assert json.loads(canonical_json(config)) == json.loads(json.dumps(dataclasses.asdict(config)))
