"""A YAML file that a user wrote, or one clear line about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from manip_il.errors import UsageError


def read_yaml(path: Path, what: str) -> Any:
    """What is in the file, without tags that run code; `UsageError` where it cannot be read. what: it should be."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}; expected {what}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
