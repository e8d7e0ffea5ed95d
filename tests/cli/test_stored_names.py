"""What a dataset, a policy or an evaluation names is never a path: nothing outside its folder is
opened or run.
"""

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import manip_il
from manip_il.cli.main import load, main
from manip_il.cli.parsing import parse
from manip_il.cli.run.learning import imitation_config
from manip_il.collect.job import RolloutJob
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, UnknownName
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from ..damage import digests
from .made_runs import make_policy, run

ENV = make_config("panda", "pick_place", 2, object="box:0.04")  # an episode has few steps
HERE = "here"  # the current folder, all of which must stay closed
EVIL = "from pathlib import Path\nPath('ran').touch()\n"
RUNS = ("exec", "subprocess.Popen", "os.system", "os.posix_spawn")
_noticed: list[str] | None = None  # what was opened or run outside, while somebody watches


def _notice(event: str, arguments: tuple[Any, ...]) -> None:
    """Note and prevent what opens a file of the current folder, or runs one: it could hang."""
    if _noticed is None or event not in (*RUNS, "open"):
        return
    what = arguments[0].co_filename if event == "exec" else arguments[0]
    inside = (
        isinstance(what, str | Path)
        and os.path.lexists(what)
        and HERE in Path(os.path.abspath(what)).parts
    )
    if inside or event in RUNS[1:]:
        _noticed.append(f"{event} {what}")
        raise PermissionError(str(what))


sys.addaudithook(_notice)


@contextmanager
def nothing_is_touched() -> Iterator[None]:
    global _noticed
    before, _noticed = digests(Path()), []
    try:
        yield
        found = list(_noticed)
    finally:
        _noticed = None
    assert found == []
    assert digests(Path()) == before


@pytest.fixture(scope="module")
def given_files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A dataset, a policy and an evaluation, in a folder beside the current one."""
    base = tmp_path_factory.mktemp("stored")
    write_dataset(
        RolloutJob(ENV, hold=0).run([0]),
        base / "data",
        env_spec(ENV),
        {"driver": "expert"},
        fingerprint=env_fingerprint(ENV),
    )
    make_policy(base / "policy", ENV)
    manip_il.evaluate(None, ENV, 1).write(base / "e" / "eval.json")
    (base / HERE).mkdir()
    for name in ("evil.py", "evil.yaml", "evil.json", "evil.stl"):
        (base / HERE / name).write_text(EVIL)
    make_policy(base / HERE / "policy", ENV)
    os.mkfifo(base / HERE / "pipe.stl")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(base / HERE)
        yield base


def relabel(base: Path) -> None:
    main(["data", "relabel", str(base / "data"), mkdtemp(dir=base), "--workers=1", "--quiet"])


def adversary(base: Path) -> None:
    imitation_config(parse(load("rl gail"), [f"--dataset.root={base / 'data'}"]))  # pyright: ignore[reportArgumentType]


def evaluate(base: Path) -> None:
    manip_il.evaluate(base / "policy", episodes=1, hold=0)


def replay(base: Path) -> None:
    run(f"eval {base / 'e'} --replay=4000000")


FILES: dict[str, tuple[Callable[[Path], None], ...]] = {  # a file of metadata, and what uses it
    "data/meta/manip_il.json": (relabel, adversary),
    "data/meta/info.json": (relabel, adversary),
    "policy/manip_il.json": (evaluate,),
    "policy/config.json": (evaluate,),
    "e/eval.json": (replay,),
}
NAMED = {"task": "evil.py", "robot": "evil.yaml", "object": "mesh:BASE/here/pipe.stl:0.1"}
HOSTILE = (
    *(
        "evil",
        "evil.py",
        "./evil.py",
        "~/evil.py",
        "../here/evil.py",
        "BASE/here/evil.py",
        "evil:evil",
        "evil.evil",
    ),
    *(
        "evil.yaml",
        "BASE/here/evil.yaml",
        "carry:evil.json",
        "carry:BASE/here/evil.json",
        "policy",
        "BASE/here/policy",
    ),
    *(
        "mesh:evil.stl",
        "mesh:BASE/here/pipe.stl:0.1",
        "mesh:pipe.stl#0123456789ab:0.1",
        "pipe.stl",
        "BASE/here/pipe.stl",
    ),
    *(
        "file://BASE/here/evil.py",
        "hf://here/evil",
        "panda",
        "so101.yaml",
        "reach",
        "mesh",
        "any",
        "box:0.05",
    ),
)
SINGLE = (
    st.sampled_from(HOSTILE) | st.none() | st.booleans() | st.integers(-1, 3) | st.text(max_size=9)
)
VALUES = (
    SINGLE | st.lists(SINGLE, max_size=2) | st.dictionaries(st.text(max_size=5), SINGLE, max_size=2)
)


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Containers and keys of all values in a tree."""
    for key in tree if isinstance(tree, dict) else range(min(2, len(tree))):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from places(tree[key])


