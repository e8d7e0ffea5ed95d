"""Specs, fingerprints, and folders that appear whole."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.atomic import new_folder, write_file
from manip_il.data.fingerprint import canonical_json, compare_fingerprints, environment_fingerprint
from manip_il.errors import FolderExistsError, ManipError, MismatchError
from manip_il.mdp import Actor


@dataclass(frozen=True)
class Config:
    rate: float = 0.5
    where: Path = Path("a/b")


def test_a_spec_survives_json(spec: s.RobotTaskSpec) -> None:
    assert s.RobotTaskSpec.from_json(spec.to_json()) == spec
    with pytest.raises(ManipError, match="colour"):
        s.RobotTaskSpec.from_json(spec.to_json() | {"colour": "red"})


def test_one_spec_agrees_with_itself_on_another_task(spec: s.RobotTaskSpec) -> None:
    s.check_same_spec("dataset", spec, "policy", dataclasses.replace(spec, task="reach", instruction="Reach."))


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
def test_specs_that_mean_different_things_are_refused_naming_both(
    spec: s.RobotTaskSpec, field: str, value: Any
) -> None:
    with pytest.raises(MismatchError, match=rf"{field} differs: dataset has .*, policy has "):
        s.check_same_spec("dataset", spec, "policy", dataclasses.replace(spec, **{field: value}))


def test_no_column_but_the_label_and_the_observations_reaches_a_policy(spec: s.RobotTaskSpec) -> None:
    visible = [key for key in s.features(spec) if key.startswith(("observation", "action"))]
    assert visible == [s.STATE, s.ENVIRONMENT_STATE, s.ACTION]


def test_a_fingerprint_names_versions_and_hashes_what_it_is_given() -> None:
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
    assert warning.startswith("compiled MuJoCo model differs: dataset has ")
    assert "policy has " in warning


def test_what_one_side_lacks_is_a_difference() -> None:
    warnings = compare_fingerprints("dataset", {"mujoco": "3.11.0"}, "environment", {"mink": "1.3.0"})
    assert warnings == [
        "mujoco differs: dataset has 3.11.0, environment has nothing",
        "mink differs: dataset has nothing, environment has 1.3.0",
    ]


def test_configs_of_many_kinds_have_one_canonical_text() -> None:
    config = {"config": Config(), "actor": Actor.LEARNER, "gains": np.array([1.0, 2.0]), "n": np.int64(3)}
    expected = '{"actor":1,"config":{"rate":0.5,"where":"a/b"},"gains":[1.0,2.0],"n":3}'
    assert canonical_json(config) == expected
    with pytest.raises(ManipError, match="object"):
        canonical_json({"x": object()})


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with new_folder(tmp_path / "deep" / "x") as folder:
        (folder / "a").write_text("1")
        assert not (tmp_path / "deep" / "x").exists()
    assert (tmp_path / "deep" / "x" / "a").read_text() == "1"

    def fail() -> None:
        with new_folder(tmp_path / "y") as folder:
            (folder / "a").write_text("1")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep"]


def test_of_two_writers_of_one_folder_one_wins_whole(tmp_path: Path) -> None:
    def race() -> None:
        with new_folder(tmp_path / "x") as slow:
            (slow / "by").write_text("slow")
            with new_folder(tmp_path / "x") as fast:  # which does not clear away what the other still writes
                (fast / "by").write_text("fast")
            assert (slow / "by").exists()

    with pytest.raises(FolderExistsError):
        race()
    assert [(path.name, (path / "by").read_text()) for path in tmp_path.iterdir()] == [("x", "fast")]


def test_what_a_dead_writer_left_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / ".x.abc.partial").mkdir()
    (tmp_path / ".xy.abc.partial").mkdir()  # another folder's
    with new_folder(tmp_path / "x"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [".xy.abc.partial", "x"]


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    write_file(tmp_path / "x", b"one")
    write_file(tmp_path / "x", b"two")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"two"]
