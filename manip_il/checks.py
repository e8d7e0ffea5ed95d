"""Check untrusted input: JSON, YAML, names that become paths, numbers and text.

Every check returns the value with its declared type, or raises `ManipError` with one line that
names the thing, its shortened value and what was expected. `in_child` opens untrusted files in a
limited child process.
"""

import json
import math
import os
import pickle
import re
import resource
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import Any

from manip_il.errors import ManipError, UsageError, shorten

LONGEST_NAME = 100  # [characters]
LONGEST_TEXT = 10_000  # [characters]
LARGEST_READ = 256 * 2**20  # of a file that is read as a whole [bytes]
LARGEST_YAML = 2**18  # [bytes]
MOST_NODES = 100_000  # in a YAML text whose aliases are expanded
MEMORY_IN_CHILD = 4 * 1024**3  # [bytes]
SECONDS_IN_CHILD = 120.0

_NAME = re.compile(r"[A-Za-z0-9_\-][A-Za-z0-9_.\-]*")
_BETWEEN_TASKS = re.compile(r",(?!\s*\w+=)", re.ASCII)
_NUMBERS = re.compile(r"\w+=[0-9.e+-]+(,\w+=[0-9.e+-]+)*", re.ASCII)
_SURROGATE = re.compile("[\ud800-\udfff]")  # not Unicode on its own, so that no file can hold it
_LONGEST_MESSAGE = 1_000  # [characters]
_REFUSED = 3  # exit code of the child process if its function raises `ManipError`


def one_line(error: BaseException) -> str:
    """Return an error's message as one line of at most 1,000 characters."""
    return " ".join(str(error).split())[:_LONGEST_MESSAGE]


def name(what: str, value: object) -> str:
    """Return a name that is safe in a path: letters, digits and `_ . -`, at most 100 characters.

    It may not begin with a dot or contain `..`.
    """
    if (
        not isinstance(value, str)
        or not _NAME.fullmatch(value)
        or len(value) > LONGEST_NAME
        or ".." in value
    ):
        raise ManipError(
            f"{what} is {shorten(value)}; expected a name of letters, digits and _ . - (no '..', no"
            f" leading dot, at most {LONGEST_NAME} characters)"
        )
    return value


def tasks_in(text: str) -> tuple[str, ...]:
    """Return the names in `lift,carry:A=1,B=2,stack`, where commas also stand between the numbers
    of one task; each name once.
    """
    return tuple(dict.fromkeys(_BETWEEN_TASKS.split(text)))


def task_name(value: object) -> str:
    """Return the name of a task, or of several with commas between them, checked as by `name`.

    Numbers may follow a colon: `NAME:A=NUMBER,B=NUMBER`.
    """
    names = tasks_in(text("task", value))
    return ",".join(map(_task_name, names))


def _task_name(value: str) -> str:
    base, colon, numbers = value.partition(":")
    if colon and not _NUMBERS.fullmatch(numbers):
        raise ManipError(f"task is {shorten(value)}; expected NAME=NUMBER,... after the colon")
    name("task", base)
    return f"{base}{colon}{numbers}"


def object_name(value: object) -> str:
    """Return an object's text as it is stored: a shape, or a mesh by the name of its file, never
    by a path.
    """
    if "/" in text("object", value, LONGEST_NAME):
        raise ManipError(
            f"object is {shorten(value)}; expected a shape, or a mesh's name without a path"
        )
    return text("object", value)


def repo_id(what: str, value: object) -> str:
    """Return the id of a dataset or policy, `NAME` or `USER/NAME`, both parts checked as by
    `name`.
    """
    user, slash, rest = text(what, value).partition("/")
    return f"{name(what, user)}/{name(what, rest)}" if slash else name(what, user)


def text(what: str, value: object, longest: int = LONGEST_TEXT) -> str:
    """Return a string of at most `longest` characters, all of them Unicode.

    Args:
        what: The name of the value, for the message.
        value: The value to check.
        longest: The greatest length [characters].

    Raises:
        ManipError: The value is not a string, is too long, or holds a lone surrogate.
    """
    if not isinstance(value, str) or len(value) > longest or _SURROGATE.search(value):
        raise ManipError(
            f"{what} is {shorten(value)}; expected text of at most {longest} characters, in Unicode"
        )
    return value


