"""The doctor: a whole dataset is clean, every kind of damage is found and named, and no damage stops it."""

from __future__ import annotations

import dataclasses
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
from manip_il.data.atomic import descriptor, try_lock
from manip_il.data.build import Recording
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.journal import Journal
from manip_il.data.lerobot_write import write_dataset
from manip_il.doctor.examine import examine, examine_folder, has_errors, verdict
from manip_il.doctor.finding import Finding, error
from manip_il.doctor.patient import Patient

from ..damage import DATA, EPISODES, cut, damage_at_random, edit_json, edit_table, lines

Change = Callable[[Path], Any]
FINGERPRINT = environment_fingerprint(b"", {})
VIDEO = "videos/observation.images.front/chunk-000/file-000.mp4"
JOURNAL = "lift.journals/episode-000000000006.mcap"


@pytest.fixture
def filmed(tmp_path: Path, filmed_once: Path) -> Path:
    shutil.copytree(filmed_once / "lift", tmp_path / "filmed")
    return tmp_path / "filmed"


def said(root: Path, *texts: str, kind: str = "error") -> bool:
    """Whether one line of this kind says each text; ` ... ` in a text stands for anything."""
    found = [line for line in lines(root) if line.startswith(kind)]
    return all(any(all(part in line for part in text.split(" ... ")) for line in found) for text in texts)


def json_of(name: str, change: Callable[[dict[str, Any]], Any]) -> Change:
    return lambda root: edit_json(root / name, change)


def info(**values: Any) -> Change:
    return json_of(layout.INFO, lambda info: info.update(values))


def stats(change: Callable[[dict[str, Any]], Any]) -> Change:
    return json_of(layout.STATS, change)


def ours(change: Callable[[dict[str, Any]], Any]) -> Change:
    return json_of(layout.OURS, change)


def columns(name: str, **values: list[Any]) -> Change:
    return lambda root: edit_table(root / name, lambda table: table.update(values))


def cell(column: str, row: int, value: Any, name: str = DATA) -> Change:
    return lambda root: edit_table(root / name, lambda table: table[column].__setitem__(row, value))


def table(change: Callable[[pa.Table], pa.Table], name: str = DATA) -> Change:
    return lambda root: pq.write_table(change(pq.read_table(root / name)), root / name)


def write(name: str, content: bytes) -> Change:
    return lambda root: (root / name).write_bytes(content)


def delete(name: str) -> Change:
    return lambda root: shutil.rmtree(root / name) if (root / name).is_dir() else (root / name).unlink()


def replace_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.schema.get_field_index(name), name, values)


def flip_a_bit(root: Path) -> None:
    """In a page with a checksum, where no other number would be out of place."""
    pq.write_table(pq.read_table(root / DATA), root / DATA, write_page_checksum=True)
    assert lines(root) == []
    content = bytearray((root / DATA).read_bytes())
    content[len(content) // 3] ^= 1
    (root / DATA).write_bytes(content)


def encode(*, frames: int, fps: int = 20, size: tuple[int, int] = (72, 96), level: int = 110) -> Change:
    def change(root: Path) -> None:
        with av.open(str(root / VIDEO), "w") as container:
            options = {"preset": "12", "svtav1-params": "lp=1"}
            stream = cast(VideoStream, container.add_stream("libsvtav1", fps, options=options))
            stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
            picture = np.full((*size, 3), level, dtype=np.uint8)
            for _ in range(frames):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())

    return change


def never_closed(root: Path) -> None:
    encode(frames=21)(root)
    content = (root / VIDEO).read_bytes()
    (root / VIDEO).write_bytes(content[: content.index(b"moov") - 4])  # which an encoder writes last


def test_a_whole_dataset_has_no_findings(root, journals, filmed_once):
    dataset = Patient(root)
    assert list(examine(dataset)) == []
    assert verdict(dataset, []) == f"{root}: 3 episodes, 20 frames: whole"
    assert verdict(dataset, [error("a", "b"), error("a", "c")]).endswith("lift: 2 errors")
    assert lines(filmed_once / "lift") == []


