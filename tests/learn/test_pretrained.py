"""A folder that cannot be used is refused in one line before anything of it is loaded."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.errors import ManipError, MismatchError
from manip_il.learn.pretrained import Interface, check_interface, read_interface

from .tiny_policies import edit_config, refused, write_checkpoint


class Bomb:
    """Says that it was unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_what_a_policy_sees_and_gives_is_read_from_its_config_alone(pictured, tmp_path):
    folder = write_checkpoint(tmp_path / "policy", "act", pictured, "both")
    (folder / "policy_preprocessor.json").unlink()
    interface = read_interface(folder)
    assert interface == Interface(
        "act",
        {"observation.state": 4, "observation.environment_state": 6},
        {"front": (32, 48), "wrist": (32, 48)},
        4,
    )
    check_interface(interface, pictured)


@pytest.mark.parametrize("name", ["pytorch_model.bin", "sub/weights.PT", "x.pth", "rng.pkl", "last.ckpt"])
def test_a_folder_with_a_pickle_is_refused_and_the_pickle_not_opened(name, act, tmp_path):
    mark = tmp_path / "opened"
    (act / name).parent.mkdir(exist_ok=True)
    (act / name).write_bytes(pickle.dumps(Bomb(mark)))
    refused(act, rf"{name} is a pickle.*convert it to safetensors")
    assert not mark.exists()
    (act / "model.safetensors").unlink()
    refused(act, rf"{name} is a pickle")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("config.json", r"no config\.json in"),
        ("model.safetensors", r"no model\.safetensors in .*weights are missing"),
        ("policy_preprocessor.json", r"no .*policy_preprocessor\.json"),
    ],
)
def test_a_file_that_is_missing_or_of_another_user_is_named(name, words, act, monkeypatch):
    if not name.startswith("policy_"):
        with monkeypatch.context() as patch:
            patch.setattr("os.access", lambda path, mode: Path(path).name != name)
            refused(act, rf"{name} may not be read by this user \(uid \d+\); run as its owner")
    (act / name).rename(act / "adapter_model.safetensors")
    refused(act, "adapter: merge" if name == "model.safetensors" else words)
    (act / "adapter_model.safetensors").unlink()
    refused(act, words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not valid JSON"),
        ("[" * 100_000, "nested too deeply"),
        ("[]", r"is \[\]; expected an object"),
        ('{"type": null}', "is not a LeRobot policy's: type is None"),
        ('{"type": {"act": 1}}', "is not a LeRobot policy's: type is"),
        ('{"type": "act"}', "is not a LeRobot policy's: input_features is None"),
        ('{"type": "act", "input_features": null}', "is not a LeRobot policy's: input_features is None"),
        ('{"type": "act", "input_features": {}, "output_features": []}', "output_features is \\[\\]"),
    ],
)
def test_a_config_that_is_no_policys_is_refused(text, words, act):
    (act / "config.json").write_text(text)
    with pytest.raises(ManipError, match=rf"config\.json {words}" if words.startswith("is") else words):
        read_interface(act)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"numbers": {"observation.state": 5}}, r"width of observation\.state .*the policy has 5, arm/reach has 4"),
        ({"numbers": {"observation.effort": 4}}, r"inputs .*the policy has observation\.effort, .*arm/reach has obs"),
        ({"action": 7}, r"width of the action differs: the policy has 7, arm/reach has 4"),
        ({"pictures": {"top": (32, 48)}}, r"the policy has .*images\.top, .*images\.front, observation\.images\.wrist"),
        ({"pictures": {"wrist": (48, 32)}}, r"pictures of wrist .*\(48, 32\).*\(32, 48\)"),
    ],
)
def test_an_environment_that_lacks_an_input_is_refused_by_both_names(change, words, pictured):
    fits = Interface("act", {"observation.state": 4}, {"front": (32, 48)}, 4)
    check_interface(fits, pictured)
    with pytest.raises(MismatchError, match=words):
        check_interface(replace(fits, **change), pictured)


def test_pictures_that_a_policy_fills_in_itself_are_not_asked_for(act):
    empty = {"type": "VISUAL", "shape": [3, 480, 640]}
    edit_config(act, input_features={"observation.images.empty_camera_0": empty})
    assert read_interface(act).pictures == {}
