"""Suites, stopping by width, resuming, and replaying one line of eval.json."""

import base64
import json
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.errors import UsageError
from manip_il.evaluation.measuring import EPISODES_FILE as KEPT
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.suites import CONDITIONS, SUITES, suite_conditions
from manip_il.sim.conditions import NOMINAL, draw
from manip_il.sim.events import STANDARD
from manip_il.worlds.table import env_spec, make_config

from ..damage import edit_json
from ..learn.tiny_policies import write_checkpoint
from .made_runs import make_policy, run

ENV = make_config("fetch", "pick_place", horizon=10)
SMALL = ["--robot.type=fetch", "--env.horizon=10", "--workers=1", "--eval.films=0"]
REACH = ["--policy.type=expert", "--task.type=reach", *SMALL]


@pytest.fixture(scope="module")
def act(tmp_path_factory) -> Path:
    return make_policy(tmp_path_factory.mktemp("act") / "act", ENV)


def evaluate(folder: str, *words: str) -> int:
    return main(["eval", *words, f"--output_dir={folder}"])


def test_the_shipped_suites_are_sound_and_all_is_all_of_them():
    for suite in SUITES:
        assert suite_conditions(suite, make_config(task="pick_place"), sees=True)
    alone = {"random_actions", "servo"}
    assert {name for names in SUITES.values() for name in names} == {*CONDITIONS} - alone
    assert suite_conditions("nominal", make_config(task="reach"), sees=False) == (NOMINAL,)
    [knocked] = suite_conditions("knocked", make_config(task="pick_place"), sees=False)
    assert knocked.ranges == STANDARD.ranges  # the disturbance that DAgger collects under
    names = [one.name for one in suite_conditions("all", make_config(task="pick_place"), sees=True)]
    assert names == [*SUITES["all"]]
    blind = ["nominal", "knocked", "sensing", "object", "dynamics"]
    assert [
        one.name for one in suite_conditions("all", make_config(task="pick_place"), sees=False)
    ] == blind
    with pytest.raises(UsageError, match="changes nothing for reach"):
        suite_conditions("object", make_config(task="reach"), sees=True)


def test_a_suite_deals_its_episodes_and_says_how_each_condition_went(act, here, capsys):
    assert evaluate("e", f"--policy.path={act}", "--suite=all", "--eval.n_episodes=10", *SMALL) == 0
    data = json.loads(Path("e/eval.json").read_text())
    conditions = suite_conditions("all", make_config(task="pick_place"), sees=False)
    counts = {name: one["n_episodes"] for name, one in data["by_condition"].items()}
    assert counts == {one.name: 2 for one in conditions}
    for episode in data["episodes"]:
        assert episode["drawn"] == dict(draw(conditions, episode["seed"]))
    assert data["settings"]["suite"] == "all"
    out = capsys.readouterr().out
    assert all(f"|{name} " in out for name in data["by_condition"])
    assert Path("e/report.html").read_text().count("<video") == 0


def test_a_yaml_of_ones_own_is_a_suite(act, here, capsys, error):
    Path("heavy.yaml").write_text("mass: [0.4, 0.5]\n")
    words = [f"--policy.path={act}", "--eval.n_episodes=2", *SMALL]
    assert evaluate("e", *words, "--suite=heavy.yaml") == 0
    for episode in EvalResult.read(Path("e")).episodes:
        assert episode.detail["condition"] == "heavy"
        assert 0.4 <= episode.detail["drawn"]["mass"] <= 0.5
    capsys.readouterr()
    for text, what in (
        ("mass: [0.5, 0.4]", "heavy: mass is [0.5, 0.4]; expected a number, or [low, high]"),
        ("mas: 1", "did you mean 'mass'?"),
        ("brightness: [0.5, 2]", "changes nothing for pick_place and a policy without cameras"),
    ):
        Path("heavy.yaml").write_text(text)
        assert evaluate("f", *words, "--suite=heavy.yaml") == 2
        assert what in error()
    assert not Path("f").exists()


def test_until_width_stops_early(here, capsys, error):
    words = [
        "--policy.type=random",
        "--task.type=reach",
        *SMALL,
        "--env.horizon=5",
        "--eval.n_episodes=300",
    ]
    assert evaluate("e", *words, "--until_width=0.1") == 0
    result = EvalResult.read(Path("e"))
    assert (len(result.episodes), result.until_width) == (100, 0.1)
    low, high = result.success.interval
    assert high - low <= 0.1


