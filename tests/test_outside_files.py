"""Files from outside have one door: only `checks.py` opens them, others read what it opened, or
are listed here.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "manip_il"
READERS = {
    *(
        "open",
        "os.open",
        "io.open",
        "av.open",
        "Image.open",
        "np.load",
        "np.fromfile",
        "np.loadtxt",
        "torch.load",
    ),
    *(
        "pq.ParquetFile",
        "pq.read_table",
        "pq.read_schema",
        "pq.read_metadata",
        "pd.read_parquet",
        "pa.OSFile",
    ),
    *(
        "shutil.copyfile",
        "load_file",
        "safe_open",
        "mujoco.MjSpec.from_file",
        "mujoco.MjModel.from_xml_path",
    ),
}
METHODS = {"read_text", "read_bytes"}
ALLOWED = {
    "cli/main.py": "os.devnull",
    "cli/outputs.py": "the folder that a command is about to write",
    "collect/ray_pool.py": "what this process opened before it sends it to a node",
    "worlds/fingerprint.py": "the kernel's files of the processor",
    "data/atomic.py": "locks and flushes what it writes",
    "robots/robot.py": "a user's model, after its included files were read",
    "serve/operator.py": "the kernel's file of this process",
    "sim/scene.py": "the empty scene, which ships with the package",
    "worlds/aloha/expert.py": "a model in an installed package",
    "own_file.py": "the source of code that runs already",
}


def writes(call: ast.Call) -> bool:
    modes = [
        one.value
        for one in call.args
        if isinstance(one, ast.Constant) and isinstance(one.value, str)
    ]
    return any(set(mode) & set("wxa") and set(mode) <= set("wxab+") for mode in modes)


def raw_reads(tree: ast.Module) -> Iterator[str]:
    """Calls that open a path to read it, unless `checks` opened it, it is in memory, or it ships
    with the package.
    """
    opened = {
        item.optional_vars.id
        for block in ast.walk(tree)
        if isinstance(block, ast.With)
        for item in block.items
        if isinstance(item.optional_vars, ast.Name)
        and ast.unparse(item.context_expr).startswith(
            ("checks.native_path", "native_path", "open_outside")
        )
    }
    for call in (one for one in ast.walk(tree) if isinstance(one, ast.Call)):
        text, name = ast.unparse(call), ast.unparse(call.func)
        last = name.rpartition(".")[2]
        is_method = last in METHODS and "." in name and not name.startswith("checks.")
        is_path_open = last == "open" and [*map(ast.unparse, call.args)] in (["'r'"], ["'rb'"])
        if not (name in READERS or is_method or is_path_open) or writes(call):
            continue
        given = {
            one.id
            for argument in call.args
            for one in ast.walk(argument)
            if isinstance(one, ast.Name)
        }
        if not given & {*opened, "BytesIO"} and "__file__" not in text and "files(" not in text:
            yield text


def test_only_checks_opens_files_from_outside():
    found = {
        path.relative_to(PACKAGE).as_posix(): [*raw_reads(ast.parse(path.read_text()))]
        for path in PACKAGE.rglob("*.py")
    }
    assert {
        name: calls
        for name, calls in found.items()
        if calls and name not in {*ALLOWED, "checks.py"}
    } == {}


@pytest.mark.parametrize(
    "door",
    [
        "path.open('rb')",
        "path.read_text()",
        "pq.read_schema(path)",
        "np.load(path)",
        "av.open(f'file:{path}')",
    ],
)
def test_a_new_door_is_found(door: str):
    assert [*raw_reads(ast.parse(f"with {door} as found:\n    pass"))] == [door]
