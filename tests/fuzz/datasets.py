"""Targets of datasets, journals and MCAP files."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from manip_il.cli.inputs import check_dataset
from manip_il.data import journal
from manip_il.data import schema as s
from manip_il.data.build import Recording, build
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.learn.columns import LEARNING_COLUMNS, check_table, learning_rows
from manip_il.mcap.importing import features_of, frames_of, list_files, read_import
from manip_il.mcap.mapping import load_mapping
from manip_il.mdp import Episode
from manip_il.store.cards import card_for

from ..pictures import encoded, with_cameras
from .binary import mutate_mcap, mutate_parquet
from .target import Target, runs
from .trees import damaged, mutate_json, mutate_yaml

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"
MAPPING = """\
# manip-il
fps: 10
robot_type: panda
task: {topic: /words, field: text, resample: hold, tolerance: 10}
features:
  observation.state:
    topic: /numbers
    field: ["joints[name=elbow].position", "joints[name=wrist].position"]
    dtype: float32
    names: [elbow, wrist]
    resample: interpolate
    tolerance: 0.2
  observation.images.front: {topic: /pictures, video: false, resample: nearest, tolerance: 0.2}
  label: {topic: /words, field: text, dtype: string, resample: hold, tolerance: 10}
  count: {topic: /numbers, field: [count], dtype: int64, resample: nearest, tolerance: 0.2}
"""


def make_dataset(folder: Path) -> None:
    """`dataset`, and `dataset.journals` beside it: two episodes of the sample."""
    episodes = [episode for episode, _ in zip(Dataset.open(SAMPLE).read_episodes(), range(2), strict=False)]
    spec, fingerprint = Dataset.open(SAMPLE).spec, Dataset.open(SAMPLE).fingerprint
    write_dataset(episodes, folder / "dataset", spec, repo_id="local/sample", fingerprint=fingerprint)


def make_journals(folder: Path) -> None:
    """`demos.journals`: two episodes and their recording.json."""
    spec, fingerprint = Dataset.open(SAMPLE).spec, Dataset.open(SAMPLE).fingerprint
    for episode, _ in zip(Dataset.open(SAMPLE).read_episodes(), range(2), strict=False):
        journal.write_episode(folder / "demos.journals", episode, spec, fingerprint)
    Recording("local/demos", True, 2, {"driver": "expert"}).write(folder / "demos.journals")


def make_pictured_journals(folder: Path) -> None:
    """`demos.journals` of two short episodes with one camera."""
    spec = with_cameras(
        s.RobotTaskSpec("toy", "lift", 20, ("a", "gripper"), ("ee.x", "ee.y", "ee.z"), 3, "Lift."), "front"
    )
    for seed in (1, 2):
        columns = {
            key: np.zeros((4, *one["shape"]), np.uint8 if one["dtype"] == "video" else one["dtype"])
            for key, one in s.features(spec).items()
        }
        pictures = columns[s.IMAGES + "front"]
        pictures[:] = np.random.default_rng(seed).integers(0, 256, pictures.shape)
        columns[s.SEED][:] = seed
        columns[s.SUCCESS][-1] = columns[s.DONE][-1] = True
        journal.write_episode(folder / "demos.journals", Episode(seed, columns, True, True), spec, {"mujoco": "3.11.0"})
    Recording("local/demos", True, 2).write(folder / "demos.journals")


def make_pictured(folder: Path) -> None:
    """`dataset` with a camera, as built of journals, which lie beside it."""
    make_pictured_journals(folder)
    build(folder / "demos.journals", folder / "dataset")
    (folder / "demos.journals").rename(folder / "dataset.journals")


def make_mcap(folder: Path) -> None:
    """`in.mcap` and the `mapping.yaml` that imports it."""
    (folder / "mapping.yaml").write_text(MAPPING)
    with (folder / "in.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        numbers, words = (writer.register_channel(topic, "json", 0) for topic in ("/numbers", "/words"))
        pictures = writer.register_channel("/pictures", "protobuf", register_schema(writer, CompressedImage))
        for tick in range(0, 10):
            stamp = tick * 100_000_000
            joints = [{"name": name, "position": tick / 3} for name in ("elbow", "wrist")]
            writer.add_message(numbers, stamp, json.dumps({"joints": joints, "count": tick}).encode(), stamp)
            writer.add_message(words, stamp, json.dumps({"text": f"word {tick}"}).encode(), stamp)
            message = CompressedImage(data=encoded(np.full((8, 8, 3), tick, np.uint8)), format="png")
            writer.add_message(pictures, stamp, message.SerializeToString(), stamp)
        writer.finish()


def _open(folder: Path) -> None:
    _ = Dataset.open(folder / "dataset").summary
    _ = Dataset.open(folder / "dataset").spec
    Dataset.open(folder / "dataset").columns()


def _episodes(folder: Path) -> None:
    list(Dataset.open(folder / "dataset").read_episodes())


def _card(folder: Path) -> None:
    card_for(folder / "dataset", "dataset", "hf://datasets/user/demos")


def _learn(folder: Path) -> None:
    """What `train` does with a dataset before it fits."""
    root = folder / "dataset"
    spec = Dataset.open(root).spec
    check_dataset(root, spec, Dataset.open(root).fingerprint)
    table = Dataset.open(root).columns((*LEARNING_COLUMNS, "frame_index"))
    check_table(table, spec)
    learning_rows(table)


def _journals(folder: Path) -> None:
    for path in journal.list_episodes(folder / "demos.journals"):
        journal.read_header(path)
        journal.read_journal(path)


def _import(folder: Path) -> None:
    mapping = load_mapping(folder / "mapping.yaml")
    for path in list_files(folder / "in.mcap"):
        episode = read_import(path, mapping)
        list(frames_of(episode, mapping, features_of(mapping, episode)))


def damaged_video(rng: Random, data: bytes) -> bytes:
    """A video with damage anywhere; half of it in its first or last kilobyte, where the container's tables are."""
    if rng.random() < 0.5:
        return damaged(rng, data)
    if rng.random() < 0.5:
        return damaged(rng, data[:1_000]) + data[1_000:]
    return data[:-1_000] + damaged(rng, data[-1_000:])