def test_a_dataset_of_many_files_has_no_findings(tmp_path, episodes, spec):
    root = tmp_path / "small"
    write_dataset(episodes * 4, root, spec, repo_id="a/b", fingerprint=FINGERPRINT, data_files_size_in_mb=0.01)
    assert len(list(root.glob(layout.DATA_FILES))) > 1
    assert lines(root) == []


def test_a_folder_that_is_no_dataset(tmp_path):
    assert said(tmp_path, "meta/info.json ... is missing ... not a LeRobot dataset")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (info(codebase_version="v2.1"), "'v2.1'; expected 'v3.0'; LeRobot converts"),
        (info(fps=0), "fps is 0; expected a number of at least 1"),
        (info(total_frames=-1), "total_frames is -1; expected a count"),
        (info(features=[]), "features is []"),
        (info(features={"action": {"dtype": "float32"}}), "feature 'action'"),
        (info(total_episodes=4), "total_episodes is 4; meta/episodes holds 3"),
        (info(total_frames=21), "total_frames is 21; the data files hold 20 rows"),
        (info(total_tasks=2), "total_tasks is 2; meta/tasks.parquet holds 1"),
        (info(robot_type="fetch"), "robot_type is 'fetch'; meta/manip_il.json says 'panda'"),
        (lambda root: cut(root / layout.INFO, 0.5), ": cannot be read"),
    ],
)
def test_info_that_is_wrong(alone, change, text):
    change(alone)
    assert said(alone, f"meta/info.json ... {text}")


_NO_FOOTER = "has no footer: its writer died before it closed the file, or the file was cut"


