"""The report is one file that reaches nothing outside, escapes what it is given, and shows the inputs' numbers."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from manip_il.errors import ManipError
from manip_il.evaluation.report import (
    CurvePoint,
    Film,
    LearningCurve,
    Paths,
    PolicyRow,
    Report,
    Strip,
    render_report,
    write_report,
)
from manip_il.evaluation.report_data import flatten, format_seconds
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.svg import Axis, axis_for

PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 20
JPEG = b"\xff\xd8\xff\xe0" + b"\0" * 20
MP4 = b"\0\0\0\x18ftypisom" + b"\0" * 20
VOID = {"meta", "link", "img", "br", "hr", "input"}

ROWS = (
    PolicyRow("Expert", Proportion(199, 200), None, Proportion(198, 200), 52.25, kind="expert"),
    PolicyRow("Cloning", Proportion(171, 200), 1234, Proportion(160, 200), 70.5, Proportion(90, 200), kind="cloning"),
    PolicyRow("DAgger", Proportion(197, 200), 1230, Proportion(195, 200), 55.75, Proportion(180, 200)),
)
CURVE = LearningCurve(
    dagger=tuple(CurvePoint(n, Proportion(k, 50), f"round {i}") for i, (n, k) in enumerate([(400, 30), (1230, 49)])),
    cloning=(CurvePoint(1230, Proportion(41, 50)),),
    expert=Proportion(199, 200),
)
HAND = np.linspace([0.3, -0.2, 0.4], [0.6, 0.2, 0.1], 500).astype(np.float64)
REPORT = Report(
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


class Page(HTMLParser):
    """Tags with their attributes, and whether every element was closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(render_report(REPORT))


def test_every_element_is_closed(page: Page):
    assert page.open == []


def test_the_page_reaches_nothing_outside(page: Page):
    html = render_report(REPORT)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|<script", html)
    for tag, attributes in page.tags:
        for name in ("src", "href", "srcset", "poster", "xlink:href"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes)
    assert any("default-src 'none'" in (attributes.get("content") or "") for _, attributes in page.tags)


def test_the_verdict_is_the_first_heading(page: Page):
    assert next(i for i, (tag, _) in enumerate(page.tags) if tag == "h1") < min(
        i for i, (tag, _) in enumerate(page.tags) if tag in {"table", "h2", "svg"}
    )
    assert "DAgger beats cloning." in page.text


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
    widths = [a["width"] for tag, a in page.tags if tag == "rect" and (a.get("class") or "").startswith("bar ")]
    assert widths == ["99.50%", "85.50%", "98.50%"]


def test_pictures_and_films_are_inside(page: Page):
    assert sum(tag == "img" for tag, _ in page.tags) == 2
    video = next(attributes for tag, attributes in page.tags if tag == "video")
    assert {"controls", "muted", "autoplay", "loop", "playsinline"} <= set(video)
    assert (video["src"] or "").startswith("data:video/mp4;base64,")
    assert (video["poster"] or "") == "data:image/jpeg;base64," + base64.b64encode(JPEG).decode()


def test_whatever_comes_from_outside_is_escaped():
    evil = '<script>alert("x")</script>&'
    row = replace(ROWS[0], name=evil)
    report = Report(
        title=evil, verdict=evil, command=evil, rows=(row,), facts=(evil,), pictures_note=evil, disturbance=evil,
        curve=LearningCurve((CurvePoint(10, Proportion(1, 2), evil),)),
        films=(Film(evil, MP4, evil),), strips=(Strip(evil, ((0.0, PNG),), evil),),
        paths=(Paths(evil, HAND, HAND, HAND[0], caption=evil),),
        config={evil: evil}, fingerprint={evil: [evil]}, timings={evil: 1.0},
    )  # fmt: skip
    page = Page(render_report(report))
    assert page.open == []
    assert not any(tag == "script" for tag, _ in page.tags)
    assert page.text.count('alert("x")') >= 14


