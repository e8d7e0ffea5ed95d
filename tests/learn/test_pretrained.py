"""A folder that cannot be used is refused in one line before anything of it is loaded."""

from __future__ import annotations

import json
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


def test_a_folder_without_weights_says_what_is_missing(act):
    (act / "model.safetensors").rename(act / "adapter_model.safetensors")
    refused(act, r"no model\.safetensors in .*adapter")
    (act / "adapter_model.safetensors").unlink()
    refused(act, r"no model\.safetensors in .*weights are missing")
    (act / "config.json").unlink()
    refused(act, r"no config\.json in")


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


def test_features_that_cannot_be_read_are_refused(act):
    edit_config(act, input_features={"observation.images.front": {"type": "VISUAL", "shape": [3, 32]}})
    with pytest.raises(ManipError, match="features that cannot be read"):
        read_interface(act)
    edit_config(act, output_features={"move": {"type": "ACTION", "shape": [4]}})
    with pytest.raises(ManipError, match="features that cannot be read"):
        read_interface(act)


def test_a_downloaded_processor_cannot_name_code_to_run(act):
    path = act / "policy_preprocessor.json"
    path.write_text(json.dumps({"name": "x", "steps": [{"class": "subprocess.Popen", "config": {"args": "true"}}]}))
    refused(act, r"subprocess\.Popen")
    path.write_text("[")
    refused(act, r"policy_preprocessor\.json is not valid JSON")
    path.unlink()
    refused(act, r"no .*policy_preprocessor\.json")


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


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_file_of_another_user_is_said_to_be_that_and_not_missing(name, act, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: Path(path).name != name)
    refused(act, rf"{name} may not be read by this user \(uid \d+\); run as its owner")
