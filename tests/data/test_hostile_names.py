"""Names from journals and datasets never lead out of the folder that they stand in."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.checks import LONGEST_NAME
from manip_il.cli.main import main
from manip_il.data import journal
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError

from ..damage import digests, edit_json
from ..pictures import numbered_episodes, with_cameras, write
from ..synthetic import MakeEpisode

HOSTILE = "x/../../../victim/videos/observation.images.front"
FRONT = s.IMAGES + "front"


@pytest.fixture(scope="module")
def seen(spec: s.EnvironmentSpec) -> s.EnvironmentSpec:
    return with_cameras(spec, "front")


@pytest.fixture(scope="module")
def filmed_once(
    tmp_path_factory: pytest.TempPathFactory, make_episode: MakeEpisode, seen: s.EnvironmentSpec
) -> Path:
    return write(
        numbered_episodes(make_episode, seen), tmp_path_factory.mktemp("filmed") / "victim", seen
    )


@pytest.fixture
def victim(tmp_path: Path, filmed_once: Path) -> Path:
    shutil.copytree(filmed_once, tmp_path / "victim")
    return tmp_path / "victim"


@pytest.fixture
def attack(
    tmp_path: Path,
    make_episode: MakeEpisode,
    seen: s.EnvironmentSpec,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """Journals whose only camera has a path for its name."""
    plain = numbered_episodes(make_episode, seen, 1)[0]
    columns = {
        key.replace(FRONT, s.IMAGES + HOSTILE): column for key, column in plain.columns.items()
    }
    with monkeypatch.context() as patch:  # a spec that another program made up: nothing checks it
        patch.setattr(s.EnvironmentSpec, "__post_init__", lambda self: None)
        spec = replace(seen, cameras=(HOSTILE,))
    journal.Journal(tmp_path / "lift.journals", spec, {}).write(replace(plain, columns=columns))
    return tmp_path / "lift.journals"


def test_a_camera_named_as_a_path_overwrites_no_other_dataset(attack, victim, capsys):
    before = digests(victim)
    assert main(["data", "build", str(attack), str(attack.with_name("lift"))]) == 1
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    assert "a camera is 'x/../../../victim" in error
    assert digests(victim) == before
    assert not attack.with_name("lift").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"robot": "../panda"}, "robot is '../panda'"),
        ({"task": "x" * (LONGEST_NAME + 1)}, "task is 'xxx"),
        ({"cameras": ["front\n"]}, "a camera is 'front\\n'"),
    ],
)
def test_a_spec_refuses_what_it_cannot_be(spec, change, words):
    with pytest.raises(ManipError) as error:
        s.EnvironmentSpec.from_json(spec.to_json() | change)
    assert words in str(error.value)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"video_path": "../victim/{chunk_index:03d}/{file_index:03d}.mp4"}, "video_path is"),
        ({"video_path": f"{layout.VIDEO_PATH}\n"}, "video_path is 'videos/"),
        (
            {"data_path": "../victim/{chunk_index:03d}/{file_index:03d}.parquet"},
            f"expected '{layout.DATA_PATH}'",
        ),
        (
            {"features": {"../../secret": {"dtype": "video", "shape": [8, 8, 3]}}},
            "a feature is '../../secret'",
        ),
    ],
)
def test_what_info_says_is_checked_by_its_reader(victim, change, words):
    edit_json(victim / layout.INFO, lambda info: info.update(change))
    with pytest.raises(ManipError) as error:
        Dataset.open(victim)
    assert words in str(error.value)