_DOCTOR = runs("doctor", "{folder}/dataset")
_REPAIR = runs("doctor", "{folder}/dataset", "--repair=true")
_EXPORT = runs("mcap", "export", "{folder}/dataset", "{folder}/mcap")
_PUSH = runs("push", "{folder}/dataset", "file://{folder}/store")
_BUILD = runs("build", "{folder}/demos.journals", "{folder}/built")
_IMPORT = runs("mcap", "import", "{folder}/in.mcap", "{folder}/out", "--mapping={folder}/mapping.yaml")
_READS = (_open, _episodes, _card, _DOCTOR, _EXPORT, _learn, _PUSH)
TARGETS = (
    Target("dataset info.json", make_dataset, "dataset/meta/info.json", mutate_json, _READS),
    Target("dataset manip_il.json", make_dataset, "dataset/meta/manip_il.json", mutate_json, _READS),
    Target("dataset stats.json", make_dataset, "dataset/meta/stats.json", mutate_json, (*_READS, _REPAIR)),
    Target("dataset tasks", make_dataset, "dataset/meta/tasks.parquet", mutate_parquet, _READS),
    Target("dataset episodes", make_dataset, "dataset/meta/episodes/*/*.parquet", mutate_parquet, _READS),
    Target("dataset data", make_dataset, "dataset/data/*/*.parquet", mutate_parquet, _READS),
    Target(
        "pictured info.json", make_pictured, "dataset/meta/info.json", mutate_json, (*_READS[:5], _REPAIR), share=0.5
    ),
    Target("video", make_pictured, "dataset/videos/*/*/*.mp4", damaged_video, (_episodes, _DOCTOR), share=0.3),
    Target("recording.json", make_journals, "demos.journals/recording.json", mutate_json, (_BUILD,)),
    Target("journal", make_journals, "demos.journals/*.mcap", mutate_mcap, (_journals, _BUILD)),
    Target("pictured journal", make_pictured_journals, "demos.journals/*.mcap", mutate_mcap, (_journals, _BUILD)),
    Target("mcap", make_mcap, "in.mcap", mutate_mcap, (_import,)),
    Target("mcap mapping", make_mcap, "mapping.yaml", mutate_yaml, (_import,)),
    Target("mcap import", make_mcap, "mapping.yaml", mutate_yaml, (_IMPORT,), share=0.1),
)
