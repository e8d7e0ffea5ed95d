"""Reports in a real headless Chromium: quiet, whole without a network, playing, and fitting wide and narrow windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Browser

from manip_il.evaluation.eval_report import compare_report, eval_report, run_report
from manip_il.evaluation.figures import Curve
from manip_il.evaluation.report import Report
from manip_il.evaluation.tables import CLONING, PolicyRow

from .browser import HEIGHT, Opened, chromium, opened
from .made_evals import far_corner, made_eval, made_pair, small_film
from .test_certificate import ACTIONS, certificate, row
from .test_comparison import STUDY
from .test_rounds import RUN

pytestmark = pytest.mark.slow

CURVE = Curve("DAgger", (RUN,))
RESULT = made_eval("runs/a_policy_with_a_name_that_is_rather_long/round_004/policy/pretrained_model", n=200)
PAIR = made_pair(far_corner, lambda number, _: number % 37 == 0, seeds=2)
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
    """A report, and the captions of its films in the order of the page."""

    report: Report
    captions: tuple[str, ...] = ()


def eval_case() -> Case:
    films = [small_film(number) for number in range(3)]
    report = eval_report(RESULT, "manip-il eval --policy.path=runs/a", {"a": {"b": 1}}, films)
    return Case(report, tuple(film.caption for film in films))


def demo_case() -> Case:
    films, rows = [small_film(number) for number in range(3)], [PolicyRow("DAgger", RESULT, 4000)]
    rows.append(PolicyRow("cloning", RESULT, 4000, RESULT, CLONING))
    report = run_report(rows, films, curves=[CURVE], title="t", verdict="DAgger solves 95.0 %.", command="manip-il x")
    return Case(report, tuple(film.caption for film in films))


CASES = {
    "eval": eval_case,
    "compare": lambda: Case(compare_report(PAIR, "a against b", "manip-il compare a b")),
    "demo": demo_case,
    "study": lambda: Case(compare_report(STUDY, "Study", "manip-il compare x.yaml")),
    "certify": lambda: Case(certificate(row("action", ACTIONS)).report("manip-il robot certify", {})),
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
        assert len(films) == len(case.captions)
        for film, caption in zip(films, case.captions, strict=True):
            assert film.is_visible()
            played = film.evaluate(PLAY)
            assert played["error"] is None
            assert played["duration"] == pytest.approx(1.0, abs=0.1)
            assert played["at"] >= 0.2
            assert played["width"] == 64
            assert caption in film.evaluate("film => film.closest('figure').innerText")
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
            const parts = 'h1, h2, h3, p, li, td, th, dd, dt, summary, video, .figure';
            return [...document.querySelectorAll(parts)]
                .filter(one => one.getBoundingClientRect().right > main.right + 1 && one.offsetParent !== null
                    && !one.closest('thead'))
                .map(one => one.tagName + ': ' + one.textContent.slice(0, 60));
        }"""
    )


def brightness(colour: str) -> int:
    """Of `rgb(1, 2, 3)`."""
    return sum(int(part) for part in colour.removeprefix("rgb(").removesuffix(")").split(","))