def test_the_least_report_still_stands():
    page = Page(render_report(Report("t", "v", "c", (PolicyRow("p", Proportion(0, 1)),))))
    assert page.open == []
    assert "How it looks" not in page.text
    assert "Success, disturbed" not in page.text


def test_the_same_report_is_the_same_bytes(tmp_path: Path):
    write_report(tmp_path / "new" / "report.html", REPORT)
    assert (tmp_path / "new" / "report.html").read_bytes() == render_report(REPORT).encode()


def test_what_cannot_be_shown_is_refused_by_name():
    with pytest.raises(ManipError, match="has no policy to show"):
        replace(REPORT, rows=())
    with pytest.raises(ManipError, match="verdict is empty"):
        replace(REPORT, verdict=" ")
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


def test_a_row_takes_its_numbers_from_an_evaluation():
    episodes = tuple(EpisodeResult(i, i > 0, i > 1, 40, 0.0, detail={"steps_to_success": 10 * i}) for i in range(4))
    result = EvalResult("mlp", "panda", "pick", {}, episodes, EvalSettings(100, 0.02))
    row = PolicyRow.of("BC", result, labels=40, disturbed=result, kind="cloning")
    assert row == PolicyRow("BC", Proportion(3, 4), 40, Proportion(2, 4), 20.0, Proportion(3, 4), "cloning")


def test_a_wide_span_of_labels_takes_a_logarithmic_axis():
    assert not axis_for([100, 1000]).log
    assert axis_for([100, 10_000]).log
    assert not axis_for([0, 10_000]).log
    assert not axis_for([100, 10_000], log=False).log


AXES = [Axis(0, 100), Axis(1, 2), Axis(900, 6800), Axis(30, 2e6, log=True), Axis(450, 9e3, log=True)]


@pytest.mark.parametrize("axis", AXES)
def test_ticks_are_few_lie_on_the_axis_and_keep_their_order(axis: Axis):
    ticks = axis.ticks()
    places = [axis.percent(tick) for tick in ticks]
    assert 2 <= len(ticks) <= 6
    assert all(0 <= place <= 100 for place in places)
    assert places == sorted(places)


def test_one_point_alone_has_an_axis():
    axis = axis_for([500])
    assert 0 < axis.percent(500) < 100


def test_a_tree_is_flattened_to_the_command_lines_names():
    tree = {"a": {"b": {"c": 1}, "d": {}}, "e": [1, True], "f": ()}
    assert flatten(tree) == {"a.b.c": "1", "a.d": "(empty)", "e": "1, true", "f": "(empty)"}


@pytest.mark.parametrize(
    ("seconds", "words"), [(4.21, "4.2 s"), (59.96, "60.0 s"), (200, "3 min 20 s"), (3900, "1 h 05 min")]
)
def test_durations_read_well(seconds: float, words: str):
    assert format_seconds(seconds) == words


def test_a_curve_that_knows_its_costs_is_drawn_over_each_of_them():
    points = tuple(
        CurvePoint(100 * i, Proportion(10 * i, 40), f"round {i}", episodes=5 * i, seconds=400.0 * i) for i in (1, 2, 3)
    )
    page = Page(render_report(replace(REPORT, curve=LearningCurve(points, target=0.6))))
    assert page.open == []
    assert sum(attributes.get("class") == "curve" for _, attributes in page.tags) == 3
    assert sum(attributes.get("class") == "target-level" for _, attributes in page.tags) == 3
    for words in (
        "expert labels",
        "wall-clock [min]",
        "target, 60.0 %",
        "round 2, 200 labels, 10 episodes, 13 min 20 s",
    ):
        assert words in page.text
    labels_only = Page(render_report(REPORT))
    assert sum(attributes.get("class") == "curve" for _, attributes in labels_only.tags) == 1
    assert "Success against labels" in labels_only.text


def test_a_cost_below_nothing_is_refused():
    with pytest.raises(ManipError, match=r"-1.0 seconds"):
        CurvePoint(1, Proportion(1, 2), seconds=-1.0)
