"""A folder from anywhere: what it says is checked before anything of it is loaded, and nothing
that it names runs.
"""

from __future__ import annotations

import dataclasses
import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.checkpoint import Checkpoint, Origin, require_trust
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import policy_class, policy_config, policy_types
from manip_il.learn.names import PLAIN
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import Trainer
from manip_il.worlds.table import make_config

from .tiny_policies import ACT, CNN, edit_config, observations, refused, write_checkpoint

EVIL = {
    "registry_name": "action_tokenizer_processor",
    "config": {"action_tokenizer_name": "evil/tokenizer", "trust_remote_code": True},
}


def test_what_a_policy_sees_gives_and_is_for_is_read_without_loading_it(pictured, tmp_path):
    origin = Origin.of(
        pictured,
        {"mujoco": "3"},
        {"steps": 2},
        observation="both",
        look={},
        action_space="joint_target",
    )
    folder = write_checkpoint(tmp_path / "policy", "act", pictured, "both", origin=origin)
    (folder / "model.safetensors").write_bytes(b"")
    found = Checkpoint.open(folder)
    assert (found.kind, found.observation, found.action, found.space) == (
        "act",
        "both",
        4,
        "joint_target",
    )
    assert found.numbers == {"observation.state": 4, "observation.environment_state": 6}
    assert found.pictures == {"front": (32, 48), "wrist": (32, 48)}
    assert found.origin == origin
    found.check_fits(pictured)
    placeholder = {"observation.images.empty_camera_0": {"type": "VISUAL", "shape": [3, 48, 64]}}
    edit_config(folder, input_features=placeholder)
    assert Checkpoint.open(folder).pictures == {}  # LeRobot fills it in itself


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"numbers": {"observation.state": 5}},
            r"observation\.state .*the policy has 5, arm/reach has 4",
        ),
        ({"action": 7}, r"action differs: the policy has 7, arm/reach has 4"),
        (
            {"pictures": {"top": (32, 48)}},
            r"images\.top .*the policy has \(32, 48\), arm/reach has None",
        ),
        (
            {"robot": "leg"},
            r"robot of the inverse kinematics.*the policy has leg, arm/reach has arm",
        ),
    ],
)
def test_an_environment_that_lacks_an_input_is_refused_by_both_names(change, words, act, pictured):
    with pytest.raises(MismatchError, match=words):
        replace(Checkpoint.open(act), **change).check_fits(pictured)


def test_a_policy_for_something_else_is_refused_naming_both(act, spec):
    with pytest.raises(MismatchError, match=r"fps differs: the policy has 25, .* has 50"):
        Checkpoint.open(act).check_fits(replace(spec, fps=50))


@pytest.mark.parametrize(
    "settings", [{"type": "mlp", "width": 8}, ACT, CNN], ids=lambda one: str(one["type"])
)
def test_a_checkpoint_acts_and_is_gone_on_from_where_its_dataset_is_not(
    settings, write, table, pictured, tmp_path
):
    spec = replace(pictured, cameras=("front",))
    data = write(table, "gone", spec)
    path = Trainer(data, FitConfig(settings, steps=2, batch_size=8), tmp_path / "run").fit()
    seen = *observations(3), {"front": np.zeros((3, 32, 48, 3), np.uint8)}
    expected = LearnedPolicy.load(path).act(*seen)
    elsewhere = Path(shutil.copytree(path, tmp_path / "elsewhere"))
    shutil.rmtree(data[0].root)
    shutil.rmtree(tmp_path / "run")
    assert np.array_equal(LearnedPolicy.load(elsewhere).act(*seen), expected)
    more = FitConfig({"path": str(elsewhere)}, steps=1, batch_size=8)
    assert Trainer(write(table, "other", spec), more, tmp_path / "more").fit().is_dir()


