"""Every command line and snippet in README, docs and help runs, verbatim but for sizes."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from ..store.servers import TOKEN, Hub, hub_server, s3_server
from ..warm import Warm
from .ours import Ours
from .pages import PAGES, ROOT, Line, blocks, help_lines, page_lines
from .sizes import shrink_study
from .stock import Stock
from .workplace import PROGRAM, LeRobot, Workplace

BUCKET = "robots"  # the one in the docs
_DRAWS = (
    "--cameras=",
    "redraw",
    "--video",
    "data render",
    "manip-il eval --check",
    "datasets/seen",
    "reward ask",
)


@pytest.fixture(scope="session")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Stock:
    return Stock(tmp_path_factory.mktemp("stock"))


@pytest.fixture(scope="session")
def running_hub() -> Iterator[Hub]:
    with hub_server() as hub:
        yield hub


@pytest.fixture(scope="session")
def bucket() -> Iterator[dict[str, str]]:
    """What a program must have in its environment to find it."""
    with s3_server(BUCKET) as variables:
        yield variables


@pytest.fixture(scope="module")
def lerobot(running_hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LeRobot]:
    """Runs a command of LeRobot's, or a script, in a folder.

    The Hub of the tests is the only one that it knows.
    """
    home = tmp_path_factory.mktemp("home")
    clean = {
        name: value for name, value in os.environ.items() if not name.startswith(("HF_", "HUGGING"))
    }
    clean |= {"HF_ENDPOINT": running_hub.url, "HF_HOME": str(home / "hf"), "HF_TOKEN": TOKEN}
    clean |= {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}
    clean |= {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": str(ROOT)}
    with Warm(clean, home, ["manip_il.lerobot_plugin"]) as warm:

        def run(words: list[str], folder: Path) -> None:
            done = warm.run(*words, folder=folder)
            assert done.returncode == 0, (
                f"{words} ended with {done.returncode}: {(done.stdout + done.stderr)[-4000:]}"
            )

        yield run


@pytest.fixture
def workplace(
    tmp_path: Path,
    stock: Stock,
    lerobot: LeRobot,
    running_hub: Hub,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Workplace]:
    """A folder with the repository's configs, studies made small, and servers that answer for
    the Hub and S3.
    """
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    for study in (tmp_path / "configs" / "studies").glob("*.yaml"):
        shrink_study(study)
    page = request.node.callspec.params.get("page")
    stored = any("s3://" in block.text for block in blocks(page)) if page else False
    servers = request.getfixturevalue("bucket") if stored else {}  # takes seconds to start
    for name, value in (servers | {"HF_TOKEN": TOKEN, "HF_ENDPOINT": running_hub.url}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with Ours(tmp_path.parent / f"{tmp_path.name}.log", os.environ) as ours:
        yield Workplace(tmp_path, ours, stock, lerobot)


def _pages() -> list[object]:
    """Pages with something to run; `gl` where it draws."""
    found: list[object] = []
    for page in PAGES:
        texts = [block.text for block in blocks(page) if block.language != "text"]
        marks = [pytest.mark.gl] if any(word in text for text in texts for word in _DRAWS) else []
        if texts:
            found.append(pytest.param(page, marks=marks, id=page))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("page", _pages())
def test_every_line_of_a_page_runs(page: str, workplace: Workplace):
    for block in blocks(page):
        workplace.run_block(block)


def _only_in_help() -> list[Line]:
    """The examples that no page shows: its lines run above."""
    shown = {line.words for page in PAGES for line in page_lines(page)}
    return [line for line in help_lines() if line.words not in shown]


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize("line", _only_in_help(), ids=lambda line: line.where)
def test_the_example_in_the_help_runs(line: Line, workplace: Workplace):
    assert line.words[0] == PROGRAM
    workplace.run(line)
