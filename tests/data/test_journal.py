"""One file an episode: whole and bit for bit, or refused by name."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import journal
from manip_il.data import schema as s
from manip_il.errors import ManipError
from manip_il.mdp import Episode

from ..mcap.use import decoded
from ..pictures import numbered_episodes, with_cameras
from ..synthetic import MakeEpisode

FINGERPRINT = {"mujoco": "3.11.0", "model_sha256": "ab" * 32}
HERE = Path(__file__).parent


def assert_same(left: Episode, right: Episode) -> None:
    assert (left.seed, left.success, left.success_at_end) == (
        right.seed,
        right.success,
        right.success_at_end,
    )
    assert list(left.columns) == list(right.columns)
    for key, values in right.columns.items():
        mine = left.columns[key]
        assert (mine.dtype, mine.shape) == (values.dtype, values.shape)
        assert mine.tobytes() == values.tobytes()  # bits: a minus zero is one


def test_an_episode_comes_back_with_its_header_and_gives_the_same_bytes_again(
    tmp_path, episodes, spec
):
    for count, episode in enumerate(episodes, start=1):
        path = journal.Journal(tmp_path / "new" / "folder", spec, FINGERPRINT).write(episode)
        assert_same(journal.read_journal(path)[1], episode)
        assert journal.read_journal(path)[0] == journal.Journal(path.parent, spec, FINGERPRINT)
        again = journal.Journal(tmp_path / "again", spec, FINGERPRINT).write(episode)
        assert again.read_bytes() == path.read_bytes()
        assert len(list((tmp_path / "again").iterdir())) == count


@pytest.fixture
def path(tmp_path: Path, make_episode: MakeEpisode, spec: s.EnvironmentSpec) -> Path:
    return journal.Journal(tmp_path, spec, FINGERPRINT).write(make_episode(17, 4))


@pytest.fixture
def filmed(tmp_path: Path, make_episode: MakeEpisode, spec: s.EnvironmentSpec) -> Path:
    spec = with_cameras(spec, "front", "wrist")
    return journal.Journal(tmp_path / "filmed", spec, FINGERPRINT).write(
        numbered_episodes(make_episode, spec)[0]
    )


def test_pictures_come_back_bit_for_bit(filmed, make_episode, spec):
    written = numbered_episodes(make_episode, with_cameras(spec, "front", "wrist"))[0]
    columns = journal.read_journal(filmed)[1].columns
    for key in (s.IMAGES + "front", s.IMAGES + "wrist"):
        np.testing.assert_array_equal(columns[key], written.columns[key])


def test_a_file_cut_short_is_refused_by_name(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ManipError, match=r"episode-000000000017\.mcap is not a complete episode"):
        journal.read_journal(path)


def test_foxglove_sees_joints_and_scalars(tmp_path, make_episode, spec):
    episode = make_episode(8, 3)
    topics: dict[str, list[tuple[int, Any]]] = {}
    path = journal.Journal(tmp_path, spec, {}).write(episode)
    for topic, time, message in decoded(path.read_bytes()):
        topics.setdefault(topic, []).append((time, message))
    assert sorted(topics) == ["/action", "/executed_action", "/joint_states", "/scalars"]
    assert [time for time, _ in topics["/scalars"]] == [0, 50_000_000, 100_000_000]
    _, last = topics["/joint_states"][2]
    assert last.timestamp.ToNanoseconds() == 100_000_000
    assert [joint.name for joint in last.joints] == list(spec.joint_names)
    assert [joint.position for joint in last.joints] == episode.columns[s.STATE][2].tolist()
    scalars = {scalar["label"]: scalar["value"] for scalar in topics["/scalars"][2][1]["scalars"]}
    assert scalars[s.SUCCESS] == 1
    assert scalars[s.REWARD] == episode.columns[s.REWARD][2].item()
    assert scalars[s.EXPERT_PHASE] == episode.columns[s.EXPERT_PHASE][2]


_RECORDER = """
import sys
from pathlib import Path
import numpy as np
from manip_il.data import journal, schema
from manip_il.mdp import Episode
spec = schema.EnvironmentSpec("r", "t", 20, ("a", "b"), ("ee.x",), 1, "")
for seed in range(100_000):
    columns = {schema.ACTION: np.full((50, 2), seed, np.float32), schema.SIM_STATE: np.full((50, 60), seed, np.float64)}
    journal.Journal(Path(sys.argv[1]), spec, {}).write(Episode(seed, columns, True, True))
    print(seed, flush=True)
"""


def test_a_killed_recorder_loses_no_finished_episode(tmp_path):
    command = [sys.executable, "-c", _RECORDER, str(tmp_path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=HERE.parents[1]
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "0\n"
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.0017)
        os.kill(process.pid, signal.SIGKILL)
        told = [0, *(int(line) for line in process.stdout.read().split())]
    found = journal.list_episodes(tmp_path)
    assert [journal.read_journal(path)[1].seed for path in found] == list(range(len(found)))
    assert len(found) >= len(told)
    (tmp_path / ".episode-000000000007.mcap.x1y2.partial").write_bytes(b"half")
    journal.Journal(tmp_path, journal.read_journal(found[0])[0].spec, {}).prepare()
    assert sorted(tmp_path.iterdir()) == found
