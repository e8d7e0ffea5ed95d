"""What a parquet file may unpack to is found by its page headers, before anything of it is decoded."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.frame_source import find_frames
from manip_il.data.lerobot_read import check_dataset, dataset_info, read_episodes, read_table, read_tables
from manip_il.data.parquet_files import open_shard
from manip_il.data.parquet_limits import LARGEST_FOOTER, check_parquet
from manip_il.errors import ManipError
from manip_il.mcap.export import export_dataset, open_source
from manip_il.mdp import Episode

from ..damage import DATA, EPISODES, edit_json, lines
from ..pictures import write

MIB = 1024 * 1024


@pytest.fixture
def arrow_peak() -> Iterator[Callable[[], int]]:
    """The most that pyarrow has held at once [bytes]."""
    before = pa.default_memory_pool()
    pool = pa.proxy_memory_pool(before)
    pa.set_memory_pool(pool)
    yield lambda: pool.max_memory() or 0
    pa.set_memory_pool(before)


def run_of_zeros(path: Path, rows: int = 12_000_000) -> Path:
    """A run of equal numbers takes eight bytes."""
    table = pa.table({"x": np.zeros(rows // 3, np.int64)})
    with pq.ParquetWriter(path, table.schema) as writer:
        for _ in range(3):
            writer.write_table(table, row_group_size=rows)
    return path


def page_of_zeros(path: Path, size: int = 70 * MIB) -> Path:
    pq.write_table(pa.table({"x": [bytes(size)]}), path, compression="zstd", use_dictionary=False)
    return path


def repeated_text(path: Path, compression: str = "zstd") -> Path:
    """One text of a megabyte in the dictionary, named a thousand times."""
    column = pa.DictionaryArray.from_arrays(np.zeros(1_000, np.int32), pa.array([bytes(MIB)]))
    table = pa.table({"x": column})
    pq.write_table(table, path, compression=compression, store_schema=False, dictionary_pagesize_limit=64 * MIB)
    return path


def shared_prefix(path: Path) -> Path:
    """Every text is the one before with a byte more."""
    texts = pa.array([b"a" * 1_000 + bytes([number % 250]) for number in range(1_000)])
    pq.write_table(pa.table({"x": texts}), path, use_dictionary=False, column_encoding={"x": "DELTA_BYTE_ARRAY"})
    return path


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def lying(path: Path, truth: int, lie: int) -> Path:
    """The page's header says `lie` in place of `truth`, in as many bytes."""
    data = path.read_bytes()
    old, new = varint(truth * 2), varint(lie * 2)
    assert len(old) == len(new)
    assert data.count(old) >= 1
    start = pq.read_metadata(path).row_group(0).column(0).data_page_offset
    at = data.index(old, start)
    assert at < start + 40
    path.write_bytes(data[:at] + new + data[at + len(old) :])
    return path


def lying_size(path: Path) -> Path:
    return lying(page_of_zeros(path, 8 * MIB), 8 * MIB + 10, 120 * MIB)


def large_footer(path: Path) -> Path:
    path.write_bytes(b"PAR1" + bytes(LARGEST_FOOTER + 1) + struct.pack("<I", LARGEST_FOOTER + 1) + b"PAR1")
    return path


def nested(path: Path) -> Path:
    """A column in a thousand groups, one inside the other, as compact Thrift has a footer."""
    group = b"\x35\x00\x18\x01g\x15\x02\x00"
    leaf = b"\x15\x02\x25\x00\x18\x01x\x00"
    root = b"\x48\x01r\x15\x02\x00"
    footer = b"\x15\x02\x19\xfc" + varint(1_002) + root + group * 1_000 + leaf + b"\x16\x00\x19\x0c\x00"
    path.write_bytes(b"PAR1" + footer + struct.pack("<I", len(footer)) + b"PAR1")
    return path


