"""Help and mistakes are answered before anything heavy is imported."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from manip_il.cli.main import COMMANDS

HEAVY = {"torch", "lerobot", "mujoco", "mink", "gymnasium", "scipy", "pyarrow", "av", "PIL", "mcap", "huggingface_hub"}
RUN = f"""
import io, json, sys
from contextlib import redirect_stderr, redirect_stdout
from manip_il.cli.main import main
answers = []
for words in json.loads(sys.stdin.read()):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(words)
    loaded = sorted({HEAVY} & set(sys.modules))
    answers.append([words, code, out.getvalue(), err.getvalue(), loaded])
    if loaded:
        break
print(json.dumps(answers))
"""


def answers(cases: list[list[str]], cwd) -> list[tuple[list[str], int, str, str, list[str]]]:
    """What one process says to one command line after the other, up to the first that loads something heavy."""
    done = subprocess.run(
        [sys.executable, "-c", RUN], input=json.dumps(cases), capture_output=True, text=True, check=True, cwd=cwd
    )
    return json.loads(done.stdout)


def test_help_of_every_command_imports_nothing_heavy(tmp_path):
    cases = [["--help"], ["mcap"], *([*name.split(), "--help"] for name in COMMANDS)]
    given = answers(cases, tmp_path)
    assert [(words, loaded) for words, _, _, _, loaded in given if loaded] == []
    assert [code for _, code, *_ in given] == [0] * len(cases)
    assert all(out.startswith("usage: manip-il") for _, _, out, _, _ in given)


def test_a_mistyped_command_or_option_imports_nothing_heavy(tmp_path):
    cases = [["trian"], ["mcap", "exprot"], *([*name.split(), "--nosuch=1"] for name in COMMANDS)]
    given = answers(cases, tmp_path)
    assert [(words, loaded) for words, _, _, _, loaded in given if loaded] == []
    assert [code for _, code, *_ in given] == [2] * len(cases)
    assert all(err.count("\n") == 1 and err.startswith("manip-il: error: ") for _, _, _, err, _ in given)


@pytest.mark.parametrize(
    "imports",
    [
        "import manip_il, gymnasium",
        "import gymnasium, manip_il",
        "import manip_il, gymnasium.envs.registration",
        "import manip_il.sim.env, manip_il; from gymnasium import spaces; import gymnasium",
    ],
)
def test_the_environments_are_registered_in_whatever_order_one_imports(imports: str):
    code = f"{imports}; print(gymnasium.spec('manip_il/PandaPickPlace-v0').entry_point, gymnasium.__spec__.loader)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("manip_il.sim.env:ManipEnv <_frozen_importlib_external.SourceFileLoader")


def test_the_package_alone_loads_no_gymnasium():
    code = "import sys, manip_il; print('gymnasium' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
