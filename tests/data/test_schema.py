"""Specs and fingerprints: what two sides must share, and how they say so."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import MismatchError
from manip_il.worlds import fingerprint
from manip_il.worlds.fingerprint import canonical_json, environment_fingerprint


@dataclass(frozen=True)
class Config:
    rate: float = 0.5


def test_a_spec_survives_json(spec):
    assert s.EnvironmentSpec.from_json(spec.to_json()) == spec


def test_one_spec_agrees_with_itself_on_another_task(spec):
    s.check_same_spec(
        "dataset", spec, "policy", dataclasses.replace(spec, task="reach", instruction="Reach.")
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("robot", "fetch"),
        ("fps", 30),
        ("joint_names", ("elbow", "shoulder", "gripper")),
        ("environment_state_names", ("ee.x",)),
        ("action_meaning", "joint velocities [rad/s]"),
    ],
)
def test_specs_that_mean_different_things_are_refused_naming_both(spec, field, value):
    with pytest.raises(MismatchError, match=rf"{field} differs: dataset has .*, policy has "):
        s.check_same_spec("dataset", spec, "policy", dataclasses.replace(spec, **{field: value}))


def test_no_column_but_the_label_and_the_observations_reaches_a_policy(spec):
    visible = [key for key in s.features(spec) if key.startswith(("observation", "action"))]
    assert visible == [s.STATE, s.ENVIRONMENT_STATE, s.ACTION]


def test_a_fingerprint_names_versions_and_hashes_what_it_is_given():
    print_ = environment_fingerprint(b"model", {"b": 1, "a": [1, 2]})
    assert print_["numpy"] == np.__version__
    assert set(print_) == {
        *("python", "manip_il", "mujoco", "mink", "lerobot", "torch", "numpy", "processor"),
        *("model_sha256", "config_sha256"),
    }
    assert environment_fingerprint(b"model", {"a": (1, 2), "b": 1}) == print_  # order means nothing
    other = environment_fingerprint(b"other", {"b": 1, "a": [1, 2]})
    assert compare_fingerprints("dataset", print_, "policy", print_) == []
    (warning,) = compare_fingerprints("dataset", print_, "policy", other)
    assert warning.startswith("model_sha256 differs: dataset has ")
    assert "policy has " in warning


def test_configs_have_one_canonical_text():
    assert (
        canonical_json({"gains": (1.0, 2.0), "config": Config()})
        == '{"config":{"rate":0.5},"gains":[1.0,2.0]}'
    )
    with pytest.raises(TypeError, match="dataclass"):
        canonical_json({"x": object()})


def test_two_makers_processors_with_the_same_extensions_have_two_fingerprints(
    tmp_path, monkeypatch
):
    found = []
    for maker, family, model in (("GenuineIntel", 6, 143), ("AuthenticAMD", 25, 17)):
        said = f"processor : 0\nvendor_id : {maker}\ncpu family : {family}\nmodel : {model}\n"
        (tmp_path / "cpuinfo").write_text(said)
        monkeypatch.setattr(fingerprint, "_CPU_INFO", tmp_path / "cpuinfo")
        found.append(fingerprint.processor.__wrapped__())
    assert len(set(found)) == 2