BOMBS: list[tuple[Callable[[Path], Path], str]] = [
    (run_of_zeros, "unpack to 14"),
    (page_of_zeros, "unpacks to 73,400,330; expected at most 67,108,864"),
    (repeated_text, "unpack to 1,04"),
    (shared_prefix, "the encoding DELTA_BYTE_ARRAY, which does not tell its size"),
    (lying_size, "unpacks to 125,829,120; expected at most 67,108,864"),
    (large_footer, "its footer has 33,554,433 bytes"),
    (nested, "too deeply nested"),
]


@pytest.mark.parametrize(("bomb", "words"), BOMBS, ids=[bomb.__name__ for bomb, _ in BOMBS])
def test_a_bomb_is_found_before_it_is_decoded(tmp_path, bomb, words, arrow_peak):
    path = bomb(tmp_path / "x.parquet")
    assert path.stat().st_size < 40 * MIB
    before = arrow_peak()
    with pytest.raises((ValueError, OSError)) as error:
        check_parquet([path])
    assert words in str(error.value)
    assert words in open_shard("x.parquet", path).problem
    assert arrow_peak() - before < 2 * MIB or bomb is nested


def test_values_are_counted_by_pages_and_not_by_the_footer(tmp_path):
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"x": np.zeros(20_000, np.int64)}), path, use_dictionary=False, compression="zstd")
    check_parquet([path], least=MIB)
    lying(path, 20_000, 1_000_000)
    assert pq.read_metadata(path).num_rows == 20_000
    with pytest.raises(ValueError, match="unpack to 12,000,000 bytes"):
        check_parquet([path], least=MIB)


@pytest.mark.parametrize("compression", ["none", "snappy", "gzip", "zstd", "brotli", "lz4"])
def test_a_dictionarys_longest_text_is_found_whatever_packs_it(tmp_path, compression):
    with pytest.raises(ValueError, match="unpack to 1,04"):
        check_parquet([repeated_text(tmp_path / "x.parquet", compression)])
    texts = pa.array(["pick", "place" * 1_000] * 100_000)
    pq.write_table(pa.table({"x": texts}), tmp_path / "y.parquet", compression=compression)
    check_parquet([tmp_path / "y.parquet"], least=200_000 * 5_100)
    with pytest.raises(ValueError, match="unpack to 1,0"):
        check_parquet([tmp_path / "y.parquet"], least=200_000 * 5_000)


def test_only_the_columns_that_are_read_count(tmp_path):
    table = pa.table(
        {"x": np.zeros(12_000_000, np.int64), "x.y": [1] * 12_000_000, "z": np.zeros(12_000_000, np.bool_)}
    )
    pq.write_table(table, tmp_path / "x.parquet")
    check_parquet([tmp_path / "x.parquet"], ["z"])
    with pytest.raises(ValueError, match="unpack to"):
        check_parquet([tmp_path / "x.parquet"], ["x.y"])


def test_many_small_bombs_are_one(tmp_path):
    paths = [run_of_zeros(tmp_path / f"{number}.parquet", 6_000_000) for number in range(2)]
    for path in paths:
        check_parquet([path])
    with pytest.raises(ValueError, match="unpack to"):
        check_parquet(paths)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("compression", ["none", "snappy", "zstd"])
