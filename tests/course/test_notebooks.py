"""The course's notebooks run from a fresh kernel, and every check in them fails until the reader
has done its part.
"""

import ast
import contextlib
import importlib
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

COURSE = Path(__file__).resolve().parents[2] / "docs" / "course"
WHOLE = ("1_cloning", "3_seeing")  # nothing to fill in
SMALL = {  # the sizes at which these run here: what they show takes larger ones
    "(1, 10, 50, 100)": "(1, 2, 3, 4)",
    "demos[100]": "demos[4]",
    "clones[50]": "clones[3]",
    "(10, 100)": "(2, 4)",
    '"carry", env, 12': '"carry", env, 4',
    '"reach", reach, 50': '"reach", reach, 8',
    "env, 40, ": "env, 8, ",
    "count=200": "count=40",
    "redraw=1000": "redraw=60",
    "episodes=50": "episodes=2",
    "episodes=30": "episodes=2",
    '"demonstrations": 20': '"demonstrations": 3',
    '"validation_episodes": 20': '"validation_episodes": 1',
    '"validation_episodes": 30': '"validation_episodes": 2',
    "steps=1000": "steps=20",
    "steps=600": "steps=20",
    "steps=300": "steps=20",
    "**FIT": '**{**FIT, "steps": 4}',
    "rounds=ROUNDS": "rounds=1",
    "round(5 * counts[-1] / len(demos))": "2",
    '"steps": 350': '"steps": 4',
    '"steps": 500': '"steps": 4',
    "30_000": "1_000",
    "15_000": "500",
}
EXERCISES = {"2_dagger": 5, "4_rewards": 4}  # and how many checks they have at least
FULL = "2_dagger"  # up to its last check this one runs at the sizes that a reader runs
SECONDS = 900  # of a cell, on a machine that does much else


def read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(COURSE / f"{name}.ipynb", as_version=4)


def shrink(cells: list[nbformat.NotebookNode]) -> None:
    for cell in cells:
        for large, small in SMALL.items():
            cell.source = cell.source.replace(large, small)


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NotebookClient]:
    """One kernel for all notebooks, as its imports take long.

    It keeps its files and fetches nothing.
    """
    folder, empty = str(tmp_path_factory.mktemp("course")), nbformat.v4.new_notebook()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", folder)
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
        client = NotebookClient(
            empty,
            timeout=SECONDS,
            startup_timeout=SECONDS,
            resources={"metadata": {"path": folder}},
        )
        with client.setup_kernel():
            yield client


def begin(kernel: NotebookClient, book: nbformat.NotebookNode) -> None:
    """Open a notebook in the kernel, without the names of the one before."""
    forget = nbformat.v4.new_code_cell("%reset -f")
    kernel.nb = nbformat.v4.new_notebook(cells=[forget])
    kernel.execute_cell(forget, 0)
    kernel.nb = book


def tag_of(cell: nbformat.NotebookNode) -> str:
    return next(iter(cell.metadata.get("tags", [])), "")


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize("name", WHOLE)
def test_a_notebook_runs(name: str, kernel: NotebookClient):
    book = read(name)
    shrink(book.cells)
    begin(kernel, book)
    for place, cell in enumerate(book.cells):
        kernel.execute_cell(cell, place)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXERCISES)
def test_each_check_fails_on_the_unfilled_cell_and_passes_on_the_solution(
    name: str, kernel: NotebookClient
):
    cells, solved, checks = read(name).cells, read(f"{name}_solutions"), 0
    last = max(place for place, cell in enumerate(cells) if tag_of(cell) == "check")
    shrink(solved.cells[1 + last :] if name == FULL else solved.cells)
    begin(kernel, deepcopy(solved))
    for place, (unfilled, cell) in enumerate(zip(cells, solved.cells, strict=True)):
        if tag_of(cell) == "exercise":
            assert tag_of(cells[place + 1]) == "check"
            with contextlib.suppress(CellExecutionError):
                kernel.execute_cell(deepcopy(unfilled), place)
            with pytest.raises(CellExecutionError):
                kernel.execute_cell(deepcopy(cells[place + 1]), place + 1)
            checks += 1
        cell.source = cell.source.replace("episodes=50", "episodes=10")
        kernel.execute_cell(cell, place)
    assert checks == sum(tag_of(cell) == "check" for cell in cells) >= EXERCISES[name]


@pytest.mark.parametrize("name", EXERCISES)
def test_the_solutions_differ_from_the_exercises_in_the_exercises_alone(name: str):
    for unfilled, solved in zip(read(name).cells, read(f"{name}_solutions").cells, strict=True):
        assert (unfilled.source != solved.source) == (tag_of(unfilled) == "exercise"), solved.source


@pytest.mark.parametrize("path", sorted(COURSE.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_small_and_holds_no_output(path: Path):
    cells = [cell for cell in read(path.stem).cells if cell.cell_type == "code"]
    assert path.stat().st_size < 200_000
    assert [cell for cell in cells if cell.outputs or cell.execution_count] == []


@pytest.mark.parametrize("path", sorted(COURSE.glob("*.ipynb")), ids=lambda path: path.stem)
def test_they_import_public_names_that_exist(path: Path):
    cells = [cell.source for cell in read(path.stem).cells if cell.cell_type == "code"]
    for node in ast.walk(ast.parse("\n".join(cells))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("manip_il"):
            module = importlib.import_module(node.module or "")
            for name in node.names:
                assert hasattr(module, name.name), name.name
                assert not name.name.startswith("_")
