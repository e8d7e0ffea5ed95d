"""What arrives from anyone, changed at random: each file passes the gate, or is refused in one line.

`FUZZ=20000 pytest tests/test_fuzz.py` reads more of them. They are read in a process with the gate's memory; it may die
of a file that the gate opens in a child process of its own, and of no other.
"""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import traceback
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import yaml
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from manip_il.checks import MEMORY_IN_CHILD
from manip_il.collect.workers import open_pool
from manip_il.data.dataset import Dataset
from manip_il.data.gate import open_files
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.lerobot_write import write_dataset
from manip_il.data.schema import IMAGES
from manip_il.errors import ManipError
from manip_il.evaluation.results import EvalResult
from manip_il.learn.checkpoint import Checkpoint
from manip_il.mcap.importing import read_frames
from manip_il.mcap.mapping import load_mapping

from .cli.made_runs import make_eval, make_policy
from .pictures import encoded, with_cameras

SAMPLE = Path(__file__).parents[1] / "datasets" / "sample"
INPUTS = int(os.environ.get("FUZZ", "2000"))
LONGEST_LINE = 2_000  # of an error [characters]
BATCH = 50  # inputs that a process is asked for at once
ODD: tuple[Any, ...] = (
    *(None, True, 0, -1, 2**63, 2**80, 10**400, 0.5, -0.0, 1e308, math.nan, math.inf, "", " ", "x", "20", "../x"),
    *("/etc/passwd", "x/../../y", "\0", "a\nb", "\x1b[31m", "\ud800", "{0.__class__}", "http://u:p@h/x", "x" * 100_000),
    *("9" * 5_000, [], {}, [[]], {"": None}, [0] * 2_000),
)
MAPPING = """\
fps: 10
task: {topic: /words, field: text, resample: previous, tolerance: 10}
features:
  observation.images.front: {topic: /pictures, video: false, resample: nearest, tolerance: 0.2}
  count: {topic: /numbers, field: count, dtype: int64, resample: nearest, tolerance: 0.2}
"""


def damage(rng: Random, data: bytes) -> bytes:
    """A bit flipped, a piece cut out, doubled or moved, or a number of 4 bytes written over."""
    place, size = rng.randrange(len(data) + 1), rng.choice((1, 8, 200, len(data)))
    piece = data[place : place + size]
    return rng.choice(
        (
            data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :],
            data[:place] + data[place + size :],
            data[:place] + piece * rng.choice((2, 100)) + data[place:],
            data[: len(data) // 2] + piece + data[len(data) // 2 + len(piece) :],
            data[:place] + rng.choice((0, 1, 2**31 - 1, 2**32 - 1)).to_bytes(4, "little") + data[place + 4 :],
        )
    )


def change(rng: Random, tree: Any) -> Any:
    """A tree of JSON with one of its values replaced, left out, nested, or under another name."""
    if isinstance(tree, dict | list) and tree and rng.random() < 0.8:
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        copy = tree.copy()
        copy[key] = change(rng, tree[key])
        return copy
    value = rng.choice(ODD)
    if isinstance(tree, dict) and tree:
        renamed = {("../x" if number == 0 else key): one for number, (key, one) in enumerate(tree.items())}
        return rng.choice((value, renamed, dict(list(tree.items())[1:]), {**tree, "x": value}))
    return rng.choice((value, str(tree), [tree], {"a": [tree] * 60}))


def mutate(rng: Random, path: Path) -> None:
    """Change a file, JSON and YAML mostly so that they still parse."""
    data = path.read_bytes()
    if path.suffix == ".json" and rng.random() < 0.9:
        data = json.dumps(change(rng, json.loads(data))).encode("utf-8", "surrogatepass")
    elif path.suffix == ".yaml" and rng.random() < 0.9:
        data = json.dumps(change(rng, yaml.safe_load(data))).encode("utf-8", "surrogatepass")
    else:
        for _ in range(rng.choice((1, 1, 3))):
            data = damage(rng, data)
    path.write_bytes(data)


def make_dataset(folder: Path) -> None:
    """`dataset`: two episodes of the sample; `films` and `stills`: of a camera; `journals`: all of them."""
    sample = Dataset.open(SAMPLE)
    episodes = [episode for episode, _ in zip(sample.read_episodes(), range(2), strict=False)]
    write_dataset(episodes, folder / "dataset", sample.spec, repo_id="local/sample", fingerprint=sample.fingerprint)
    spec = with_cameras(sample.spec, "front")
    for episode in episodes:
        episode.columns[IMAGES + "front"] = np.full((len(episode), *spec.image_size, 3), 90, np.uint8)
        Journal(folder / "journals", spec, {"mujoco": "3.11.0"}).write(episode)
    for name, video in (("films", True), ("stills", False)):
        own = type(spec).from_json({**spec.to_json(), "video": video})
        write_dataset(episodes, folder / name, own, repo_id="local/sample", fingerprint={})