class Bomb:
    """Says that it was unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.mark.parametrize("name", ["pytorch_model.bin", "optimizer.pt", "rng.pkl"])
def test_a_pickle_beside_a_policy_is_not_opened(name, act, tmp_path):
    mark = tmp_path / "opened"
    (act / name).write_bytes(pickle.dumps(Bomb(mark)))
    LearnedPolicy.load(act)
    (act / "model.safetensors").unlink()
    refused(act, "the weights are missing")
    assert not mark.exists()


@pytest.fixture
def ran(monkeypatch) -> list[tuple[Any, ...]]:
    """What has been loaded by name, from a machine on which `transformers` is installed."""
    from lerobot.processor import tokenizer_processor

    calls: list[tuple[Any, ...]] = []

    class Fake:
        @classmethod
        def from_pretrained(cls, name: str, **options: Any) -> Fake:
            calls.append((name, options))
            return cls()

        def __call__(self, *_: Any) -> list[list[int]]:
            return [[0]]

    monkeypatch.setattr(tokenizer_processor, "_transformers_available", True)
    monkeypatch.setattr(
        tokenizer_processor, "require_package", lambda *_, **__: None, raising=False
    )
    for name in ("AutoProcessor", "AutoTokenizer"):
        monkeypatch.setattr(tokenizer_processor, name, Fake, raising=False)
    return calls


def add_step(policy: Path, step: Any) -> None:
    path = policy / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    values["steps"].append(step)
    path.write_text(json.dumps(values))


def test_a_step_that_loads_by_name_runs_only_where_it_is_trusted(act, ran):
    add_step(act, EVIL)
    refused(act, r"action_tokenizer_processor.*evil/tokenizer.*add --trust=true")
    assert ran == []
    LearnedPolicy.load(act, trust=True)
    assert ran[0] == ("evil/tokenizer", {"trust_remote_code": True})


def test_a_worker_trusts_only_what_its_job_does(act, ran):
    add_step(act, EVIL)
    edit_config(act, input_features={"observation.state": {"type": "STATE", "shape": [8]}})
    edit_config(act, output_features={"action": {"type": "ACTION", "shape": [8]}})
    (act / "manip_il.json").unlink()
    job = RolloutJob(make_config("panda", "reach", horizon=8), PolicyDriver.of(act), label="last")
    with pytest.raises(ManipError, match="--trust=true"):
        list(pickle.loads(pickle.dumps(job)).run([0]))
    assert ran == []
    trusting = replace(job, driver=replace(job.driver, trust=True))
    # sizes that do not belong together are found after all is allowed
    with pytest.raises(ManipError) as caught:
        list(pickle.loads(pickle.dumps(trusting)).run([0]))
    assert "--trust" not in str(caught.value)


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (
            {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil/x"}},
            "--trust=true",
        ),
        ({"registry_name": "groot_n1_7_pack_inputs_v1", "config": {}}, "--trust=true"),
        ({"class": "subprocess.Popen", "config": {"args": "true"}}, r"subprocess\.Popen"),
        (
            {
                "registry_name": "normalizer_processor",
                "config": {},
                "state_file": "missing.safetensors",
            },
            "cannot load it",
        ),
    ],
)
def test_a_processor_loads_registered_steps_alone(step, words, act):
    add_step(act, step)
    refused(act, words)
    if "trust" not in words:
        with pytest.raises(ManipError, match=words):
            LearnedPolicy.load(act, trust=True)


@pytest.mark.parametrize("kind", policy_types())
def test_every_policy_of_lerobots_is_plain_or_needs_trust(kind):
    options = [field.name for field in dataclasses.fields(policy_class(kind))]
    assert kind not in PLAIN or not any(
        name.endswith(("model_name", "tokenizer_name")) for name in options
    )
    settings = {"type": kind}
    if kind in PLAIN:
        require_trust(settings, "x", trust=False)
    else:
        with pytest.raises(ManipError, match=rf"'{kind}', whose configuration .*--trust=true"):
            require_trust(settings, "x", trust=False)
    require_trust(settings, "x", trust=True)


def test_an_encoder_that_a_checkpoint_names_is_made_only_where_it_is_trusted(act):
    edit_config(act, type="gaussian_actor", vision_encoder_name="evil/encoder")
    for settings, source in (
        ({"path": str(act)}, r"--policy\.path"),
        (
            {"type": "gaussian_actor", "vision_encoder_name": "evil/encoder"},
            r"--policy\.type=gaussian_actor",
        ),
    ):
        with pytest.raises(ManipError, match=rf"{source}.*evil/encoder.*--trust=true"):
            policy_config(FitConfig(settings))
    allowed = FitConfig(
        {"type": "gaussian_actor", "vision_encoder_name": "evil/encoder"}, trust=True
    )
    assert policy_config(allowed).type == "gaussian_actor"


HUGE = [
    *({"width": 60_000}, {"depth": 10**6}, {"bins": 10**6}, {"components": 10**6}),
    {"scales": [1.0] * 1000, "scaled": [0] * 1000},
    {"input_features": {"observation.state": {"type": "STATE", "shape": [10**9]}}},
]
HUGE_CNN = [
    *({"keypoints": 10**6}, {"channels": [8, 10**6]}, {"channels": [8] * 10**4}),
    *({"privileged_size": 10**9}, {"named_points": 10**9}),
]


@pytest.mark.parametrize(
    ("kind", "change"),
    [*(("mlp", one) for one in HUGE), *(("cnn", one) for one in HUGE + HUGE_CNN)],
    ids=str,
)
def test_a_networks_numbers_have_the_bounds_of_its_options(kind, change, pictured, tmp_path):
    options, seen = (CNN, "images") if kind == "cnn" else ({}, "state")
    folder = write_checkpoint(tmp_path / "policy", kind, pictured, seen, **options)
    edit_config(folder, **change)
    refused(folder, "; expected", longest=700)
