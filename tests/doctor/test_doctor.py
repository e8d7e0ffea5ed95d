"""The doctor: a whole dataset is clean, and every kind of damage is found and named."""

from __future__ import annotations

import dataclasses
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from av.video.stream import VideoStream

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.build import Recording
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import write_episode
from manip_il.data.lerobot_write import write_dataset
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.examine import examine, verdict
from manip_il.doctor.finding import Finding, error
from manip_il.mdp import Episode

from ..damage import DATA, EPISODES, cut, edit_json, edit_table, findings, lines
from ..pictures import numbered_episodes, with_cameras

MakeEpisode = Callable[..., Episode]
FINGERPRINT = environment_fingerprint(b"", {})
VIDEO = "videos/observation.images.front/chunk-000/file-000.mp4"


@pytest.fixture
def root(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    write_dataset(episodes, tmp_path / "lift", spec, repo_id="someone/lift", fingerprint=FINGERPRINT)
    return tmp_path / "lift"


@pytest.fixture(scope="module")
def filmed_once(tmp_path_factory: pytest.TempPathFactory, make_episode: MakeEpisode, spec: s.RobotTaskSpec) -> Path:
    root = tmp_path_factory.mktemp("filmed") / "lift"
    seen = with_cameras(spec, "front")
    write_dataset(numbered_episodes(make_episode, seen), root, seen, repo_id="someone/lift", fingerprint=FINGERPRINT)
    return root


@pytest.fixture
def filmed(tmp_path: Path, filmed_once: Path) -> Path:
    shutil.copytree(filmed_once, tmp_path / "filmed")
    return tmp_path / "filmed"


@pytest.fixture
def journals(root: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    folder = root.with_name("lift.journals")
    for episode in episodes:
        write_episode(folder, episode, spec, FINGERPRINT)
    return folder


def said(root: Path, *parts: str, warning: bool = False) -> bool:
    """Whether one line says all of it, as an error or as a warning."""
    kind = "warning" if warning else "error"
    return any(line.startswith(kind) and all(part in line for part in parts) for line in lines(root))


def test_a_whole_dataset_has_no_findings(root: Path, journals: Path) -> None:
    dataset = Dataset(root)
    assert list(examine(dataset)) == []
    assert verdict(dataset, []) == f"{root}: 3 episodes, 20 frames: whole"


def test_a_whole_dataset_with_a_camera_has_no_findings(filmed: Path) -> None:
    assert lines(filmed) == []


def test_a_dataset_of_many_files_has_no_findings(
    tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec
) -> None:
    root = tmp_path / "small"
    write_dataset(episodes * 4, root, spec, repo_id="a/b", fingerprint=FINGERPRINT, data_files_size_in_mb=0.01)
    assert len(list(root.glob(layout.DATA_FILES))) > 1
    assert lines(root) == []


def test_the_verdict_counts(root: Path) -> None:
    dataset = Dataset(root)
    assert verdict(dataset, [error("a", "b"), error("a", "c")]).endswith("lift: 2 errors")


def test_a_folder_that_is_no_dataset(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert said(tmp_path / "empty", "meta/info.json", "is missing", "not a LeRobot dataset")


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("codebase_version", "v2.1", "'v2.1'; expected 'v3.0'; LeRobot converts"),
        ("fps", 0, "fps is 0; expected a number of at least 1"),
        ("fps", "20", "fps is '20'"),
        ("total_frames", -1, "total_frames is -1; expected a count"),
        ("features", [], "features is []"),
        ("features", {"action": {"dtype": "float32"}}, "feature 'action'"),
        ("data_path", "../{chunk_index}", "data_path is"),
        ("data_path", "{chunk_index.__class__}", "data_path is"),
        ("total_episodes", 4, "total_episodes is 4; meta/episodes holds 3"),
        ("total_frames", 21, "total_frames is 21; the data files hold 20 rows"),
        ("total_tasks", 2, "total_tasks is 2; meta/tasks.parquet holds 1"),
        ("robot_type", "fetch", "robot_type is 'fetch'; meta/manip_il.json says 'panda'"),
    ],
)
def test_info_that_is_wrong(root: Path, key: str, value: Any, text: str) -> None:
    edit_json(root / layout.INFO, lambda info: info.update({key: value}))
    assert said(root, "meta/info.json", text)


def test_info_that_is_no_json(root: Path) -> None:
    cut(root / layout.INFO, 0.5)
    assert said(root, "meta/info.json: cannot be read")


@pytest.mark.parametrize("name", [DATA, EPISODES])
def test_a_file_without_footer(root: Path, name: str) -> None:
    cut(root / name, 0.7)
    assert said(root, name, "has no footer: its writer died before it closed the file, or the file was cut")


@pytest.mark.parametrize(
    ("content", "text"), [(b"", "is empty"), (b"x" * 99, "is not a parquet file"), (b"PAR1" * 9, "cannot be read")]
)
def test_a_file_that_is_no_parquet(root: Path, content: bytes, text: str) -> None:
    (root / DATA).write_bytes(content)
    assert said(root, DATA, text)


@pytest.mark.parametrize("pattern", ["data", "meta/episodes"])
def test_no_files_at_all(root: Path, pattern: str) -> None:
    shutil.rmtree(root / pattern)
    assert said(root, f"{pattern}/*/*.parquet", "no such file, though meta/info.json counts 3 episodes")


def test_damage_inside_a_page(root: Path) -> None:
    """Where pages carry checksums, no flipped bit goes unseen."""
    table = pq.read_table(root / DATA)
    pq.write_table(table, root / DATA, write_page_checksum=True)
    assert lines(root) == []
    content = bytearray((root / DATA).read_bytes())
    content[len(content) // 3] ^= 1
    (root / DATA).write_bytes(content)
    assert said(root, DATA, "cannot be read")


@pytest.mark.parametrize(
    ("column", "values", "text"),
    [
        ("episode_index", [0, 2, 2], "row 1 has 2; expected 1"),
        ("dataset_from_index", [0, 8, 8], "row 1 has 8; expected 7"),
        ("dataset_to_index", [7, 8, 19], "row 2 has 19; expected 20"),
        ("length", [7, 0, 12], "episode 1 has 0 frames"),
        ("length", [7, 2, 12], "its rows give 1 for episode 1"),
        ("data/file_index", [0, 3, 0], "names data/chunk-000/file-003.parquet for episode 1"),
    ],
)
def test_a_list_of_episodes_that_is_wrong(root: Path, column: str, values: list[int], text: str) -> None:
    edit_table(root / EPISODES, lambda table: table.update({column: values}))
    assert said(root, "meta/episodes", text)


def test_a_list_of_episodes_without_a_column(root: Path) -> None:
    table = pq.read_table(root / EPISODES)
    pq.write_table(table.drop_columns(["length"]), root / EPISODES)
    assert said(root, EPISODES, "has no column 'length'")


def test_an_episode_without_rows(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(table.slice(0, 8), root / DATA)
    assert said(root, "meta/episodes: names episode 2, whose rows are in no readable data file")
    assert said(root, "total_frames is 20; the data files hold 8 rows")


def test_rows_of_an_episode_that_is_not_listed(root: Path) -> None:
    edit_table(root / DATA, lambda table: table.update(episode_index=[0] * 7 + [1] + [5] * 12))
    assert said(root, DATA, "holds rows of episode 5, which meta/episodes does not list")


def test_rows_twice(root: Path) -> None:
    shutil.copy(root / DATA, root / "data/chunk-000/file-001.parquet")
    assert said(root, "data: rows of episodes 0, 1, 2 are in several places", "file-001")
    assert said(root, "data/chunk-000/file-001.parquet", "no episode refers to it, but LeRobot reads it")


@pytest.mark.parametrize(
    ("column", "row", "value", "text"),
    [
        ("frame_index", 3, 9, "9 in episode 0, row 3 of the file; expected 3"),
        ("index", 9, 3, "3 in episode 2, row 9 of the file; expected 9"),
        ("timestamp", 10, 0.11, "0.11 in episode 2, row 10 of the file; expected 0.1"),
        ("timestamp", 10, float("nan"), "nan in episode 2"),
        ("task_index", 4, 7, "rows have 7, which meta/tasks.parquet does not hold"),
        ("action", 4, [0.0, float("nan"), 0.0], "data: action: nan in row 4"),
        ("sim_state", 4, [float("inf")] * 7, "data: sim_state: inf in row 4"),
    ],
)
def test_a_row_that_is_wrong(root: Path, column: str, row: int, value: Any, text: str) -> None:
    edit_table(root / DATA, lambda table: table[column].__setitem__(row, value))
    assert any(text in line for line in lines(root))


def test_columns_that_are_missing_or_unknown(root: Path) -> None:
    table = pq.read_table(root / DATA)
    table = table.drop_columns([s.BETA]).append_column("speed", pa.array(np.zeros(20)))
    pq.write_table(table, root / DATA)
    assert said(root, DATA, "lacks the column beta")
    assert said(root, DATA, "has the column speed, which meta/info.json does not list")


def test_a_column_of_another_type_or_size(root: Path) -> None:
    table = pq.read_table(root / DATA)
    beta, action = (table.schema.get_field_index(name) for name in (s.BETA, s.ACTION))
    table = table.set_column(beta, s.BETA, table[s.BETA].cast(pa.float64()))
    table = table.set_column(action, s.ACTION, pa.array([[1.0]] * 20, pa.list_(pa.float32(), 1)))
    pq.write_table(table, root / DATA)
    assert said(root, f"{DATA}: beta", "is double in the file; info.json says float32")
    assert said(root, f"{DATA}: action", "20 numbers in 20 rows; info.json says shape [3]")


def test_a_column_with_empty_values(root: Path) -> None:
    edit_table(root / DATA, lambda table: table[s.BETA].__setitem__(2, None))
    assert said(root, f"{DATA}: beta", "holds 1 missing values")


def test_no_tasks(root: Path) -> None:
    (root / layout.TASKS).unlink()
    assert said(root, "meta/tasks.parquet: is missing")


def test_a_task_that_episodes_do_not_have(root: Path) -> None:
    edit_table(root / layout.TASKS, lambda table: table.update(task=["Drop it"]))
    assert said(root, "meta/episodes: names the task 'Lift the cube, 100 %.', which meta/tasks.parquet does not hold")


@pytest.mark.parametrize("name", ["min", "max", "mean", "std"])
def test_a_statistic_that_is_wrong(root: Path, name: str) -> None:
    def change(stats: dict[str, Any]) -> None:
        stats[s.ACTION][name][1] += 0.1

    edit_json(root / layout.STATS, change)
    assert said(root, "meta/stats.json: action", f"{name}[1] is", "the data's is", "1 of 3 numbers")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda stats: stats.pop(s.ACTION), "meta/stats.json: action: is missing"),
        (lambda stats: stats[s.ACTION].update(count=[19]), "count is 19; the data has 20 frames"),
        (lambda stats: stats[s.ACTION].update(mean="x"), "mean is no numbers; expected 3 numbers"),
        (lambda stats: stats[s.ACTION].update(mean=[0.0]), "mean is 1 number; expected 3 numbers"),
        (lambda stats: stats[s.ACTION].update(q50=[9.0] * 3), "are not in order between min and max"),
        (lambda stats: stats[s.ACTION].pop("q10"), "are not all there"),
        (lambda stats: stats.update({s.ACTION: 3}), "meta/stats.json: action: is missing"),
    ],
)
def test_statistics_that_are_not_there(root: Path, change: Callable[[Any], None], text: str) -> None:
    edit_json(root / layout.STATS, change)
    assert said(root, text)