@pytest.mark.parametrize(
    ("change", "texts"),
    [
        (lambda root: cut(root / DATA, 0.7), [f"{DATA} ... {_NO_FOOTER}"]),
        (lambda root: cut(root / EPISODES, 0.7), [f"{EPISODES} ... {_NO_FOOTER}"]),
        (write(DATA, b""), [f"{DATA} ... is empty"]),
        (write(DATA, b"x" * 99), [f"{DATA} ... is not a parquet file"]),
        (write(DATA, b"PAR1" * 9), [f"{DATA} ... cannot be read"]),
        (delete("data"), ["data/*/*.parquet ... no such file, though meta/info.json counts 3 episodes"]),
        (delete("meta/episodes"), ["meta/episodes/*/*.parquet ... no such file, though meta/info.json counts"]),
        (flip_a_bit, [f"{DATA} ... cannot be read"]),
        (columns(EPISODES, episode_index=[0, 2, 2]), ["meta/episodes ... row 1 has 2; expected 1"]),
        (columns(EPISODES, dataset_from_index=[0, 8, 8]), ["meta/episodes ... row 1 has 8; expected 7"]),
        (columns(EPISODES, dataset_to_index=[7, 8, 19]), ["meta/episodes ... row 2 has 19; expected 20"]),
        (columns(EPISODES, length=[7, 0, 12]), ["meta/episodes ... episode 1 has 0 frames"]),
        (columns(EPISODES, length=[7, 2, 12]), ["meta/episodes ... its rows give 1 for episode 1"]),
        (
            columns(EPISODES, **{"data/file_index": [0, 3, 0]}),
            ["meta/episodes ... names data/chunk-000/file-003.parquet for episode 1"],
        ),
        (table(lambda table: table.drop_columns(["length"]), EPISODES), [f"{EPISODES} ... has no column 'length'"]),
        (
            table(lambda table: table.slice(0, 8)),
            [
                "meta/episodes: names episode 2, whose rows are in no readable data file",
                "total_frames is 20; the data files hold 8 rows",
            ],
        ),
        (
            columns(DATA, episode_index=[0] * 7 + [1] + [5] * 12),
            [f"{DATA} ... holds rows of episode 5, which meta/episodes does not list"],
        ),
        (
            lambda root: shutil.copy(root / DATA, root / "data/chunk-000/file-001.parquet"),
            [
                "data: rows of episodes 0, 1, 2 are in several places ... file-001",
                "data/chunk-000/file-001.parquet ... no episode refers to it, but LeRobot reads it",
            ],
        ),
        (cell("frame_index", 3, 9), ["9 in episode 0, row 3 of the file; expected 3"]),
        (cell("index", 9, 3), ["3 in episode 2, row 9 of the file; expected 9"]),
        (cell("timestamp", 10, 0.11), ["0.11 in episode 2, row 10 of the file; expected 0.1"]),
        (cell("timestamp", 10, float("nan")), ["nan in episode 2"]),
        (cell("task_index", 4, 7), ["rows have 7, which meta/tasks.parquet does not hold"]),
        (cell("action", 4, [0.0, float("nan"), 0.0]), ["data: action: nan in row 4"]),
        (cell("sim_state", 4, [float("inf")] * 7), ["data: sim_state: inf in row 4"]),
        (
            table(lambda table: table.drop_columns([s.BETA]).append_column("speed", pa.array(np.zeros(20)))),
            [f"{DATA} ... lacks the column beta", f"{DATA} ... has the column speed, which meta/info.json does not"],
        ),
        (
            table(lambda table: replace_column(table, s.BETA, table[s.BETA].cast(pa.float64()))),
            [f"{DATA}: beta ... is double in the file; info.json says float32"],
        ),
        (
            table(lambda table: replace_column(table, s.ACTION, pa.array([[1.0]] * 20, pa.list_(pa.float32(), 1)))),
            [f"{DATA}: action ... 20 numbers in 20 rows; info.json says shape [3]"],
        ),
        (cell(s.BETA, 2, None), [f"{DATA}: beta ... holds 1 missing values"]),
        (delete(layout.TASKS), ["meta/tasks.parquet: is missing"]),
        (
            columns(layout.TASKS, task=["Drop it"]),
            ["meta/episodes: names the task 'Lift the cube, 100 %.', which meta/tasks.parquet does not hold"],
        ),
        (
            json_of(layout.INFO, lambda info: info["features"][s.ACTION].update(names={"motors": ["a", "b"]})),
            [
                "meta/info.json: action ... 2 names for shape [3]; expected 3",
                "meta/info.json: action ... meta/manip_il.json makes it",
            ],
        ),
        (
            ours(lambda ours: ours["spec"].update(joint_names=["a", "b", "c", "d"])),
            ["meta/info.json: observation.state ... shape (3,) ... makes it (4,)"],
        ),
        (ours(lambda ours: ours["spec"].pop("fps")), ["meta/manip_il.json: cannot be read ... fps missing or unknown"]),
    ],
)
def test_files_and_rows_that_are_wrong(alone, change, texts):
    change(alone)
    assert said(alone, *texts)


_OF_ACTION = "meta/stats.json: action ..."


@pytest.mark.parametrize(
    ("change", "text"),
    [
        *(
            (
                stats(lambda stats, name=name: stats[s.ACTION][name].__setitem__(1, stats[s.ACTION][name][1] + 0.1)),
                f"{_OF_ACTION} {name}[1] is ... the data's is ... 1 of 3 numbers",
            )
            for name in ("min", "max", "mean", "std")
        ),
        (stats(lambda stats: stats.pop(s.ACTION)), "meta/stats.json: action: is missing"),
        (stats(lambda stats: stats.update({s.ACTION: 3})), "meta/stats.json: action: is missing"),
        (stats(lambda stats: stats[s.ACTION].update(count=[19])), f"{_OF_ACTION} count is 19; the data has 20 frames"),
        (stats(lambda stats: stats[s.ACTION].update(mean="x")), f"{_OF_ACTION} mean is no numbers; expected 3 numbers"),
        (stats(lambda stats: stats[s.ACTION].update(mean=[0])), f"{_OF_ACTION} mean is 1 number; expected 3 numbers"),
        (stats(lambda stats: stats[s.ACTION].update(q50=[9] * 3)), f"{_OF_ACTION} not in order between min and max"),
        (stats(lambda stats: stats[s.ACTION].pop("q10")), f"{_OF_ACTION} are not all there"),
    ],
)
def test_statistics_that_are_wrong(alone, change, text):
    change(alone)
    assert said(alone, text)


