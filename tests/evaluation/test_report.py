"""The report of a run is one file that reaches nothing outside, escapes what it is given, and shows the numbers."""

import base64
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.errors import ManipError
from manip_il.evaluation.episodes import EpisodeResult, EvalSettings
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.report import RunReport
from manip_il.evaluation.report_data import (
    CurvePoint,
    Film,
    LearningCurve,
    Paths,
    PolicyRow,
    Strip,
    flatten,
    format_seconds,
)
from manip_il.evaluation.results import EvalResult

from .page import EVIL, Page, page_of

PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 20
JPEG = b"\xff\xd8\xff\xe0" + b"\0" * 20
MP4 = b"\0\0\0\x18ftypisom" + b"\0" * 20

ROWS = (
    PolicyRow("Expert", Proportion(199, 200), None, Proportion(198, 200), 52.25, kind="expert"),
    PolicyRow("Cloning", Proportion(171, 200), 1234, Proportion(160, 200), 70.5, Proportion(90, 200), kind="cloning"),
    PolicyRow("DAgger", Proportion(197, 200), 1230, Proportion(195, 200), 55.75, Proportion(180, 200)),
)
CURVE = LearningCurve(
    dagger=tuple(CurvePoint(n, Proportion(k, 50), f"round {i}") for i, (n, k) in enumerate([(400, 30), (1230, 49)])),
    cloning=(CurvePoint(1230, Proportion(41, 50)),),
)
HAND = np.linspace([0.3, -0.2, 0.4], [0.6, 0.2, 0.1], 500).astype(np.float64)
REPORT = RunReport(
    title="panda pick",
    verdict="DAgger beats cloning.",
    command="manip-il quickstart --seed=3",
    rows=ROWS,
    curve=CURVE,
    films=(Film("DAgger", MP4, poster=JPEG),),
    strips=(Strip("Cloning", ((0.0, PNG), (0.5, PNG))),),
    paths=(Paths("Expert", HAND, HAND - 0.01, HAND[-1], dt=0.05),),
    config={"policy": {"hidden": 256, "name": None}},
    fingerprint={"mujoco": "3.11.0"},
    timings={"training": 200.0},
)


@pytest.fixture(scope="module")
def page() -> Page:
    return page_of(REPORT)


def test_the_numbers_are_the_inputs(page: Page):
    for row in ROWS:
        for proportion in filter(None, (row.success, row.success_at_end, row.disturbed)):
            assert str(proportion) in page.text
        assert f"{row.steps_to_success:.1f}" in page.text
    assert "1,234" in page.text
    assert "DAgger, round 1, 1,230 labels 98.0 % [" in page.text
    assert "policy.hidden 256 policy.name none" in page.text
    assert "3 min 20 s" in page.text


def test_bars_are_as_long_as_the_rates(page: Page):
    assert page.bar_widths("") == ["99.50%", "85.50%", "98.50%"]


def test_pictures_and_films_are_inside(page: Page):
    assert sum(tag == "img" for tag, _ in page.tags) == 2
    video = next(attributes for tag, attributes in page.tags if tag == "video")
    assert {"controls", "muted", "autoplay", "loop", "playsinline"} <= set(video)
    assert video["src"] == "data:video/mp4;base64," + base64.b64encode(MP4).decode()
    assert video["poster"] == "data:image/jpeg;base64," + base64.b64encode(JPEG).decode()
    assert "25.0 s" in page.text  # how long the paths took


def test_whatever_comes_from_outside_is_escaped():
    report = RunReport(
        title=EVIL, verdict=EVIL, command=EVIL, rows=(replace(ROWS[0], name=EVIL),), facts=(EVIL,),
        pictures_note=EVIL, disturbance=EVIL, curve=LearningCurve((CurvePoint(10, Proportion(1, 2), EVIL),), name=EVIL),
        films=(Film(EVIL, MP4, EVIL),), strips=(Strip(EVIL, ((0.0, PNG),), EVIL),),
        paths=(Paths(EVIL, HAND, HAND, HAND[0], caption=EVIL),),
        config={EVIL: EVIL}, fingerprint={EVIL: [EVIL]}, timings={EVIL: 1.0},
    )  # fmt: skip
    assert page_of(report).text.count('alert("x")') >= 16


def test_the_least_report_still_stands():
    page = page_of(RunReport(title="t", verdict="v", command="c", rows=(PolicyRow("p", Proportion(0, 1)),)))
    assert "How it looks" not in page.text
    assert "Success, disturbed" not in page.text


def test_a_report_is_written_whole_into_a_new_folder(tmp_path: Path):
    REPORT.write(tmp_path / "new" / "report.html")
    assert (tmp_path / "new" / "report.html").read_bytes() == REPORT.render().encode()


@pytest.mark.parametrize("what", ["title", "verdict", "command"])
def test_a_report_without_its_first_words_is_refused(what: str):
    with pytest.raises(ManipError, match=f"{what} is empty"):
        replace(REPORT, **{what: " "})


def test_what_cannot_be_shown_is_refused_by_name():
    with pytest.raises(ManipError, match="has no policy to show"):
        replace(REPORT, rows=())
    with pytest.raises(ManipError, match="not a PNG"):
        Strip("p", ((0.0, b"GIF89a"),))
    with pytest.raises(ManipError, match="not an MP4"):
        Film("p", b"")
    with pytest.raises(ManipError, match="the poster is not a JPEG"):
        Film("p", MP4, poster=PNG)
    with pytest.raises(ManipError, match=r"\(4, 3\).*\(5, 3\)"):
        Paths("p", np.zeros((4, 3)), np.zeros((5, 3)), np.zeros(3))
    with pytest.raises(ManipError, match="not finite"):
        Paths("p", np.full((4, 3), np.nan), np.zeros((4, 3)), np.zeros(3))


def test_paths_without_a_goal_draw_and_name_none():
    shown = replace(REPORT, paths=(Paths("Expert", HAND, HAND - 0.01, None, dt=0.05),)).render()
    with_goal, goal = REPORT.render(), '<i class="key goal">'
    assert with_goal.count('<circle class="goal"') == 2
    assert '<circle class="goal"' not in shown
    assert shown.count(goal) == with_goal.count(goal) - 1


def test_a_row_takes_its_numbers_from_an_evaluation():
    episodes = tuple(EpisodeResult(i, i > 0, i > 1, 40, 0.0, detail={"steps_to_success": 10 * i}) for i in range(4))
    result = EvalResult("mlp", "panda", "pick", {}, episodes, EvalSettings(100, 0.02))
    row = PolicyRow.of("BC", result, labels=40, disturbed=result, kind="cloning")
    assert row == PolicyRow("BC", Proportion(3, 4), 40, Proportion(2, 4), 20.0, Proportion(3, 4), "cloning")


def test_a_tree_is_flattened_to_the_command_lines_names():
    tree = {"a": {"b": {"c": 1}, "d": {}}, "e": [1, True], "f": ()}
    assert flatten(tree) == {"a.b.c": "1", "a.d": "(empty)", "e": "1, true", "f": "(empty)"}


@pytest.mark.parametrize(
    ("seconds", "words"), [(4.21, "4.2 s"), (59.96, "60.0 s"), (200, "3 min 20 s"), (3900, "1 h 05 min")]
)
def test_durations_read_well(seconds: float, words: str):
    assert format_seconds(seconds) == words