def test_a_quantile_that_is_another_value(root: Path) -> None:
    """LeRobot's own are approximate: so this is a warning."""

    def change(stats: dict[str, Any]) -> None:
        stats[s.ACTION]["q50"] = stats[s.ACTION]["q10"]

    edit_json(root / layout.STATS, change)
    assert said(root, "quantiles of action are not those of all frames", warning=True)


def test_statistics_of_rows_numbers_are_only_a_warning(root: Path) -> None:
    edit_json(root / layout.STATS, lambda stats: stats[layout.INDEX].update(max=[99]))
    assert said(root, "statistics of index are not the data's", warning=True)
    assert not any(line.startswith("error") for line in lines(root))


def test_no_statistics(root: Path) -> None:
    (root / layout.STATS).unlink()
    assert said(root, "meta/stats.json: is missing")


def test_names_that_do_not_fit_the_shape(root: Path) -> None:
    edit_json(root / layout.INFO, lambda info: info["features"][s.ACTION].update(names={"motors": ["a", "b"]}))
    assert said(root, "meta/info.json: action", "2 names for shape [3]; expected 3")
    assert said(root, "meta/info.json: action", "meta/manip_il.json makes it")


def test_a_spec_that_does_not_fit(root: Path) -> None:
    edit_json(root / layout.OURS, lambda ours: ours["spec"].update(joint_names=["a", "b", "c", "d"]))
    assert said(root, "meta/info.json: observation.state", "shape (3,)", "makes it (4,)")