def test_missing_statistics_are_a_warning_as_a_fit_computes_them(alone):
    (alone / layout.STATS).unlink()
    assert said(alone, "meta/stats.json: is missing", kind="warning")
    assert not said(alone, "stats.json")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            stats(lambda stats: stats[s.ACTION].update(q50=stats[s.ACTION]["q10"])),  # LeRobot's own are approximate
            "quantiles of action are not those of all frames",
        ),
        (stats(lambda stats: stats["index"].update(max=[99])), "statistics of index are not the data's"),
        (delete(layout.OURS), "meta/manip_il.json: is missing (LeRobot's tools drop it)"),
        (
            ours(lambda ours: ours["fingerprint"].update(mujoco="1.2.3")),
            "mujoco differs: the dataset has 1.2.3, this installation has",
        ),
        (ours(lambda ours: ours.update(fingerprint={})), "has no fingerprint"),
        ("data/chunk-000/notes.txt", "data/chunk-000/notes.txt ... no episode refers to it"),
        ("videos/observation.images.top/chunk-000/file-000.mp4", "videos/observation.images.top ... no episode refers"),
        ("meta/episodes/old.parquet", "meta/episodes/old.parquet ... no episode refers to it"),
        ("images/front/episode-000003/frame-000000.png", "images ... 1 picture that LeRobot's recorder"),
        ("tmpab12cd_9/x.mp4", "tmpab12cd_9 ... temporary folder of 1 file left by a killed video encoder"),
        (".cache/huggingface/x.lock", ".cache ... left by a download from the Hub"),
        ("meta/.stats.json.xyz.partial", "meta/.stats.json.xyz.partial ... temporary file"),
        ("../.lift.abc.partial/meta/info.json", "../.lift.abc.partial ... killed writer"),
    ],
)
def test_what_harms_nothing_is_only_a_warning(alone, change, text):
    if isinstance(change, str):  # a file that does not belong there
        (alone / change).parent.mkdir(parents=True, exist_ok=True)
        (alone / change).write_bytes(b"x")
    else:
        change(alone)
    assert said(alone, text, kind="warning")
    assert not has_errors(examine_folder(alone))


_CAMERA = "videos/observation.images.front"
_START = f"{_CAMERA}/from_timestamp"


@pytest.mark.parametrize(
    ("change", "texts"),
    [
        (delete(VIDEO), ["is missing; it holds observation.images.front of 3 episodes"]),
        (never_closed, ["cannot be decoded, as if its encoder had died before it closed the file"]),
        (lambda root: cut(root / VIDEO, 0.7), ["decoded frames for 21 rows of 3 episodes"]),
        # rows against decoded frames, whatever the file's own index counts
        (
            encode(frames=20),
            ["20 decoded frames for 21 rows of 3 episodes", "no frame at the time of rows of 1 episode (2)"],
        ),
        (encode(frames=25), ["more than 21 decoded frames for 21 rows"]),
        (encode(frames=21, fps=10), ["runs at 10 frames a second; meta/info.json says 20"]),
        (encode(frames=21, size=(48, 96)), ["pictures are 48 x 96 (height x width); meta/info.json says 72 x 96"]),
        (encode(frames=21, level=250), ["meta/stats.json: observation.images.front ... mean is ... the pictures' is"]),
        (cell(_START, 1, 0.37, EPISODES), ["has no frame at the time of rows of 1 episode (1)"]),
        (cell(_START, 1, 0.0, EPISODES), [f"meta/episodes: {_CAMERA} ... of episode 1 span 8 frames; it has 1"]),
    ],
)
def test_a_video_that_is_wrong(filmed, change, texts):
    change(filmed)
    assert said(filmed, *(text if text.startswith("meta/") else f"{VIDEO} ... {text}" for text in texts))


