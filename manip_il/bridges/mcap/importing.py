"""Import MCAP files as a LeRobot dataset: one episode per file, resampled to the dataset's rate,
without gaps.

An episode lasts from the time when all topics have started to the time when the first one ends, by
log time. Messages are read by the library's reader and decoders.
"""

import importlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any, override

import numpy as np
from mcap.decoder import DecoderFactory
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.well_known import MessageEncoding
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from numpy.typing import NDArray

from manip_il import checks
from manip_il.bridges.mcap.mapping import TASK, TEXT, Mapping, TopicSource, values_at
from manip_il.data.camera import decode_picture
from manip_il.data.dataset import EpisodeData
from manip_il.data.foxglove import NANOSECONDS, frame_times
from manip_il.data.info import Info
from manip_il.data.lerobot_write import write_episodes
from manip_il.data.schema import exact_rate
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import I64

Frame = dict[str, Any]  # column -> array or text, and `task`
U8 = NDArray[np.uint8]

_LAST_STAMP = 2**63 - 1  # [ns]
_ROS2 = "mcap_ros2"  # module of the optional package mcap-ros2-support
# encoding of raw pictures -> slice of channels to RGB
_CHANNELS = {"rgb8": slice(None), "bgr8": slice(None, None, -1)}


def list_files(source: Path) -> list[Path]:
    """Return the MCAP file, or all those in a folder, sorted by name.

    Raises `ManipError` if there are none.
    """
    paths = sorted(path for path in source.glob("*.mcap") if not path.name.startswith("."))
    if not paths and not source.is_file():
        raise ManipError(f"{source} is not a file, and holds no *.mcap files")
    return paths or [source]


def import_files(
    paths: list[Path], root: Path, mapping: Mapping, on_episode: Callable[[], object] = lambda: None
) -> Info:
    """Write the files as a dataset, which appears at `root` when it is complete.

    All files are first read in a child process with limited memory and time.

    Args:
        paths: The files, an episode each.
        root: The new dataset.
        mapping: Its columns.
        on_episode: Called before each episode is written.

    Raises:
        FolderExistsError: `root` is not empty.
        MismatchError: Shapes differ between files.
        ManipError: As `checks.in_child` and `read_frames` raise it.
    """
    checks.in_child(str(paths[0]), _read_all, paths, mapping)
    first = next(read_frames(paths[0], mapping))
    features: dict[str, dict[str, Any]] = {}
    for key, source in mapping.features.items():
        dtype = source.dtype if not source.is_camera else "video" if source.video else "image"
        names = ["height", "width", "channels"] if source.is_camera else source.names
        features[key] = {"dtype": dtype, "shape": np.shape(first[key]) or (1,), "names": names}

    def episodes() -> Iterator[EpisodeData]:
        for path in paths:
            frames = list(read_frames(path, mapping))
            columns = {
                key: np.array(
                    [frame[key] for frame in frames], object if feature["dtype"] == TEXT else None
                )
                for key, feature in features.items()
            }
            on_episode()
            yield EpisodeData(columns, [frame[TASK] for frame in frames])

    return write_episodes(episodes(), root, features, mapping.fps, mapping.robot_type or "")


def _read_all(paths: list[Path], mapping: Mapping) -> None:
    """Read all files as an import does. Raises `MismatchError` unless all have the same shapes."""
    wanted: dict[str, Any] = {}
    for path in paths:
        checks.opening(str(path))
        for frame in read_frames(path, mapping):
            for key, value in frame.items():
                shape = np.shape(value)
                if shape != wanted.setdefault(key, shape):
                    raise MismatchError(
                        f"the shape of {key!r}", str(path), shape, str(paths[0]), wanted[key]
                    )


def read_frames(path: Path, mapping: Mapping) -> Iterator[Frame]:
    """Yield a file's frames, resampled to the dataset's rate; pictures are read on demand.

    Raises `ManipError` naming file and topic if the file lacks something that the mapping names.
    """
    sources = mapping.sources
    found: dict[str, dict[int, Any]] = {key: {} for key in sources}
    for topic, stamp, content in read_messages(path, {one.topic for one in sources.values()}):
        for key, source in sources.items():  # if stamps are equal, the last message counts
            if source.topic == topic:
                where = f"{path}, topic {topic}, {key} at {stamp} ns"
                found[key][stamp] = None if source.is_camera else _value(where, source, content)
    for key, source in sources.items():
        if not found[key]:
            raise ManipError(
                f"{path} has no messages of {source.topic}; expected all topics of the mapping"
            )
    stamps = {key: np.array([*messages], np.int64) for key, messages in found.items()}
    times = _times(path, stamps, exact_rate(mapping.fps))
    rows: dict[str, Any] = {TASK: [mapping.task] * len(times)}
    for key, source in sources.items():
        where = f"{path}, topic {source.topic}, {key}"
        chosen = stamps[key][pick(where, source, stamps[key], times)].tolist()
        rows[key] = (
            read_pictures(path, source.topic, chosen)
            if source.is_camera
            else map(found[key].get, chosen)
        )
    for values in zip(*rows.values(), strict=True):
        yield dict(zip(rows, values, strict=True))


def _times(path: Path, stamps: dict[str, I64], rate: Fraction) -> I64:
    """Return the frames' times [ns], (T,), from the latest first stamp to the earliest last one."""
    start, last = max((int(times[0]), key) for key, times in stamps.items())
    end, first = min((int(times[-1]), key) for key, times in stamps.items())
    if end < start:
        raise ManipError(
            f"{path}: {first} ends before {last} starts; expected topics that overlap in time"
        )
    count = math.ceil((end - start + 1) * rate / NANOSECONDS)
    return start + np.array(frame_times(count, rate), np.int64)


