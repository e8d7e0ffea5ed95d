"""The image is built from what is locked, holds nothing but the program, and may run as anyone."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from manip_il.sim.gl import PACKAGES

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def dockerfile() -> str:
    """Without comments, one instruction a line."""
    text = "\n".join(line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.startswith("#"))
    return text.replace("\\\n", " ")


@pytest.fixture(scope="module")
def final(dockerfile: str) -> str:
    """The last stage."""
    return re.split(r"^FROM ", dockerfile, flags=re.MULTILINE)[-1]


def test_what_is_copied_is_sent_and_nothing_else_is(dockerfile):
    lines = re.findall(r"^COPY (?!--from)(.*)$", dockerfile, flags=re.MULTILINE)
    copied = {name for line in lines for name in line.split()[:-1]}
    first, *ignored = re.findall(r"^[^#\n].*", (ROOT / ".dockerignore").read_text(), flags=re.MULTILINE)
    assert first == "*"
    assert {line[1:] for line in ignored if line.startswith("!")} == copied
    assert all((ROOT / name).exists() for name in copied)
    assert not {"runs", "datasets", ".git", ".venv", ".tools", "tests"} & copied


def test_the_final_image_is_debians_without_build_tools_and_not_roots(final):
    assert final.startswith("debian:trixie-slim\n")
    assert re.search(r"^USER [1-9]\d*:[1-9]\d*$", final, flags=re.MULTILINE)
    assert not re.search(r"\b(pip|uv pip|python3-venv|gcc|build-essential)\b", final)
    assert 'ENTRYPOINT ["manip-il"]' in final


def test_whatever_is_written_goes_under_tmp(final):
    settings = dict(re.findall(r"\b((?:HOME|\w+_HOME|\w+_DIR|\w+DIR))=(\S+)", final))
    assert {"HOME", "HF_HOME", "XDG_CACHE_HOME"} <= settings.keys()
    assert all(place == "/tmp" or place.startswith("/tmp/") for place in settings.values())


def test_the_image_and_make_bring_the_packages_that_errors_name(final):
    assert PACKAGES in final
    assert f"({PACKAGES})" in (ROOT / ".ci" / "system").read_text()
