"""Mistakes are one line and exit code 2.

Like help, they are answered before anything heavy is imported.
"""

import json
import subprocess
import sys
from pathlib import Path

import manip_il
from manip_il import __version__
from manip_il.cli.main import COMMANDS, GROUPS

HEAVY = [
    "torch",
    "lerobot",
    "mujoco",
    "mink",
    "scipy",
    "pyarrow",
    "av",
    "PIL",
    "mcap",
    "huggingface_hub",
]
LIGHT = [*HEAVY, "draccus", "rich", "yaml"]
ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "datasets" / "sample"
RUN = """
import io, json, sys
from contextlib import redirect_stderr, redirect_stdout
from manip_il.cli.main import main
answers, (heavy, cases) = [], json.loads(sys.stdin.read())
for words in cases:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(words)
    loaded = sorted(set(heavy) & set(sys.modules))
    answers.append([words, code, out.getvalue(), err.getvalue(), loaded])
    if loaded:
        break
print(json.dumps(answers))
"""


def answers(
    cases: list[list[str]], cwd: Path, heavy: list[str]
) -> list[tuple[list[str], int, str, str]]:
    """Words, exit code and output of one command line after the other, in one process that loads
    nothing heavy.
    """
    asked = json.dumps([heavy, cases])
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        input=asked,
        capture_output=True,
        text=True,
        check=True,
        cwd=cwd,
    )
    given = json.loads(done.stdout)
    assert [(words, loaded) for words, *_, loaded in given if loaded] == []
    return [tuple(answer[:-1]) for answer in given]


def test_help_of_every_command_imports_nothing_heavy(tmp_path):
    of_results = ("compare",)
    light = [[*name.split(), "--help"] for name in COMMANDS if name not in of_results]
    given = answers([[], ["--help"], *([name] for name in GROUPS), *light], tmp_path, LIGHT)
    given += answers([[name, "--help"] for name in of_results], tmp_path, HEAVY)
    assert all(code == 0 and out.startswith("usage: manip-il") for _, code, out, _ in given)
    assert given[0][2] == given[1][2]
    assert all(f"  {name.split()[0]} " in given[0][2] for name in COMMANDS)
    assert given[0][2].count("\n") <= 40
    assert answers([["--version"]], tmp_path, LIGHT)[0][1:] == (0, f"manip-il {__version__}\n", "")


def test_a_mistyped_command_or_option_imports_nothing_heavy(tmp_path):
    cases = [["trian"], ["data", "chekc"], *([*name.split(), "--nosuch=1"] for name in COMMANDS)]
    for _, code, _, err in answers(cases, tmp_path, HEAVY):
        assert (code, err.count("\n"), err.startswith("manip-il: error: ")) == (2, 1, True)


TRAIN, EXPERT = "train --dataset.root=SAMPLE", "eval --policy.type=expert"
MISTAKES = {
    "data chekc a": "unknown command 'data chekc' (did you mean 'data check'?); known: ",
    "train": "--dataset.root is missing",
    "train --dataset.root=missing": "missing does not exist; expected a LeRobot v3.0 dataset",
    "data check missing": "missing does not exist; expected a LeRobot v3.0 dataset",
    f"train --dataset.root={ROOT / 'docs'}": "is not a LeRobot dataset: meta/info.json is missing",
    "train --dataset.root=lerobot/pusht": "manip-il pull hf://datasets/USER/NAME FOLDER",
    f"{TRAIN} --policy.path=missing": "no policy in missing",
    f"{TRAIN} --policy=act": "did you mean '--policy.NAME'",
    f"{TRAIN} --action_space=ee_detla": (
        "--action_space: expected joint_target|joint_delta|ee_delta, got 'ee_detla'"
    ),
    f"{TRAIN} --wandb.projekt=a --policy.type=act": "did you mean 'project'",
    f"{TRAIN} --policy.type=akt --observation=images": "unknown policy 'akt' (did you mean 'act'?)",
    "eval": "--policy.path=DIR",
    "eval --policy.path=lerobot/act_aloha": "manip-il pull hf://USER/NAME FOLDER",
    "eval missing --replay=1": "cannot read missing: No such file or directory; expected an eval.json",
    "eval SAMPLE": "EVALUATION and --replay=SEED belong together",
    f"{EXPERT} --suite=nominall": "did you mean 'nominal'?",
    f"{EXPERT} --until_width=2": "--until_width is 2.0; expected 0.0001 to 1",
    "compare a b": "no policy in a; expected LeRobot's pretrained_model folder",
    "record --robot.type=pandas": (
        "unknown robot 'pandas' (did you mean 'panda'?); known: fetch, panda"
    ),
    "record --num_episodes=3": "did you mean '--dataset.num_episodes'?",
    "record --cameras=front,wirst": (
        "unknown camera 'wirst' (did you mean 'wrist'?); known: front, side, wrist"
    ),
    "record --cameras=front --image.height=127": (
        "pictures have height 127 and width 128; expected even numbers"
    ),
    "record --dataset.repo_id=../name": "expected a name of letters",
    "dagger --config_path=missing.yaml": "cannot read missing.yaml",
    "dagger --beta=lineal:5": "beta is 'lineal:5'; expected constant:B, linear:ROUNDS",
    "dagger --rounds=-1": "rounds is -1; expected 0 to 99",
    "dagger --hold=-1": "hold is -1; expected at least 0",
    "dagger --policy.type=act --query=one": "use label=branch or label=takeover",
    "data check": "DATASET is missing",
    "data render SAMPLE x --look.brightness=9": ("brightness is 9.0; expected 0.1 to 2"),
    "data redraw SAMPLE SAMPLE --overwrite=true": "overlaps",
    "push SAMPLE": "REMOTE is missing",
    "push missing hf://me/x": "missing is neither a LeRobot dataset",
    "view --policy.type=slider": "--policy.type: expected expert|random, got 'slider'",
    "robot new missing.xml": "missing.xml: No such file or directory; expected an MJCF",
    "robot certify --cases=2000000": "--cases is 2000000; expected 1 to 1,000,000",
    "theory missing": "a run of manip-il dagger",
}


def test_a_mistake_is_one_line_with_the_nearest_name_and_leaves_nothing(tmp_path):
    lines = [line.replace("SAMPLE", str(SAMPLE)).split() for line in MISTAKES]
    for (words, code, _, err), says in zip(
        answers(lines, tmp_path, []), MISTAKES.values(), strict=True
    ):
        assert (code in (1, 2), err.count("manip-il: error: "), says in err) == (True, 1, True), (
            words,
            says,
            err,
        )
    assert list(tmp_path.iterdir()) == []


def test_the_environments_are_registered_whatever_is_imported_first():
    code = (
        "import gymnasium, manip_il;"
        " print(gymnasium.spec('manip_il/PandaPickPlace-v0').entry_point)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "manip_il.worlds.ladder.world:make_env\n"


def test_the_package_shows_what_a_user_wants_and_alone_loads_no_simulator():
    code = (
        "import sys, manip_il; print(dir(manip_il)); assert not {'mujoco', 'scipy', 'torch'} &"
        " sys.modules.keys()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {
        "Checkpoint",
        "Dataset",
        "Expert",
        "dagger",
        "evaluate",
        "make_env",
        "record",
        "train",
    } <= {*json.loads(done.stdout.replace("'", '"'))}
    env = manip_il.make_env("fetch", "reach")
    assert (env.scene.robot.name, env.task) == ("fetch", "reach")
    assert manip_il.Expert(env.scene).label(env.get_state()).valid
    assert callable(manip_il.record)
