"""Reports in a real headless Chromium: quiet, whole without a network, playing, and fitting wide and narrow windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from playwright.sync_api import Browser

from manip_il.evaluation.compare_report import compare_report
from manip_il.evaluation.eval_report import eval_report
from manip_il.evaluation.film import encode_picture
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.maps import FailureMap, failure_map, paired_maps
from manip_il.evaluation.report import Report, RunReport
from manip_il.evaluation.report_data import CurvePoint, LearningCurve, PolicyRow, Strip
from manip_il.evaluation.study_report import study_report

from .browser import HEIGHT, Opened, chromium, opened
from .made_evals import far_corner, made_comparison, made_eval, small_film
from .test_study import STUDY

pytestmark = pytest.mark.slow


CURVE = LearningCurve(
    tuple(CurvePoint(400 * i, Proportion(9 * i, 40), f"round {i}", 20 * i, 60.0 * i) for i in (1, 2, 3, 4))
)
RESULT = made_eval("runs/a_policy_with_a_name_that_is_rather_long/round_004/policy/pretrained_model", n=200)
COMPARISON = made_comparison(far_corner, lambda number, _: number % 37 == 0, seeds=2)
PLAY = """async (video) => {
    await video.play();
    for (let tries = 0; tries < 100 && video.currentTime < 0.2; tries++) await new Promise(go => setTimeout(go, 50));
    video.pause();
    return {at: video.currentTime, duration: video.duration, width: video.videoWidth, error: video.error};
}"""
STARTED = "video => video.muted && video.loop && !video.paused && video.played.length > 0 && video.played.end(0) > 0"
POSTER = """async (video) => {
    const poster = new Image();
    poster.src = video.poster;
    await poster.decode();
    return [poster.naturalWidth, poster.naturalHeight];
}"""


@dataclass(frozen=True)
class Case:
    """A report, and its films in the order of the page. films: their outcomes, None where not known."""

    report: Report
    films: tuple[bool | None, ...] = ()
    captions: tuple[str, ...] = ()


def eval_case() -> Case:
    films = tuple(small_film(number, success) for number, success in enumerate((True, False, False, True)))
    report = eval_report(RESULT, "manip-il eval --policy.path=runs/a", {"a": {"b": 1}}, films, curve=CURVE)
    ordered = sorted(films, key=lambda film: bool(film.success))
    return Case(report, tuple(film.success for film in ordered), tuple(film.caption for film in ordered))


def quickstart_case() -> Case:
    films = tuple(small_film(number, None) for number in range(3))
    picture = encode_picture(np.full((48, 64, 3), 90, dtype=np.uint8), "png")
    report = RunReport(
        title="panda pick_place",
        verdict="DAgger solves 95.0 % of 200 unseen starts.",
        command="manip-il quickstart",
        rows=(PolicyRow.of("DAgger", RESULT, 4000), PolicyRow.of("cloning", RESULT, 4000, RESULT, "cloning")),
        curve=CURVE,
        films=films,
        strips=(Strip("DAgger", tuple((0.1 * i, picture) for i in range(6))),),
        timings={"training": 65.0},
    )
    return Case(report, (None,) * 3, tuple(film.caption for film in films))


CASES = {
    "eval": eval_case,
    "compare": lambda: Case(compare_report(COMPARISON, "manip-il compare a b")),
    "quickstart": quickstart_case,
    "study": lambda: Case(study_report(STUDY, "Study", "manip-il study x.yaml")),
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]()


@pytest.fixture(scope="module")
def file(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    case.report.write(path)
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_it_opens_quietly_and_fits_the_window(
    browser: Browser, case: Case, file: Path, width: int, scheme: Literal["light", "dark"]
):
    with opened(browser, file, width, scheme) as window:
        window.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
        wide, room = window.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
        assert wide <= room == width
        assert too_wide(window) == []
        assert first_words(window) == case.report.verdict
        paper, ink = window.evaluate("(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))")
        assert (brightness(paper) > brightness(ink)) == (scheme == "light")
        assert (window.console, window.requests) == ([], [])


def test_every_film_plays_in_its_place(browser: Browser, case: Case, file: Path):
    with opened(browser, file, 1280) as window:
        films = window.page.query_selector_all("video")
        assert len(films) == len(case.films)
        for film, success, caption in zip(films, case.films, case.captions, strict=True):
            assert film.is_visible()
            played = film.evaluate(PLAY)
            assert played["error"] is None
            assert played["duration"] == pytest.approx(1.0, abs=0.1)
            assert played["at"] >= 0.2
            assert played["width"] == 64
            assert caption in film.evaluate("film => film.closest('figure').innerText")
            heading = film.evaluate("film => film.closest('.films').previousElementSibling?.innerText")
            assert success is None or heading == ("Successes" if success else "Failures")
        assert (window.console, window.requests) == ([], [])


def test_films_start_by_themselves_in_a_loop_and_have_posters(browser: Browser, case: Case, file: Path):
    with opened(browser, file, 1280) as window:
        for film in window.page.query_selector_all("video"):
            film.scroll_into_view_if_needed()  # browsers wait with those that are out of sight
            window.wait_until(STARTED, film)
            assert film.evaluate(POSTER) == [64, 48]
        assert (window.console, window.requests) == ([], [])


def test_the_page_runs_no_script_of_its_own_and_lets_none_in(browser: Browser, case: Case, tmp_path: Path):
    html = case.report.render()
    slipped_in = html.replace("</main>", "<script>document.title = 'slipped in'</script></main>")
    assert slipped_in != html
    (tmp_path / "report.html").write_text(slipped_in)
    with opened(browser, tmp_path / "report.html", 1280) as window:
        assert window.page.title() != "slipped in"
        assert any("Content Security Policy" in line for line in window.console)


@pytest.mark.parametrize("width", [1280, 390])
def test_the_failure_map_shows_the_marks_of_the_data(browser: Browser, tmp_path: Path, width: int):
    eval_case().report.write(tmp_path / "report.html")
    with opened(browser, tmp_path / "report.html", width) as window:
        for index in range(2):
            assert marks_in(window, index) == counted(failure_map(RESULT))


def test_the_maps_of_a_comparison_show_what_one_side_alone_failed_in(browser: Browser, tmp_path: Path):
    CASES["compare"]().report.write(tmp_path / "report.html")
    with opened(browser, tmp_path / "report.html", 1280) as window:
        for arm, map_of_arm in enumerate(paired_maps(COMPARISON)):
            assert marks_in(window, 2 * arm) == marks_in(window, 2 * arm + 1) == counted(map_of_arm)
        assert marks_in(window, 0)["failed"] > 0 == marks_in(window, 2)["failed"]


def counted(given: FailureMap) -> dict[str, int]:
    return {kind: sum(mark.outcome == kind for mark in given.marks) for kind in ("failed", "shared", "solved")}


def marks_in(window: Opened, index: int) -> dict[str, int]:
    """How many marks of each kind one map has, all of them inside its frame and large enough to be visible."""
    return window.evaluate(
        """(index) => {
            const map = document.querySelectorAll('svg.map')[index], frame = map.getBoundingClientRect();
            const inside = (mark) => {
                const box = mark.querySelector('circle').getBoundingClientRect();
                return box.width > 2 && box.left >= frame.left && box.right <= frame.right
                    && box.top >= frame.top && box.bottom <= frame.bottom;
            };
            const count = (kind) => [...map.querySelectorAll('.mark-' + kind)].filter(inside).length;
            return {failed: count('failed'), shared: count('shared'), solved: count('solved')};
        }""",
        index,
    )


def first_words(window: Opened) -> str:
    """The first heading's words, which must stand in the first window without scrolling."""
    words, bottom = window.evaluate(
        """() => {
            const first = document.querySelector('h1, h2, h3, table, svg, video');
            return [first.innerText, first.getBoundingClientRect().top];
        }"""
    )
    assert bottom < HEIGHT / 4
    return str(words).replace("\N{NO-BREAK SPACE}", " ")


def too_wide(window: Opened) -> list[str]:
    """Words that stick out of the page's column."""
    return window.evaluate(
        """() => {
            const main = document.querySelector('main').getBoundingClientRect();
            const parts = 'h1, h2, h3, p, li, td, th, dd, dt, summary, video, svg.map, .bar-line';
            return [...document.querySelectorAll(parts)]
                .filter(one => one.getBoundingClientRect().right > main.right + 1 && one.offsetParent !== null
                    && !one.closest('thead'))
                .map(one => one.tagName + ': ' + one.textContent.slice(0, 60));
        }"""
    )


def brightness(colour: str) -> int:
    """Of `rgb(1, 2, 3)`."""
    return sum(int(part) for part in colour.removeprefix("rgb(").removesuffix(")").split(","))