def test_a_writer_that_lives_is_no_leftover(alone):
    partial = alone.with_name(".lift.abc.partial")
    partial.mkdir()
    with descriptor(partial) as handle:
        assert try_lock(handle)
        assert lines(alone) == []
    assert said(alone, "../.lift.abc.partial", kind="warning")


def test_a_journal_cut_or_changed_anywhere_is_named(root, journals):
    path = root.parent / JOURNAL
    content = path.read_bytes()
    for place in np.linspace(0, len(content) - 1, 40).astype(int):
        path.write_bytes(content[:place])
        assert said(root, f"{JOURNAL} ... is not a complete episode")
        assert said(root, "no intact journal for 1 episode of the dataset (seed 6)", kind="warning")
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        assert said(root, JOURNAL)


def test_journals_that_the_dataset_does_not_hold(root, journals, make_episode, spec):
    Journal(journals, spec, FINGERPRINT).write(make_episode(77))
    (journals / ".episode-000000000078.mcap.x.partial").write_bytes(b"x")
    lacks = "the dataset lacks 1 episode of the journals (seed 77)"
    assert said(root, lacks, ".episode-000000000078.mcap.x.partial", kind="warning")


def test_failed_episodes_that_the_recording_leaves_out_are_not_missed(root, journals, make_episode, spec):
    Journal(journals, spec, FINGERPRINT).write(make_episode(77, success=False))
    Journal(journals, spec, FINGERPRINT).write(make_episode(6, 1, success=True))
    Recording("a/b", only_successes=True).write(journals)
    assert lines(root) == []


def test_a_check_that_fails_hides_no_other(alone):
    def breaks(dataset: Patient) -> Iterator[Finding]:
        yield error("here", "first")
        raise RuntimeError("torn")

    def works(dataset: Patient) -> Iterator[Finding]:
        yield error("there", "second")

    texts = [finding.text for finding in examine(Patient(alone), [breaks, works])]
    assert texts == ["first", "breaks could not be finished: RuntimeError: torn", "second"]


def test_a_finding_is_one_printable_line_and_frozen():
    assert str(error("a\x1b[31m", "b\nc")).isprintable()
    with pytest.raises(dataclasses.FrozenInstanceError):
        error("a", "b").text = "c"  # type: ignore[misc]


def test_looking_changes_nothing(root, journals):
    before = {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")}
    examine_folder(root)
    assert {path: path.stat().st_mtime_ns for path in root.parent.rglob("*")} == before


@pytest.mark.parametrize("seed", range(10))
def test_no_damage_stops_the_doctor_and_none_that_counts_goes_unseen(filmed_once, tmp_path, seed):
    rng = np.random.default_rng(seed)
    for _ in range(20):
        shutil.rmtree(tmp_path / "copy", ignore_errors=True)
        shutil.copytree(filmed_once, tmp_path / "copy")
        way, path = damage_at_random(tmp_path / "copy", rng)
        found = examine_folder(tmp_path / "copy" / "lift")
        assert not any("could not be finished" in finding.text for finding in found), (way, path, found)
        if way in ("cut", "delete"):
            assert found, (way, path)


def test_many_damages_at_once(filmed_once, tmp_path):
    rng, found = np.random.default_rng(0), list[Finding]()
    shutil.copytree(filmed_once, tmp_path / "torn")
    for _ in range(15):
        damage_at_random(tmp_path / "torn", rng)
        found = examine_folder(tmp_path / "torn" / "lift")
        assert not any("could not be finished" in finding.text for finding in found), found
    assert has_errors(found)