def whole(what: str, value: object, low: int, high: int) -> int:
    """Return an int within [low, high].

    Args:
        what: The name of the value, for the message.
        value: The value to check.
        low: The least number that is allowed.
        high: The greatest number that is allowed.

    Raises:
        ManipError: The value is outside the limits or not an int; True and 3.0 are rejected.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ManipError(
            f"{what} is {shorten(value)}; expected a whole number from {low} to {high}"
        )
    return value


def number(what: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite float within [low, high].

    Args:
        what: The name of the value, for the message.
        value: The value to check, an int or a float.
        low: The least number that is allowed.
        high: The greatest number that is allowed.

    Raises:
        ManipError: The value is outside the limits, not finite or not a number.
    """
    most = sys.float_info.max  # a larger int does not fit in a float
    if (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and max(low, -most) <= value <= min(high, most)
    ):
        return float(value)
    limits = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
    raise ManipError(f"{what} is {shorten(value)}; expected a finite number{limits}")


def mapping(what: str, value: object) -> dict[str, Any]:
    """Return a dict with string keys."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ManipError(f"{what} is {shorten(value)}; expected an object of named values")
    return value


def parse_json(what: str, data: str | bytes) -> Any:
    """Return the value of a JSON text, None for NaN and Infinity.

    Args:
        what: The name of the text, for the message.
        data: The text.

    Raises:
        ManipError: The text is invalid, or its values are nested too deeply.
    """
    try:
        return json.loads(data, parse_constant=lambda constant: None)
    # UnicodeDecodeError and JSONDecodeError are ValueErrors
    except (RecursionError, ValueError) as error:
        raise ManipError(f"{what} is not valid JSON: {error}") from error


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Return the object in a JSON file.

    Args:
        path: The file.
        what: Its expected content, for the message.

    Raises:
        ManipError: The file cannot be read, or holds anything but an object.
    """
    return mapping(str(path), parse_json(str(path), read_bytes(path, what)))


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text, read by the safe loader.

    Raises:
        ValueError: The text is invalid or not Unicode, or it has more than 100,000 nodes after its
            aliases are expanded. The message is one line.
    """
    import yaml  # imported here because most checks read no YAML

    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _expanded_size(node, {}) > MOST_NODES:
            raise ValueError(f"it expands to more than {MOST_NODES:,} values, or without end")
        return loader.construct_document(node)
    except Exception as error:  # besides its own errors, it raises those of int() and datetime()
        raise ValueError(one_line(error)) from error


def _expanded_size(node: Any, sizes: dict[int, int]) -> int:
    """Return the number of a YAML node's values after its aliases are expanded.

    More than allowed for a loop.

    sizes: those of the nodes that were counted before, by id. Raises `UnicodeEncodeError` for lone
    surrogates.
    """
    if isinstance(node.value, str):
        node.value.encode()
        return 1
    if id(node) not in sizes:
        sizes[id(node)] = MOST_NODES + 1  # found again inside itself, a node has no end
        parts = chain(*node.value) if node.id == "mapping" else node.value
        sizes[id(node)] = 1 + sum(_expanded_size(part, sizes) for part in parts)
    return sizes[id(node)]


def read_yaml(path: Path, what: str) -> Any:
    """Return the value of a YAML file.

    Args:
        path: The file.
        what: Its expected content, for the message.

    Raises:
        UsageError: The file cannot be read, or is not valid YAML.
    """
    try:
        return parse_yaml(read_bytes(path, what, UsageError, LARGEST_YAML).decode())
    except ValueError as error:  # UnicodeDecodeError is a ValueError
        raise UsageError(f"{path} is not YAML: {error}") from error


def finite(what: str, tree: Any) -> None:
    """Raise `ManipError` if a number in nested lists and mappings is NaN or infinite.

    Args:
        what: The name of the value, for the message.
        tree: The value.
    """
    if isinstance(tree, float):
        number(what, tree)
    parts = tree.items() if isinstance(tree, dict) else ()
    if isinstance(tree, list):
        parts = enumerate(tree)
    for key, part in parts:
        finite(f"{what}.{key}", part)


def open_outside(path: Path, what: str, refusal: type[ManipError] = ManipError) -> BufferedReader:
    """Open a file from outside for reading.

    Every file that this program did not just write is opened here.

    It never blocks, and it opens only regular files and links to them: no pipes, devices or
    sockets.

    Args:
        path: The file.
        what: Its expected content, for the message.
        refusal: The class of the error to raise.

    Raises:
        ManipError: Of the class `refusal`. The file cannot be opened or is not regular.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise refusal(f"cannot read {path}: {error.strerror}; expected {what}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise refusal(f"cannot read {path}: it is not a regular file; expected {what}")
    return os.fdopen(descriptor, "rb")


@contextmanager
def native_path(path: Path, what: str) -> Iterator[str]:
    """Give libraries that open files themselves another path of the file that `open_outside` opens.

    Args:
        path: The file.
        what: Its expected content, for the message.

    Yields:
        A path that leads to the open file for as long as the block lasts.

    Raises:
        ManipError: The file cannot be opened or is not regular.
    """
    with open_outside(path, what) as file:
        yield f"/proc/self/fd/{file.fileno()}"


def read_bytes(
    path: Path, what: str, refusal: type[ManipError] = ManipError, most: int = LARGEST_READ
) -> bytes:
    """Return the content of a file that `open_outside` opens.

    Args:
        path: The file.
        what: Its expected content, for the message.
        refusal: The class of the error to raise.
        most: The largest size that is allowed [bytes].

    Raises:
        ManipError: Of the class `refusal`. The file cannot be read or is too large.
    """
    with open_outside(path, what, refusal) as file:
        try:
            content = file.read(min(most, os.fstat(file.fileno()).st_size) + 1)
        except OSError as error:
            raise refusal(f"cannot read {path}: {error.strerror}; expected {what}") from error
    if len(content) > most:
        raise refusal(f"{path} is larger than {most:,} bytes; expected {what}")
    return content


def check_unchanged(path: Path) -> None:
    """Raise `UsageError` if a file was edited since the first call: a process reads a task,
    robot or mesh only once.
    """
    if path.is_file() and path.read_bytes() != _first_bytes(path.absolute()):
        raise UsageError(f"{path} was edited after this process had read it; start Python again")


@cache
def _first_bytes(path: Path) -> bytes:
    return path.read_bytes()


def without_link(path: str, flags: int) -> int:
    """Open a file for writing, as an `opener` for `open`.

    Args:
        path: The file.
        flags: As `open` gives them.

    Returns:
        The descriptor of the file.

    Raises:
        OSError: The path is a link, which could lead to any file, or the file cannot be opened.
    """
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def in_child(
    what: str,
    function: Callable[..., object],
    *arguments: object,
    seconds: float = SECONDS_IN_CHILD,
) -> None:
    """Call a function in a child process with limited memory (4 GB) and time.

    Only the text of a `ManipError` comes back, because the file is untrusted.

    Args:
        what: The name of the file or folder, for the messages. A function that opens several files
            calls `opening` before each.
        function: The function to call; it and its arguments are pickled.
        arguments: The arguments of the function.
        seconds: The time limit [s].

    Raises:
        ManipError: The function raised one, whose text this one has; or the child exceeded its
            limits or died.
    """
    command = [sys.executable, "-c", "from manip_il.checks import answer_parent; answer_parent()"]
    done = subprocess.run(
        command,
        input=pickle.dumps((seconds, function, arguments)),
        capture_output=True,
        check=False,
    )
    *_, last = what, *done.stdout.decode(errors="replace").splitlines()
    if done.returncode == _REFUSED:
        raise ManipError(last)
    if done.returncode != 0:
        code = (
            "out of memory"
            if b"bad_alloc" in done.stderr or b"MemoryError" in done.stderr
            else done.returncode
        )
        code = "out of time" if done.returncode == -signal.SIGALRM else code
        limits = f"{MEMORY_IN_CHILD / 1024**3:g} GB of memory and {seconds:g} s"
        raise ManipError(f"{last} cannot be opened in {limits}: {code}")


def opening(name: str) -> None:
    """Report from the child process which file is opened next, and restart the time limit for
    it.
    """
    print(" ".join(name.split()), flush=True)
    _, seconds = signal.getitimer(signal.ITIMER_REAL)
    signal.setitimer(signal.ITIMER_REAL, seconds, seconds)


def answer_parent() -> None:
    """In the child process, run the function that `in_child` sent."""
    seconds, function, arguments = pickle.load(sys.stdin.buffer)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_IN_CHILD, MEMORY_IN_CHILD))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # ends the process; `opening` reads the interval
    signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    try:
        function(*arguments)
    except ManipError as error:
        print(" ".join(str(error).split()), flush=True)
        os._exit(_REFUSED)
    os._exit(0)