def read_dataset(root: Path) -> None:
    open_files(root)
    dataset = Dataset.open(root)
    dataset.columns()
    _ = dataset.count_successes(), dataset.statistics, dataset.own
    for _ in dataset.read_episodes():
        pass


def dataset_in(name: str) -> Callable[[Path], object]:
    return lambda folder: read_dataset(folder / name)


def read_journals(folder: Path) -> None:
    for path in list_episodes(folder):
        read_journal(path)


def make_mcap(folder: Path) -> None:
    (folder / "mapping.yaml").write_text(MAPPING)
    with (folder / "in.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        numbers, words = (writer.register_channel(topic, "json", 0) for topic in ("/numbers", "/words"))
        pictures = writer.register_channel("/pictures", "protobuf", register_schema(writer, CompressedImage))
        for tick in range(10):
            stamp = tick * 100_000_000
            writer.add_message(numbers, stamp, json.dumps({"count": tick}).encode(), stamp)
            writer.add_message(words, stamp, json.dumps({"text": f"word {tick}"}).encode(), stamp)
            message = CompressedImage(data=encoded(np.full((8, 8, 3), tick, np.uint8)), format="png")
            writer.add_message(pictures, stamp, message.SerializeToString(), stamp)
        writer.finish()


def read_mcap(folder: Path) -> None:
    list(read_frames(folder / "in.mcap", load_mapping(folder / "mapping.yaml")))


def read_policy(folder: Path) -> None:
    Checkpoint.open(folder)


@dataclass(frozen=True)
class Target:
    """A file in a folder that `make` fills, and what reads the folder. gated: in a child process of its own."""

    make: Callable[[Path], object]
    file: str
    read: Callable[[Path], object]
    gated: bool = True


TARGETS = {
    "info.json": Target(make_dataset, "dataset/meta/info.json", dataset_in("dataset")),
    "manip_il.json": Target(make_dataset, "dataset/meta/manip_il.json", dataset_in("dataset")),
    "stats.json": Target(make_dataset, "dataset/meta/stats.json", dataset_in("dataset")),
    "tasks": Target(make_dataset, "dataset/meta/tasks.parquet", dataset_in("dataset")),
    "episodes": Target(make_dataset, "films/meta/episodes/*/*.parquet", dataset_in("films")),
    "data": Target(make_dataset, "dataset/data/*/*.parquet", dataset_in("dataset")),
    "pictures": Target(make_dataset, "stills/data/*/*.parquet", dataset_in("stills")),
    "film": Target(make_dataset, "films/videos/*/*/*.mp4", dataset_in("films")),
    "journal": Target(make_dataset, "journals/*.mcap", lambda folder: read_journals(folder / "journals")),
    "mcap": Target(make_mcap, "in.mcap", read_mcap),
    "mapping": Target(make_mcap, "mapping.yaml", read_mcap, gated=False),
    "policy": Target(make_policy, "config.json", read_policy, gated=False),
    "policy's own": Target(make_policy, "manip_il.json", read_policy, gated=False),
    "eval.json": Target(
        lambda folder: make_eval(folder / "eval.json", [True, False]), "eval.json", EvalResult.read, gated=False
    ),
}


def read_inputs(name: str, base: Path, work: Path, numbers: range) -> list[str]:
    """Read the inputs of these numbers, in a process of its own; return what was wrong with each, empty for nothing."""
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()  # PyTorch's libraries
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY_IN_CHILD, held + MEMORY_IN_CHILD))
    target, found = TARGETS[name], list[str]()
    for number in numbers:
        (work / "at").write_text(str(number))
        folder = work / "folder"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(base, folder)
        mutate(Random(f"{name} {number}"), sorted(folder.glob(target.file))[0])
        found.append(_problem(target, folder))
    return found


def _problem(target: Target, folder: Path) -> str:
    try:
        target.read(folder)
    except ManipError as error:
        line = str(error)
        return "" if len(line) < LONGEST_LINE and line.isprintable() else f"no line: {line!r}"
    except MemoryError:
        return "" if target.gated else "out of memory"
    except Exception:
        return traceback.format_exc()
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_changed_file_is_read_or_refused_in_one_line(name: str, tmp_path: Path):
    base, work, count = tmp_path / "base", tmp_path / "work", INPUTS // len(TARGETS)
    base.mkdir()
    work.mkdir()
    TARGETS[name].make(base)
    numbers, problems = range(count), dict[int, str]()
    while numbers:
        part = numbers[:BATCH]
        with open_pool(1) as pool:
            try:
                found = pool.submit(read_inputs, name, base, work, part).result()
                problems |= {number: one for number, one in zip(part, found, strict=True) if one}
            except BrokenExecutor:
                died = int((work / "at").read_text())
                part = range(part.start, died + 1)
                if not TARGETS[name].gated:
                    problems[died] = "the process died"
        numbers = range(part.stop, count)
    assert not problems
