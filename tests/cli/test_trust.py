"""`--trust` is said on the command line alone, to every command that loads a policy.

And what `--policy.path` means.
"""

import json
import re
import shutil
from pathlib import Path

import pytest

from manip_il.cli.imitation import DaggerOptions
from manip_il.cli.main import load, main
from manip_il.cli.parsing import dump_yaml, options_of, parse
from manip_il.cli.run.imitation import dagger_config, read_plan
from manip_il.errors import ManipError, UsageError
from manip_il.learn.checkpoint import find_policy
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options

from ..damage import edit_json
from .made_runs import make_eval, make_policy, make_run

COMMANDS = ("train", "dagger", "eval", "compare")
SAMPLE = Path(__file__).resolve().parents[2] / "datasets" / "sample"
STEP = {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil/x"}}
REQUIRED = {
    "train": ["--dataset.root=x"],
    "compare": ["x", "y"],
}


@pytest.fixture
def hostile(tmp_path) -> Path:
    """A policy of which a processor's step fetches a tokenizer by name."""
    policy = make_policy(tmp_path / "hostile")
    edit_json(policy / "policy_preprocessor.json", lambda values: values["steps"].append(STEP))
    return policy


@pytest.fixture
def named(tmp_path) -> Path:
    """A policy whose options name an encoder."""
    folder = tmp_path / "named"
    folder.mkdir()
    action = {"action": {"type": "ACTION", "shape": [8]}}
    features = {"input_features": {}, "output_features": action}
    config = {"type": "gaussian_actor", "vision_encoder_name": "evil/x", **features}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").touch()
    return folder


def test_what_a_checkpoint_names_is_refused_by_every_command(
    hostile, named, policy, tmp_path, error
):
    out, file = (
        f"--output_dir={tmp_path / 'out'}",
        make_eval(tmp_path / "e" / "eval.json", [True, False]),
    )
    words = ["--env.horizon=8", "--workers=1", out]
    for command in (
        ["eval", f"--policy.path={hostile}", "--eval.n_episodes=1", *words],
        [*f"compare {policy} {hostile} --eval.n_episodes=1".split(), *words],
        f"eval {file} --replay=4000000 --policy.path={hostile}".split(),
        ["dagger", f"--policy.path={named}", out],
        ["dagger", "--policy.type=gaussian_actor", "--policy.vision_encoder_name=evil/x", out],
    ):
        assert main(command) == 1
        assert re.search(r"evil/x.*add --trust=true", error())
    with pytest.raises(ManipError, match=r"evil/x.*--trust=true"):
        lerobot_options(FitConfig({"path": str(named)}))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_no_file_may_say_it_and_the_resolved_options_do_not(command, tmp_path):
    cls = load(command)
    [option] = [option for option in options_of(cls) if option.name == "trust"]
    assert option.default is False
    assert "only for sources that you trust" in option.metadata["help"]
    said = parse(cls, [*REQUIRED.get(command, []), "--trust=true"])
    assert said.trust is True  # pyright: ignore[reportAttributeAccessIssue]
    assert "trust" not in dump_yaml(said)
    (tmp_path / "c.yaml").write_text("trust: true\n")
    with pytest.raises(
        UsageError, match=r"c\.yaml: trust can only be set on the command line; give --trust="
    ):
        parse(cls, [*REQUIRED.get(command, []), f"--config_path={tmp_path / 'c.yaml'}"])


def test_a_study_trusts_for_its_runs_what_its_file_may_not(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text("arms: {a: {rounds: 1}, b: {trust: true}}\ntraining_seeds: 1\n")
    with pytest.raises(UsageError, match=r"its options: trust can only be set on the command line"):
        read_plan(path)
    path.write_text("arms: {a: {rounds: 1}}\ntraining_seeds: 1\n")
    for trust in (False, True):
        options = read_plan(path, trust=trust).arms["a"]
        assert isinstance(options, DaggerOptions)
        assert options.trust is trust


def test_a_run_means_its_best_policy_else_its_newest(tmp_path, policy):
    run = make_run(tmp_path / "run", policy)
    assert find_policy(run) == run / "best" / "pretrained_model"
    shutil.rmtree(run / "best")
    for newest in ("round_002", "round_001"):
        assert (
            find_policy(run)
            == run / newest / "policy" / "checkpoints" / "last" / "pretrained_model"
        )
        shutil.rmtree(run / newest)


def test_a_training_run_without_its_link_means_its_newest_checkpoint(tmp_path, policy):
    checkpoints = tmp_path / "run" / "checkpoints"
    for step in ("000100", "020000", "001000"):
        shutil.copytree(policy, checkpoints / step / "pretrained_model")
    assert find_policy(tmp_path / "run") == checkpoints / "020000" / "pretrained_model"
    (checkpoints / "last").symlink_to("001000")
    assert find_policy(tmp_path / "run") == checkpoints / "last" / "pretrained_model"


@pytest.mark.parametrize("command", ["train", "dagger"])
def test_what_is_fitted_starts_from_the_policy_that_eval_would_measure(command, here, policy):
    run = make_run(here / "run", policy)
    task = ["--task.type=reach"] if command == "dagger" else []
    options = parse(load(command), [*REQUIRED.get(command, []), *task, "--policy.path=run"])
    fit = dagger_config(options).fit if command == "dagger" else FitConfig(options.fit["policy"])
    assert (
        Path(lerobot_options(fit)[0].policy.pretrained_path).resolve() == find_policy(run).resolve()
    )