def test_real_files_pass(tmp_path, version, compression):
    rng = np.random.default_rng(0)
    rows, path = 300_000, tmp_path / "x.parquet"
    state = pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=rows * 14).astype(np.float32)), 14)
    columns = {"state": state, "seed": np.zeros(rows, np.int64), "task": pa.array(["Pick up the cube."] * rows)}
    table = pa.table(columns | {"done": np.zeros(rows, np.bool_), "t": pa.array([None, 0.5] * (rows // 2))})
    pq.write_table(table, path, data_page_version=version, compression=compression)
    check_parquet([path])


def test_pictures_of_an_episode_in_one_page_pass(tmp_path):
    """Writers look at a page's size only behind a batch of a thousand values."""
    rng = np.random.default_rng(0)
    cells = [{"bytes": rng.bytes(400_000), "path": None} for _ in range(300)]
    for dictionary in (True, False):
        pq.write_table(pa.table({"camera": cells}), tmp_path / "x.parquet", use_dictionary=dictionary)
        check_parquet([tmp_path / "x.parquet"])


@pytest.fixture
def root(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    return write(episodes, tmp_path / "lift", spec)


def zeros(table: pa.Table, rows: int = 4_000_000) -> pa.Table:
    return pa.table({name: np.zeros(rows, np.int64) for name in table.column_names})


@pytest.mark.parametrize(
    ("harm", "words", "told"),
    [
        (zeros, "cannot read .*unpack to|counts 20 frames", "unpack to"),
        (
            lambda table: table.append_column(s.STATE, table[s.ACTION]),
            r"cannot read .*more than one column 'observation\.state'",
            "more than one column 'observation.state'",
        ),
    ],
    ids=["millions of rows", "two columns of one name"],
)
def test_every_reader_refuses_what_no_data_file_is(root, tmp_path, harm, words, told):
    pq.write_table(harm(pq.read_table(root / DATA)), root / DATA)
    for read in (
        dataset_info,
        read_table,
        check_dataset,
        lambda root: read_tables([root], [s.SEED]),
        lambda root: list(read_episodes(root)),
        lambda root: list(export_dataset(root, open_source(root), tmp_path)),
    ):
        with pytest.raises(ManipError, match=words) as error:
            read(root)
        assert "\n" not in str(error.value)
    assert any(told in line for line in lines(root))


@pytest.mark.parametrize("name", [EPISODES, layout.TASKS])
def test_what_stands_once_a_dataset_is_checked_too(root, name):
    repeated_text(root / name)
    with pytest.raises(ManipError, match=r"cannot read .*unpack to"):
        check_dataset(root)
    assert any("unpack to" in line for line in lines(root))


def test_a_camera_is_not_looked_for_in_a_bomb(root):
    feature: dict[str, Any] = {"dtype": "image", "shape": [8, 8, 3], "names": ["height", "width", "channels"]}
    edit_json(root / layout.INFO, lambda info: info["features"].update({"observation.images.front": feature}))
    repeated_text(root / DATA)
    with pytest.raises(ManipError, match=r"cannot read .*unpack to"):
        find_frames(root, "observation.images.front")


def test_a_row_whose_task_has_no_name_is_told(root, tmp_path):
    pq.write_table(pa.table({"task_index": [5], "task": ["x"]}), root / layout.TASKS)
    with pytest.raises(ManipError, match=r"rows have the task 0, which meta/tasks\.parquet does not hold as text"):
        list(export_dataset(root, open_source(root), tmp_path))


_MEASURED = """
import sys
from pathlib import Path
from manip_il.cli.main import main
code = main(sys.argv[1:])
status = Path("/proc/self/status").read_text()  # the most that this process held, not the one that started it
print(code, int(status.partition("VmHWM:")[2].split()[0]) // 1024, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", ["doctor", "export"])
def test_a_bomb_takes_less_than_a_gigabyte(root, tmp_path, command):
    pq.write_table(zeros(pq.read_table(root / DATA), 8_000_000), root / DATA)
    shutil.copy(root / DATA, (root / DATA).with_name("file-001.parquet"))
    words = ["doctor", str(root)] if command == "doctor" else ["mcap", "export", str(root), str(tmp_path / "out")]
    done = subprocess.run([sys.executable, "-c", _MEASURED, *words], capture_output=True, text=True, check=True)
    code, peak = map(int, done.stderr.split()[-2:])
    assert code == 1
    assert done.stderr.count("manip-il: error: ") == 1
    assert "Traceback" not in done.stderr
    assert peak < 1024, f"{peak} MiB"


def test_a_footer_with_any_changed_byte_raises_and_ends_no_process(tmp_path):
    """Looking at a column's codec or size, pyarrow ends the process for some of them."""
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"task_index": [0], "task": ["x"]}), path)
    data = path.read_bytes()
    refused = 0
    for at in range(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), len(data) - 8):
        changed = tmp_path / f"{at}.parquet"
        changed.write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        try:
            check_parquet([changed])
        except (ValueError, OSError, pa.ArrowException):
            refused += 1
    assert refused > 50