def test_a_spec_that_cannot_be_read(root: Path) -> None:
    edit_json(root / layout.OURS, lambda ours: ours["spec"].pop("fps"))
    assert said(root, "meta/manip_il.json: cannot be read", "fps missing or unknown")


def test_our_own_file_lost(root: Path) -> None:
    (root / layout.OURS).unlink()
    assert said(root, "meta/manip_il.json: is missing (LeRobot's tools drop it)", warning=True)
    assert not any(line.startswith("error") for line in lines(root))


def test_fingerprints_are_compared(root: Path) -> None:
    edit_json(root / layout.OURS, lambda ours: ours["fingerprint"].update(mujoco="1.2.3"))
    assert said(root, "mujoco differs: the dataset has 1.2.3, this installation has", warning=True)
    edit_json(root / layout.OURS, lambda ours: ours.update(fingerprint={}))
    assert said(root, "has no fingerprint", warning=True)


def test_a_video_that_is_missing(filmed: Path) -> None:
    (filmed / VIDEO).unlink()
    assert said(filmed, VIDEO, "is missing; it holds observation.images.front of 3 episodes")


def test_a_video_that_was_never_closed(filmed: Path) -> None:
    encode(filmed / VIDEO, frames=21, fps=20)
    content = (filmed / VIDEO).read_bytes()
    (filmed / VIDEO).write_bytes(content[: content.index(b"moov") - 4])  # which an encoder writes last
    assert said(filmed, VIDEO, "has no moov box: its encoder died before it closed the file")


