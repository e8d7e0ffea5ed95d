"""The asking page in a real headless Chromium: keys, taps, undo, and what is kept and saved."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from manip_il.chapter.preferences.asking import render_films, render_page
from manip_il.chapter.preferences.pairs import Pairs, Preferences
from manip_il.evaluation.film import encode_mp4

from ..evaluation.browser import PATIENCE, Opened, chromium, opened
from .conftest import clips_of

pytestmark = pytest.mark.slow
COUNT = 4
SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def pairs(clips) -> Pairs:
    tree = clips.pairs.to_json()
    return Pairs.from_json(tree | {"pairs": tree["pairs"][:COUNT]})


@pytest.fixture(scope="module")
def page(pairs, tmp_path_factory) -> Path:
    shades = [
        encode_mp4([np.full((48, 48, 3), 20 * n, np.uint8)] * 5, 10) for n in range(2 * COUNT)
    ]
    path = tmp_path_factory.mktemp("ask") / "ask.html"
    films = [shades[2 * n : 2 * n + 2] for n in range(COUNT)]
    path.write_text(render_page(pairs, "Lift the <b>cube</b>.", films), encoding="utf-8")
    return path


def count(window: Opened) -> str:
    return window.page.inner_text("#count")


def saved(window: Opened, pairs: Pairs, folder: Path) -> Preferences:
    """What the page downloads, read as `fit` does."""
    window.page.fill("#who", "Ada")
    with window.page.expect_download() as download:
        window.page.click("form button")
    assert download.value.suggested_filename == "preferences.json"
    download.value.save_as(folder / "preferences.json")
    return Preferences.read(folder / "preferences.json", pairs)


@pytest.mark.system
def test_keys_answer_undo_and_skip_and_the_download_is_what_fit_reads(
    browser, page, pairs, tmp_path
):
    with opened(browser, page, 1280) as window:
        assert window.page.inner_text(".instruction") == "Lift the <b>cube</b>."
        assert count(window) == "Pair 1 of 4"
        for key in ("ArrowLeft", "ArrowRight", "u", "ArrowDown", "s"):
            window.page.keyboard.press(key)
        assert count(window) == "Pair 4 of 4"
        window.page.keyboard.press("ArrowRight")
        assert count(window) == "4 pairs answered"
        window.page.keyboard.press("ArrowRight")  # answers nothing more
        found = saved(window, pairs, tmp_path)
        assert [(one.pair, one.answer) for one in found.answers] == list(
            enumerate(("left", "equal", "skip", "right"))
        )
        assert found.who == "Ada"
        assert all(one.when for one in found.answers)
        assert (window.console, window.requests) == ([], [])


def test_taps_on_a_phone_answer(browser, page):
    context = browser.new_context(
        viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True
    )
    try:
        context.set_default_timeout(1000 * PATIENCE)
        phone = context.new_page()
        phone.goto(page.resolve().as_uri())
        phone.tap("button.film[data-answer=right]")
        phone.tap(".choices button[data-answer=equal]")
        phone.tap("#skip")
        phone.tap("#undo")
        kept = json.loads(phone.evaluate("localStorage.getItem(Object.keys(localStorage)[0])"))
        assert [one["answer"] for one in kept["answers"]] == ["right", "equal"]
        left, right = (phone.locator(f"#{side}").bounding_box() for side in ("left", "right"))
        assert left["y"] == right["y"]
        assert left["x"] + left["width"] < right["x"]
        assert phone.locator("form button").bounding_box()["x"] >= 0
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    finally:
        context.close()


def test_the_page_opened_again_has_the_answers_and_the_name(browser, page):
    with opened(browser, page, 1280) as window:
        window.page.keyboard.press("ArrowLeft")
        window.wait_until("document.getElementById('count').innerText === 'Pair 2 of 4'")
        window.page.fill("#who", "Ada")
        window.page.keyboard.press("ArrowLeft")  # in the name, it is no answer
        again = window.page.context.new_page()
        again.goto(page.resolve().as_uri())
        for _ in range(200):  # a busy browser hands on late what is kept, and a tab reads it once
            if again.input_value("#who"):
                break
            again.close()
            window.page.wait_for_timeout(500)
            again = window.page.context.new_page()
            again.goto(page.resolve().as_uri())
        assert again.input_value("#who") == "Ada"
        assert again.inner_text("#count") == "Pair 2 of 4"


def test_no_script_but_its_own_runs(browser, page, tmp_path):
    slipped = page.read_text().replace(
        "</main>", "<script>document.title = 'slipped in'</script></main>"
    )
    (tmp_path / "ask.html").write_text(slipped)
    with opened(browser, tmp_path / "ask.html", 1280) as window:
        assert window.page.title() != "slipped in"
        assert count(window) == "Pair 1 of 4"


@pytest.mark.gl
def test_films_are_the_recorded_states_of_the_clips():
    clips = clips_of([SAMPLE], 2, 4)
    calls: list[None] = []
    films = render_films(clips, on_pair=lambda: calls.append(None))
    assert len(calls) == len(films) == 2
    assert all(film[4:8] == b"ftyp" for pair in films for film in pair)
    assert films[0][0] != films[0][1]
