"""Reports in a real headless Chromium: quiet, whole without a network, and fitting wide and
narrow windows.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from manip_il.evaluation.eval_report import compare_report, eval_report
from manip_il.evaluation.report import Report

from .browser import HEIGHT, Opened, chromium, opened
from .made_evals import made_eval, made_pair, often, seldom, small_film

pytestmark = pytest.mark.slow

RESULT = made_eval(
    "runs/a_policy_with_a_name_that_is_rather_long/round_004/policy/pretrained_model", n=200
)
PAIR = made_pair(often, seldom, seeds=2)


def made_report() -> Report:
    """With conditions, films and settings."""
    films = [small_film(number) for number in range(3)]
    return replace(
        eval_report(RESULT, films),
        command="manip-il eval --policy.path=runs/a",
        config={"a": {"b": 1}},
    )


REPORTS = {"eval": made_report, "compare": lambda: compare_report(PAIR, "a against b")}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module", params=REPORTS)
def report(request: pytest.FixtureRequest) -> Report:
    return REPORTS[request.param]()


@pytest.fixture(scope="module")
def file(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report.write(tmp_path_factory.mktemp("report"))


@pytest.mark.system
@pytest.mark.parametrize("width", [1280, 390])
def test_it_opens_quietly_and_fits_the_window(
    browser: Browser, report: Report, file: Path, width: int
):
    with opened(browser, file, width) as window:
        window.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
        wide, room = window.evaluate(
            "[document.documentElement.scrollWidth, document.documentElement.clientWidth]"
        )
        assert wide <= room == width
        assert too_wide(window) == []
        assert first_words(window) == report.verdict
        assert (window.console, window.requests) == ([], [])


def first_words(window: Opened) -> str:
    """The first heading's words, which must stand in the first window without scrolling."""
    words, bottom = window.evaluate("""() => {
            const first = document.querySelector('h1, h2, h3, table, svg, video');
            return [first.innerText, first.getBoundingClientRect().top];
        }""")
    assert bottom < HEIGHT / 4
    return str(words).replace("\N{NO-BREAK SPACE}", " ")


def too_wide(window: Opened) -> list[str]:
    """Words that stick out of the page's column."""
    return window.evaluate("""() => {
            const main = document.querySelector('main').getBoundingClientRect();
            const parts = 'h1, h2, h3, p, li, td, th, dd, dt, summary, video, .figure';
            return [...document.querySelectorAll(parts)]
                .filter(one => one.getBoundingClientRect().right > main.right + 1 && one.offsetParent !== null
                    && !one.closest('thead'))
                .map(one => one.tagName + ': ' + one.textContent.slice(0, 60));
        }""")