def test_a_video_that_breaks_off(filmed: Path) -> None:
    cut(filmed / VIDEO, 0.7)
    assert said(filmed, VIDEO, "decoded frames for 21 rows of 3 episodes")


def test_a_video_of_another_length(filmed: Path, tmp_path: Path) -> None:
    """Rows against decoded frames, whatever the file's own index counts."""
    encode(filmed / VIDEO, frames=20, fps=20)
    assert said(filmed, VIDEO, "20 decoded frames for 21 rows of 3 episodes")
    assert said(filmed, VIDEO, "has no frame at the time of rows of 1 episode (2)")
    encode(filmed / VIDEO, frames=25, fps=20)
    assert said(filmed, VIDEO, "more than 21 decoded frames for 21 rows")


def test_a_video_of_another_rate_or_size(filmed: Path) -> None:
    encode(filmed / VIDEO, frames=21, fps=10)
    assert said(filmed, VIDEO, "runs at 10 frames a second; meta/info.json says 20")
    encode(filmed / VIDEO, frames=21, fps=20, size=(48, 96))
    assert said(filmed, VIDEO, "pictures are 48 x 96 (height x width); meta/info.json says 72 x 96")


def test_a_video_of_other_pictures(filmed: Path) -> None:
    encode(filmed / VIDEO, frames=21, fps=20, level=250)
    assert said(filmed, "meta/stats.json: observation.images.front", "mean is", "the pictures' is")


def test_times_of_a_video_that_are_wrong(filmed: Path) -> None:
    name = "videos/observation.images.front/from_timestamp"
    edit_table(filmed / EPISODES, lambda table: table[name].__setitem__(1, table[name][1] + 0.02))
    assert said(filmed, VIDEO, "has no frame at the time of rows of 1 episode (1)")
    edit_table(filmed / EPISODES, lambda table: table[name].__setitem__(1, 0.0))
    assert said(filmed, "meta/episodes: videos/observation.images.front", "of episode 1 span 8 frames; it has 1")


