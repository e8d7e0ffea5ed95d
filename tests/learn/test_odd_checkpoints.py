"""Odd values in a checkpoint's files: each is one clear line, found before memory or time is spent."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import draccus
import pytest

from manip_il.errors import ManipError, UsageError
from manip_il.learn.checkpoint import read_meta
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import policy_config
from manip_il.learn.limits import check_numbers
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.pretrained import PLAIN
from manip_il.learn.train import fit

from .tiny_policies import edit_config, observations, refused

DEEP = "[" * 100_000
TINY = FitConfig({"width": 8, "depth": 1}, steps=2, batch_size=8)


@pytest.fixture
def mlp(table, spec, tmp_path) -> Path:
    return fit(table, TINY, tmp_path / "run", spec=spec)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": 10**9}, "depth is 1000000000; expected a whole number from 1 to 100"),
        ({"depth": 2**80}, "depth is 1208925819614629174706176"),
        ({"width": 10**9}, "width is 1000000000"),
        ({"width": "256"}, "width is '256'; expected a whole number"),
        ({"width": 16_384, "depth": 100}, "much larger network than its weights"),
        ({"loss": {}}, "loss is {}; expected text"),
        ({"loss": "categorical", "bins": 10**9}, "bins is 1000000000"),
        ({"loss": "categorical", "bins": None}, "bins is None"),
        ({"loss": "mixture", "components": 10**9}, "components is 1000000000"),
        ({"activation": ["silu"]}, "activation is"),
        ({"activation": "sqrt"}, "unknown activation 'sqrt'"),
        ({"clamp": "10"}, "clamp is '10'"),
        ({"sigma": "3"}, "sigma is '3'"),
        ({"sigma": -1}, "sigma is -1; expected a finite number from 0 to 100"),
        ({"clamp": 0}, "clamp is 0; expected more than 0"),
        ({"input_features": {"observation.state": {"type": "STATE", "shape": [10**9]}}}, "a side of observation.state"),
        ({"input_features": {"observation.state": {"type": "STATE", "shape": ["4"]}}}, "a side of observation.state"),
        ({"input_features": {"observation.state": {"type": {}, "shape": [4]}}}, "type of observation.state"),
        ({"input_features": {"observation.state": 4}}, "expected an object"),
        ({"output_features": {"action": {"type": "ACTION", "shape": 4}}}, "shape of action"),
        (
            {"input_features": {"observation.images.front": {"type": "VISUAL", "shape": [3, 32]}}},
            "features that cannot be read",
        ),
        ({"output_features": {"move": {"type": "ACTION", "shape": [4]}}}, "features that cannot be read"),
        ({"width": 32}, "do not match"),
        ({"input_features": {f"x{i}": {"type": "STATE", "shape": [1]} for i in range(1_000)}}, "1000 features"),
    ],
)
def test_an_mlps_config(changes, words, mlp):
    edit_config(mlp, **changes)
    refused(mlp, words)


def test_an_mlps_config_that_lacks_something(mlp):
    values = json.loads((mlp / "config.json").read_text())
    del values["width"]
    (mlp / "config.json").write_text(json.dumps(values))
    refused(mlp, r"config\.json has no width")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"n_encoder_layers": 10**9}, "n_encoder_layers is 1000000000; expected a whole number"),
        ({"n_encoder_layers": 9_999}, "much larger network than its weights"),
        ({"dim_model": 10_000, "dim_feedforward": 10_000}, "much larger network than its weights"),
        ({"dim_model": "wide"}, "dim_model"),
        ({"dim_model": [[[10**9]]]}, "dim_model is 1000000000"),
        ({"chunk_size": -5}, "LeRobot cannot load it"),
        ({"vision_backbone": None}, "LeRobot cannot load it"),
        ({"vision_backbone": "x" * 20_000}, "vision_backbone is"),
        ({"normalization_mapping": 3}, "LeRobot cannot load it"),
        ({"dropout": "lots"}, "LeRobot cannot load it"),
        ({"no_such_option": 3}, r"LeRobot cannot load it.*no_such_option"),
        ({"dim_model": 32}, "do not match"),
    ],
)
def test_a_config_of_a_policy_of_lerobots(changes, words, act):
    edit_config(act, **changes)
    refused(act, words, longest=600)


@pytest.mark.parametrize("kind", PLAIN)
def test_lerobots_defaults_are_within_the_bounds(kind):
    settings = cast(dict[str, Any], draccus.encode(policy_config({"type": kind, "device": "cpu"})))
    check_numbers(settings, "x")
    with pytest.raises(ManipError, match="depth is 10001"):
        check_numbers(settings | {"depth": 10_001}, "x")


@pytest.mark.parametrize("changes", [{"dim_model": 10**9}, {"n_encoder_layers": 10**9}])
def test_a_start_from_a_checkpoint_has_the_same_bounds(changes, act):
    edit_config(act, **changes)
    with pytest.raises(ManipError, match="expected a whole number from"):
        policy_config({"path": str(act)})


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"type": "mlp", "depth": 10**9}, r"policy\.depth is 1000000000; expected a whole number from 1 to 100"),
        ({"type": "mlp", "width": 0}, r"policy\.width is 0"),
        ({"type": "mlp", "clamp": -1}, r"policy\.clamp is -1"),
        ({"type": "cnn", "keypoints": 10**9}, r"policy\.keypoints is 1000000000"),
        ({"type": "cnn", "channels": [16]}, r"policy\.channels is \[16\]; expected at least two layers"),
        ({"type": "cnn", "channels": [16, 10**9]}, r"policy\.channels is 1000000000"),
        ({"type": "cnn", "channels": [16] * 100}, r"policy\.channels is .*at most 32"),
        ({"type": "cnn", "aux_weight": -1}, r"policy\.aux_weight is -1"),
        ({"type": "cnn", "privileged_size": 10**9}, r"policy\.privileged_size is 1000000000"),
        ({"type": "cnn", "depth": 10**9}, r"policy\.depth is 1000000000"),
    ],
)
def test_options_of_our_own_policies_are_bounded_where_they_are_made(settings, words):
    with pytest.raises(UsageError, match=words):
        policy_config(settings | {"device": "cpu"})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": "20"}, "fps is '20'; expected a whole number"),
        ({"fps": 10**30}, "fps is"),
        ({"fingerprint": None}, "fingerprint is None; expected an object"),
        ({"fingerprint": {str(i): i for i in range(2_000)}}, "fingerprint has 2000 entries"),
        ({"robot": "../../x"}, "robot is"),
        ({"task": None}, "task is None"),
        ({"joint_names": 5}, "joint_names is 5; expected a list"),
        ({"joint_names": [[["a"]]]}, "one of joint_names is"),
        ({"cameras": "front"}, "cameras is 'front'; expected a list"),
        ({"image_size": [1, 2, 3]}, "image_size is"),
        ({"image_size": [1, "x"]}, "a side of image_size is 'x'"),
        ({"look": []}, "look is"),
        ({"options": 7}, "options is 7"),
        ({"colour": "red"}, "unexpected 'colour'"),
    ],
)
def test_what_a_policy_was_trained_for(changes: dict[str, Any], words, act):
    path = act / "manip_il.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ManipError, match=rf"manip_il\.json cannot be read \(.*{words}"):
        read_meta(act)


@pytest.mark.parametrize("text", [DEEP, "", "null", '{"robot": "panda"}', '{"fps": NaN}'])
def test_what_a_policy_was_trained_for_that_is_no_json_of_ours(text, act):
    (act / "manip_il.json").write_text(text)
    refused(act, r"manip_il\.json")


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (None, "steps is None"),
        ("x", "steps is 'x'"),
        ([5], "a step is 5"),
        ([{"registry_name": 5}], "registry_name is 5"),
        ([{"registry_name": "device_processor", "config": []}], "config is"),
        ([{"registry_name": "to_batch_processor", "config": {}}] * 1_000, "at most 100"),
    ],
)
def test_a_processors_file(steps, words, act):
    path = act / "policy_postprocessor.json"
    path.write_text(json.dumps({"name": "x", "steps": steps}))
    refused(act, rf"policy_postprocessor\.json cannot be read: .*{words}")


@pytest.mark.parametrize(("text", "words"), [(DEEP, "nested too deeply"), ("[", r"json is not valid JSON")])
def test_a_processors_file_that_is_no_json(text, words, act):
    (act / "policy_preprocessor.json").write_text(text)
    refused(act, words)


@pytest.mark.parametrize(
    "changes",
    [{"eps": "small"}, {"features": 5}, {"features": {"action": {"type": "DANCE", "shape": [4]}}}, {"norm_map": 3}],
)
def test_odd_options_of_a_normaliser_are_found_before_the_first_episode(changes, act):
    path = act / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    [step] = [step for step in values["steps"] if step["registry_name"] == "normalizer_processor"]
    step["config"] |= changes
    path.write_text(json.dumps(values))
    with pytest.raises(ManipError, match=r"LeRobot cannot load it|the policy cannot act"):
        LearnedPolicy.load(act).act(*observations(1))


def header(table: Any, length: int | None = None) -> bytes:
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01",
        header({}, length=2**60),
        header(b"[]"),
        header(b"{" * 10_000),
        header({"x": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}),
        header({"x": {"dtype": "F32", "shape": [2**63], "data_offsets": [0, 4]}}) + b"0000",
        header({"x": {"dtype": "Q7", "shape": [1], "data_offsets": [0, 4]}}) + b"0000",
        header({"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}) + b"0000",
    ],
)
@pytest.mark.parametrize("kind", ["mlp", "act"])
def test_weights_that_are_broken_or_of_another_network(data, kind, request):
    policy = request.getfixturevalue(kind)
    (policy / "model.safetensors").write_bytes(data)
    refused(policy, r"model\.safetensors cannot be read|do not match")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (DEEP, "nested too deeply"),
        ('{"step": null}', "step is None"),
        ('{"step": "2"}', "step is '2'"),
        ('{"step": 1e300}', "step is 1e"),
        ('{"step": 2, "data": {}, "options": 5}', "training data differs"),
        ("[]", "expected an object"),
    ],
)
def test_a_step_that_is_none_is_not_resumed(text, words, mlp, table, spec):
    run = mlp.parents[2]
    (mlp.parent / "training_state" / "training_step.json").write_text(text)
    with pytest.raises(ManipError, match=words):
        fit(table, replace(TINY, steps=4), run, spec=spec, resume=True)


@pytest.mark.parametrize("name", ["optimizer_state.safetensors", "optimizer_param_groups.json"])
@pytest.mark.parametrize("data", [b"", b"[[[", b'{"x": 5}', header({"state": 5})])
def test_an_optimiser_that_is_broken_is_not_resumed(name, data, mlp, table, spec):
    run = mlp.parents[2]
    (mlp.parent / "training_state" / name).write_bytes(data)
    with pytest.raises(ManipError, match=r"cannot be resumed .*--overwrite=true"):
        fit(table, TINY, run, spec=spec, resume=True)


@pytest.mark.parametrize("line", [DEEP, '{"step": "1"}', '{"step": 1e400}', '{"step": [1]}', "null", "\x00"])
def test_lines_of_metrics_that_are_none_are_dropped_on_resuming(line, mlp, table, spec):
    run = mlp.parents[2]
    good = (run / "metrics.jsonl").read_text()
    (run / "metrics.jsonl").write_text(f"{line}\n{good}")
    fit(table, TINY, run, spec=spec, resume=True)
    assert (run / "metrics.jsonl").read_text() == good
