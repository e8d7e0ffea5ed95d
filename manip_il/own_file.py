"""The one place that runs a Python file of the user's own, to get the class that it describes."""

import hashlib
import inspect
import sys
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

from manip_il.errors import OWN, UsageError, told


@cache
def own_class[T](path: Path, base: type[T], wanted: str) -> type[T]:
    """Run a file and return its one subclass of `base` whose name does not begin with "_".

    Args:
        path: The absolute path of a Python file that the user gave.
        base: Class that the file's class must have as a base.
        wanted: Public name of `base`, and the page on how to write such a file, for messages.

    Raises:
        UsageError: If there is no such file, it cannot be run, or has no or several such classes.
    """
    if not path.is_file():
        raise UsageError(f"{path} does not exist; expected a Python file with your own {wanted}")
    name = f"{OWN}{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    module = sys.modules[name] = ModuleType(name)  # dataclasses look it up there
    module.__file__ = str(path)
    try:
        SourceFileLoader(name, str(path)).exec_module(module)
    except Exception as error:
        del sys.modules[name]
        why = " ".join(told(error).split())
        raise UsageError(f"{path} cannot be run: {why}") from error
    found = [
        value
        for key, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, base) and value.__module__ == name
        if not key.startswith("_")
    ]
    if len(found) != 1:
        names = ", ".join(cls.__name__ for cls in found) or "none"
        raise UsageError(f"{base.__name__}s in {path}: {names}; expected one subclass of {wanted}")
    return found[0]


def source_hash(cls: type) -> str:
    """Return the SHA-256 of the file that a class is written in."""
    return hashlib.sha256(Path(inspect.getfile(cls)).read_bytes()).hexdigest()
