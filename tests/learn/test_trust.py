"""Nothing that a checkpoint names is fetched or run unless the user says so."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path
from typing import Any

import pytest

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.errors import ManipError
from manip_il.learn.lerobot_config import policy_class, policy_config, policy_types
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.pretrained import _NAMES, PLAIN, require_trust
from manip_il.sim.env import EnvConfig

from .tiny_policies import edit_config

EVIL = {
    "registry_name": "action_tokenizer_processor",
    "config": {"action_tokenizer_name": "evil/tokenizer", "trust_remote_code": True},
}


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
    monkeypatch.setattr(tokenizer_processor, "require_package", lambda *_, **__: None, raising=False)
    for name in ("AutoProcessor", "AutoTokenizer"):
        monkeypatch.setattr(tokenizer_processor, name, Fake, raising=False)
    return calls


def add_step(policy: Path, step: dict[str, Any]) -> None:
    path = policy / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    values["steps"].append(step)
    path.write_text(json.dumps(values))


def test_a_step_that_loads_by_name_runs_only_where_it_is_trusted(act, ran):
    add_step(act, EVIL)
    with pytest.raises(ManipError, match=r"action_tokenizer_processor.*evil/tokenizer.*add --trust=true") as caught:
        LearnedPolicy.load(act)
    assert "\n" not in str(caught.value)
    assert ran == []
    LearnedPolicy.load(act, trust=True)
    assert ran[0] == ("evil/tokenizer", {"trust_remote_code": True})


def test_a_worker_trusts_only_what_its_job_does(act, ran):
    add_step(act, EVIL)
    edit_config(act, input_features={"observation.state": {"type": "STATE", "shape": [8]}})
    job = RolloutJob(EnvConfig("panda", "reach", horizon=8), PolicyDriver((act,)), label="last")
    with pytest.raises(ManipError, match="--trust=true"):
        list(pickle.loads(pickle.dumps(job)).run([0]))
    assert ran == []
    with pytest.raises(ManipError) as caught:  # sizes that do not belong together are found after all is allowed
        list(
            pickle.loads(
                pickle.dumps(dataclasses.replace(job, driver=dataclasses.replace(job.driver, trust=True)))
            ).run([0])
        )
    assert "--trust" not in str(caught.value)


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ({"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil/x"}}, "tokenizer_name='evil/x'"),
        ({"registry_name": "groot_n1_7_pack_inputs_v1", "config": {}}, "groot_n1_7_pack_inputs_v1"),
        ({"registry_name": "device_processor", "config": {"hook": "evil"}}, "hook='evil'"),
        ({"registry_name": "x" * 90, "config": {"y" * 10_000: "z" * 10_000}}, "xxx"),
    ],
)
def test_only_the_steps_and_options_of_the_policys_own_processors_are_loaded(step, words, act):
    add_step(act, step)
    with pytest.raises(ManipError, match="--trust=true") as caught:
        LearnedPolicy.load(act)
    assert words in str(caught.value)
    assert len(str(caught.value)) < 1_000


@pytest.mark.parametrize("trust", [False, True])
def test_a_step_by_its_import_path_is_refused_in_any_case(trust, act):
    add_step(act, {"class": "subprocess.Popen", "config": {"args": "true"}})
    with pytest.raises(ManipError, match=r"subprocess\.Popen"):
        LearnedPolicy.load(act, trust=trust)


@pytest.mark.parametrize("name", ["../secret.safetensors", "/etc/secret", "sub/x.safetensors", "missing.safetensors"])
def test_statistics_lie_in_the_policys_folder(name, act):
    (act.parent / "secret.safetensors").write_bytes((act / "model.safetensors").read_bytes())
    add_step(act, {"registry_name": "normalizer_processor", "config": {}, "state_file": name})
    with pytest.raises(ManipError, match=r"policy_preprocessor\.json cannot be read"):
        LearnedPolicy.load(act, trust=True)


@pytest.mark.parametrize("kind", policy_types())
def test_every_policy_of_lerobots_is_plain_or_needs_trust(kind):
    options = [field.name for field in dataclasses.fields(policy_class(kind))]
    assert set(_NAMES.get(kind, ())) <= set(options)
    assert kind not in PLAIN or not any(name.endswith(("model_name", "tokenizer_name")) for name in options)
    settings = {"type": kind}
    if kind in PLAIN:
        require_trust(settings, "x", trust=False)
    else:
        with pytest.raises(ManipError, match=rf"'{kind}' that would load models.*--trust=true"):
            require_trust(settings, "x", trust=False)
    for name in _NAMES.get(kind, ()):
        with pytest.raises(ManipError, match=rf"{name}='evil/model'"):
            require_trust(settings | {name: "evil/model"}, "x", trust=False)
    require_trust(settings, "x", trust=True)


def test_an_encoder_that_a_checkpoint_names_is_made_only_where_it_is_trusted(tmp_path):
    settings = {"type": "gaussian_actor", "vision_encoder_name": "evil/encoder"}
    (tmp_path / "config.json").write_text(json.dumps(settings | {"input_features": {}, "output_features": {}}))
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(ManipError, match=r"--policy\.path.*vision_encoder_name='evil/encoder'.*--trust=true"):
        policy_config({"path": str(tmp_path)})
    assert policy_config({"path": str(tmp_path)}, trust=True).type == "gaussian_actor"
    with pytest.raises(ManipError, match=r"--policy\.type=gaussian_actor.*vision_encoder_name='evil/encoder'"):
        policy_config(settings)