@pytest.mark.parametrize("file", FILES)
@settings(max_examples=40)
@given(drawn=st.data())
def test_whatever_a_field_says_no_file_outside_is_opened_run_or_written(file, given_files, drawn):
    path = given_files / file
    before = path.read_text()
    tree = json.loads(before)
    everywhere = [*places(tree)]
    names = [place for place in everywhere if place[1] in (*NAMED, "policy", "type")]
    container, key = drawn.draw(st.sampled_from(names or everywhere) | st.sampled_from(everywhere))
    container[key] = drawn.draw(
        st.sampled_from(HOSTILE) if drawn.draw(st.integers(0, 3)) else VALUES
    )
    path.write_text(json.dumps(tree).replace("BASE", str(given_files)))
    try:
        with nothing_is_touched():
            for use in FILES[file]:
                with contextlib.suppress(Exception):
                    use(given_files)
    finally:
        path.write_text(before)


COMMANDS = [
    *(
        f"data {what} BASE/data BASE/new --workers=1"
        for what in ("relabel", "render --cameras=front", "redraw")
    ),
    *(f"rl {method} --dataset.root=BASE/data --output_dir=BASE/new" for method in ("gail", "airl")),
    "eval BASE/e --replay=4000000",
    "eval --policy.path=BASE/policy --output_dir=BASE/new",
    "dagger --policy.path=BASE/policy --dataset.root=BASE/data --output_dir=BASE/new",
]


@contextmanager
def hostile(base: Path, field: str) -> Iterator[None]:
    """Put a path into one field of all files that name an environment."""
    inside = {"data/meta/manip_il.json": "spec", "e/eval.json": "settings"}
    before = {file: (base / file).read_bytes() for file in FILES}
    for file in ("data/meta/manip_il.json", "policy/manip_il.json", "e/eval.json"):
        tree = json.loads(before[file])
        place = tree[inside[file]] if file in inside and field not in tree else tree
        place[field] = NAMED[field].replace("BASE", str(base))
        (base / file).write_text(json.dumps(tree))
    yield
    for file, content in before.items():
        (base / file).write_bytes(content)


@pytest.mark.parametrize("field", NAMED)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_stored_path_is_a_bad_name(command, field, given_files, capsys):
    words = command.replace("BASE", str(given_files)).split()
    with hostile(given_files, field), nothing_is_touched():
        assert main(words) in (1, 2)
    error = capsys.readouterr().err
    assert (error.count("\n"), "--debug" in error) == (1, False), error


@pytest.mark.parametrize("field", NAMED)
def test_in_python_too_a_stored_path_is_a_bad_name(field, given_files):
    with hostile(given_files, field), nothing_is_touched(), pytest.raises(ManipError) as caught:
        manip_il.evaluate(given_files / "policy", episodes=1)
    assert field == "object" or isinstance(caught.value, UnknownName)


@pytest.mark.parametrize(
    "words", ["data check DATA", "train --dataset.root=DATA --steps=1 --output_dir=new"]
)
def test_a_stored_mesh_hangs_nothing(words, given_files, capsys):
    with hostile(given_files, "object"):
        assert main(words.replace("DATA", str(given_files / "data")).split()) == 1
    out, err = capsys.readouterr()
    assert "expected a shape, or a mesh's name without a path" in out + err
