"""Whatever bytes a dataset's folder holds, the doctor ends with findings."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import write_episode
from manip_il.data.lerobot_write import write_dataset
from manip_il.doctor.finding import Finding, Severity
from manip_il.mdp import Episode

from ..damage import damage_at_random, findings
from ..pictures import numbered_episodes, with_cameras


@pytest.fixture(scope="module")
def whole(
    tmp_path_factory: pytest.TempPathFactory, make_episode: Callable[..., Episode], spec: s.RobotTaskSpec
) -> Path:
    root = tmp_path_factory.mktemp("whole") / "lift"
    seen = with_cameras(spec, "front")
    episodes, fingerprint = numbered_episodes(make_episode, seen), environment_fingerprint(b"", {})
    write_dataset(episodes, root, seen, repo_id="a/b", fingerprint=fingerprint)
    for episode in episodes:
        write_episode(root.with_name("lift.journals"), episode, seen, fingerprint)
    return root.parent


@pytest.mark.parametrize("seed", range(10))
def test_no_damage_stops_the_doctor_and_none_that_counts_goes_unseen(whole: Path, tmp_path: Path, seed: int) -> None:
    assert findings(whole / "lift") == []
    rng = np.random.default_rng(seed)
    for _ in range(20):
        shutil.rmtree(tmp_path / "lift", ignore_errors=True)
        shutil.copytree(whole, tmp_path / "lift", dirs_exist_ok=True)
        way, path = damage_at_random(tmp_path / "lift", rng)
        found = findings(tmp_path / "lift" / "lift")
        assert not any("could not be finished" in finding.text for finding in found), (way, path, found)
        if way in ("cut", "delete"):
            assert found, (way, path)


def test_many_damages_at_once(whole: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shutil.copytree(whole, tmp_path / "torn")
    found: list[Finding] = []
    for _ in range(15):
        damage_at_random(tmp_path / "torn", rng)
        found = findings(tmp_path / "torn" / "lift")
    assert any(finding.severity is Severity.ERROR for finding in found)
    assert not any("could not be finished" in finding.text for finding in found), found