def pick(where: str, source: TopicSource, stamps: I64, times: I64) -> I64:
    """Return, for each frame, the index of its message.

    Args:
        where: File and topic, for messages.
        source: How messages are chosen.
        stamps: The messages' times [ns], (N,), ascending.
        times: The frames' times [ns], (T,), ascending, none before the first message.

    Raises:
        ManipError: A frame's message is farther away in time than the tolerance; names both and the
            time of the gap.
    """
    chosen = np.searchsorted(stamps, times, side="right") - 1
    if source.resample == "nearest":
        after = np.minimum(chosen + 1, len(stamps) - 1)
        chosen = np.where(stamps[after] - times < times - stamps[chosen], after, chosen)
    far = np.abs(times - stamps[chosen]) > source.tolerance * NANOSECONDS
    if far.any():
        frame = int(np.argmax(far))
        place = (
            f"{(times[frame] - times[0]) / NANOSECONDS:g} s (stamp {times[frame]} ns, frame"
            f" {frame})"
        )
        remedy = (
            "between frame and message: raise the tolerance in the mapping, or leave out this file"
        )
        raise ManipError(
            f"{where}: a gap at {place}; {source.resample} allows {source.tolerance:g} s {remedy}"
        )
    return chosen


def _value(where: str, source: TopicSource, content: Any) -> Any:
    """Return a column's text or array (*shape) from a message.

    Raises `ManipError` for values that do not fit.
    """
    try:
        values = [value for path in source.paths for value in values_at(path, content)]
        if source.width not in (None, len(values)):
            raise ValueError(f"the message has {len(values)} values; expected {source.width}")
        if source.dtype == TEXT:
            return checks.text("the message", values[0], checks.LARGEST_READ)
        if all(isinstance(value, int | float) for value in values):
            exact = np.array(values, object)
            with np.errstate(over="ignore"):  # the next line checks for infinity
                numbers = exact.astype(source.dtype)
            if (
                np.isfinite(numbers).all()
                if numbers.dtype.kind == "f"
                else (numbers == exact).all()
            ):
                return numbers.reshape(source.shape or -1)
        raise ValueError(
            f"the message has {checks.shorten(values)}; expected finite {source.dtype} numbers"
        )
    except (ManipError, OverflowError, ValueError) as error:
        raise ManipError(f"{where}: {error}") from error


def read_messages(path: Path, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, log time [ns] and decoded content of the messages of some topics, in order of
    time.

    Raises `ManipError` naming the file for any error of the MCAP library or a decoder.
    """
    factories: list[DecoderFactory] = [ProtobufFactory(), _JsonFactory()]
    if find_spec(_ROS2):
        factories.insert(0, importlib.import_module(f"{_ROS2}.decoder").DecoderFactory())
    try:
        with checks.open_outside(path, "an MCAP file") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=factories)
            for _, channel, message, content in reader.iter_decoded_messages(topics):
                stamp = checks.whole(
                    f"the log time of {channel.topic}", message.log_time, 0, _LAST_STAMP
                )
                yield channel.topic, stamp, content
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make a parser raise anything
        raise ManipError(
            f"cannot read {path}: {checks.one_line(error) or type(error).__name__}"
        ) from error


class _JsonFactory(DecoderFactory):
    """Last decoder factory to be asked: decodes JSON and raises `ValueError` for any other
    encoding.
    """

    @override
    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any]:
        if message_encoding == MessageEncoding.JSON:
            return json.loads
        expected = (
            "protobuf, json or, after `pip install mcap-ros2-support`, cdr with ros2msg schemas"
        )
        raise ValueError(f"messages are {message_encoding}; expected {expected}")


def read_pictures(path: Path, topic: str, stamps: Sequence[int]) -> Iterator[U8]:
    """Yield the pictures (height, width, 3) of a topic's messages.

    Args:
        path: The file.
        topic: A topic of Foxglove's or ROS 2's pictures.
        stamps: The messages' log times [ns], (T,), ascending.

    Raises:
        ManipError: A message holds no picture; names file, topic and stamp.
    """
    frames = Counter(stamps)
    for stamp, messages in itertools.groupby(
        read_messages(path, [topic]), lambda message: message[1]
    ):
        *_, (_, _, content) = messages  # if stamps are equal, the last message counts
        if stamp in frames:
            try:
                picture = _picture(content)
            except ValueError as error:
                raise ManipError(f"{path}, topic {topic} at {stamp} ns: {error}") from error
            yield from itertools.repeat(picture, frames[stamp])


def _picture(message: Any) -> U8:
    """Return the picture (height, width, 3) of a Foxglove or ROS message.

    Raises `ValueError` if there is none.
    """
    if hasattr(message, "format"):  # CompressedImage
        return decode_picture(bytes(message.data))
    encoding = getattr(message, "encoding", "none")  # RawImage of Foxglove, Image of ROS
    if encoding not in _CHANNELS:
        raise ValueError(
            f"the picture is encoded as {encoding!r}; expected {' or '.join(_CHANNELS)}, PNG or"
            " JPEG"
        )
    height, width = message.height, message.width
    # rows may be padded
    rows = np.frombuffer(message.data, np.uint8).reshape(height, message.step or width * 3)
    return np.ascontiguousarray(
        rows[:, : width * 3].reshape(height, width, 3)[:, :, _CHANNELS[encoding]]
    )