@pytest.mark.parametrize(
    ("name", "place", "text"),
    [
        ("data/chunk-000/notes.txt", "data/chunk-000/notes.txt", "no episode refers to it"),
        ("videos/observation.images.top/chunk-000/file-000.mp4", "videos/observation.images.top", "no episode refers"),
        ("meta/episodes/old.parquet", "meta/episodes/old.parquet", "no episode refers to it"),
        ("images/front/episode-000003/frame-000000.png", "images", "1 picture that LeRobot's recorder"),
        ("tmpab12cd_9/x.mp4", "tmpab12cd_9", "temporary folder of 1 file left by a killed video encoder"),
        (".cache/huggingface/x.lock", ".cache", "left by a download from the Hub"),
        ("meta/.stats.json.xyz.partial", "meta/.stats.json.xyz.partial", "temporary file"),
        ("../.lift.abc.partial/meta/info.json", "../.lift.abc.partial", "killed writer"),
    ],
)
def test_what_does_not_belong(root: Path, name: str, place: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")
    assert said(root, place, text, warning=True)
    assert not any(line.startswith("error") for line in lines(root))


def test_a_writer_that_lives_is_no_leftover(root: Path) -> None:
    partial = root.with_name(".lift.abc.partial")
    partial.mkdir()
    handle = os.open(partial, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        assert lines(root) == []
    finally:
        os.close(handle)
    assert said(root, "../.lift.abc.partial", warning=True)


def test_a_journal_cut_anywhere_is_named(root: Path, journals: Path) -> None:
    path = journals / "episode-000000000006.mcap"
    content = path.read_bytes()
    for keep in np.linspace(0, len(content) - 1, 40).astype(int):
        path.write_bytes(content[:keep])
        assert said(root, "lift.journals/episode-000000000006.mcap", "is not a complete episode")
        assert said(root, "no intact journal for 1 episode of the dataset (seed 6)", warning=True)


def test_a_journal_with_a_changed_byte_is_named(root: Path, journals: Path) -> None:
    path = journals / "episode-000000000006.mcap"
    content = path.read_bytes()
    for place in np.linspace(0, len(content) - 1, 40).astype(int):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        assert said(root, "lift.journals/episode-000000000006.mcap")


def test_journals_that_the_dataset_does_not_hold(
    root: Path, journals: Path, make_episode: MakeEpisode, spec: s.RobotTaskSpec
) -> None:
    write_episode(journals, make_episode(77), spec, FINGERPRINT)
    (journals / ".episode-000000000078.mcap.x.partial").write_bytes(b"x")
    assert said(root, "the dataset lacks 1 episode of the journals (seed 77)", warning=True)
    assert said(root, ".episode-000000000078.mcap.x.partial", warning=True)


def test_failed_episodes_that_the_recording_leaves_out_are_not_missed(
    root: Path, journals: Path, make_episode: MakeEpisode, spec: s.RobotTaskSpec
) -> None:
    write_episode(journals, make_episode(77, success=False), spec, FINGERPRINT)
    write_episode(journals, make_episode(6, 1, success=True), spec, FINGERPRINT)
    Recording("a/b", only_successes=True).write(journals)
    assert lines(root) == []


def test_a_check_that_fails_hides_no_other(root: Path) -> None:
    def breaks(dataset: Dataset) -> Iterator[Finding]:
        yield error("here", "first")
        raise RuntimeError("torn")

    def works(dataset: Dataset) -> Iterator[Finding]:
        yield error("there", "second")

    texts = [finding.text for finding in examine(Dataset(root), [breaks, works])]
    assert texts == ["first", "breaks could not be finished: RuntimeError: torn", "second"]


def test_one_line_a_finding_whatever_names_say() -> None:
    line = str(error("a\x1b[31m", "b\nc"))
    assert line.isprintable()


def test_findings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        error("a", "b").text = "c"  # type: ignore[misc]


def test_looking_changes_nothing(root: Path, journals: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")}
    findings(root)
    assert {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")} == before


def encode(path: Path, *, frames: int, fps: int, size: tuple[int, int] = (72, 96), level: int = 110) -> None:
    with av.open(str(path), "w") as container:
        options = {"preset": "12", "svtav1-params": "lp=1"}
        stream = cast(VideoStream, container.add_stream("libsvtav1", fps, options=options))
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        picture = np.full((*size, 3), level, dtype=np.uint8)
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