def test_a_resumed_evaluation_is_the_whole_one(here, capsys, error):
    assert evaluate("whole", *REACH, "--eval.n_episodes=4") == 0
    assert evaluate("e", *REACH, "--eval.n_episodes=4") == 0
    kept = Path("e") / KEPT
    lines = kept.read_bytes().splitlines(keepends=True)
    kept.write_bytes(b"".join(lines[:3]) + lines[3][:20])  # two whole episodes and a torn one
    Path("e/eval.json").unlink()
    assert evaluate("e", *REACH, "--eval.n_episodes=4", "--resume=true") == 0
    assert Path("e/eval.json").read_bytes() == Path("whole/eval.json").read_bytes()
    assert evaluate("e", *REACH, "--eval.n_episodes=6", "--resume=true") == 0  # and more of them
    assert [one.seed for one in EvalResult.read(Path("e")).episodes] == list(
        range(4_000_000, 4_000_006)
    )
    capsys.readouterr()
    assert evaluate("e", *REACH, "--eval.n_episodes=6", "--suite=sensing", "--resume=true") == 1
    assert "--suite differs" in error()


def test_resuming_with_another_policy_of_the_same_name_is_refused(here, capsys, error):
    act = write_checkpoint(here / "act", "act", env_spec(ENV))
    words = [f"--policy.path={act}", *SMALL, "--eval.n_episodes=1"]
    assert evaluate("e", *words) == 0
    (act / "model.safetensors").write_bytes(
        (act / "model.safetensors").read_bytes()[:-4] + b"\0\0\1\0"
    )
    capsys.readouterr()
    assert evaluate("e", *words, "--resume=true") == 1
    assert (
        "policy_sha256 (e was started with another; --overwrite=true starts over) differs"
        in error()
    )


def test_every_line_of_eval_json_can_be_replayed_alone(act, here, capsys):
    assert evaluate("e", f"--policy.path={act}", "--suite=all", "--eval.n_episodes=4", *SMALL) == 0
    result = EvalResult.read(Path("e"))
    for episode in result.episodes:
        capsys.readouterr()
        assert run(f"eval e/eval.json --replay={episode.seed} --policy.path={act}") == 0
        out, err = capsys.readouterr()
        assert f"seed {episode.seed}, {episode.detail['condition']}: failure" in out
        assert "the same as in e/eval.json" in out
        assert "warning" not in err


def test_a_replay_that_comes_out_otherwise_says_so(act, here, capsys, error):
    assert (
        evaluate("e", f"--policy.path={act}", "--suite=sensing", "--eval.n_episodes=2", *SMALL) == 0
    )
    edit_json(
        Path("e/eval.json"),
        lambda data: data["episodes"][0].update({"success": True, "return": 3.0}),
    )
    edit_json(Path("e/eval.json"), lambda data: data["episodes"][1]["drawn"].update(delay=77))
    capsys.readouterr()
    assert run(f"eval e --replay=4000000 --policy.path={act}") == 1
    line = error()
    assert "success was True, is False" in line
    assert "return was 3.0, is 0.0" in line
    assert run(f"eval e --replay=4000001 --policy.path={act}") == 1
    assert "drawn was " in error()
    assert run("eval e --replay=2") == 2
    assert "has seeds 4000000 to 4000001" in error()


def test_a_replay_takes_the_policy_that_is_given_and_knows_another_one(here, capsys, error):
    act = write_checkpoint(here / "act", "act", env_spec(ENV))
    assert (
        evaluate("e", "--policy.path=act", "--eval.n_episodes=1", "--task.type=pick_place", *SMALL)
        == 0
    )
    capsys.readouterr()
    assert run("eval e --replay=4000000") == 2
    assert "'act'; give that with --policy.path=DIR" in error()
    act.rename(here / "moved")
    assert run("eval e --replay=4000000 --policy.path=moved") == 0
    assert "files differ" not in capsys.readouterr().err
    other = write_checkpoint(here / "other", "act", env_spec(ENV), chunk_size=4)
    assert run(f"eval e --replay=4000000 --policy.path={other}") in (0, 1)
    assert "is not the policy of e: its files differ" in capsys.readouterr().err


@pytest.mark.gl
def test_failures_and_successes_are_filmed_and_a_replay_films_one(act, here):
    expert = [
        "--policy.type=expert",
        "--task.type=reach",
        "--robot.type=fetch",
        "--workers=1",
        "--eval.n_episodes=2",
    ]
    assert evaluate("good", *expert, "--env.horizon=30", "--eval.films=1") == 0
    assert Path("good/report.html").read_text().count("<video") == 1
    words = [f"--policy.path={act}", "--suite=object", "--eval.n_episodes=3", *SMALL]
    assert evaluate("bad", *words, "--eval.films=2") == 0
    page = Path("bad/report.html").read_text()
    assert page.count("<video") == 2
    assert run(f"eval bad --replay=4000001 --policy.path={act} --video=deep/one.mp4") == 0
    assert base64.b64encode(Path("deep/one.mp4").read_bytes()).decode() in page
