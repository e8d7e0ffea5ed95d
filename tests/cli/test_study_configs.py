"""The studies that come along are sound."""

from __future__ import annotations

from pathlib import Path

import pytest

from manip_il.cli.study_file import read_plan

STUDIES = sorted((Path(__file__).parents[2] / "configs/studies").glob("*.yaml"))


def test_there_are_studies():
    assert len(STUDIES) >= 4


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_that_comes_along_is_sound_and_says_its_own_command(path: Path):
    plan = read_plan(path, None)
    assert plan.baseline in plan.arms
    first = path.read_text().splitlines()[0]
    assert first == f"# manip-il study configs/studies/{path.name} --output_dir=runs/{path.stem}"
