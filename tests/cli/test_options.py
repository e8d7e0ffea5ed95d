"""Options from words and YAML; a mistake is one short line."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manip_il.cli.parsing import (
    Given,
    Open,
    dump_yaml,
    from_layers,
    from_yaml,
    options_of,
    parse,
    word,
)
from manip_il.cli.parsing import given as given_of
from manip_il.errors import UsageError
from manip_il.option import option


@dataclass
class Dataset:
    repo_id: str = "local/pick"
    root: Path | None = None
    num_episodes: int = field(default=50, metadata={"help": "how many"})

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise UsageError(f"num_episodes is {self.num_episodes}; expected 1 or more")


@dataclass
class Options:
    dataset: Dataset = field(default_factory=Dataset)
    small: Dataset = field(default_factory=lambda: Dataset(num_episodes=3))
    loss: Literal["mse", "l1"] = "mse"
    device: Literal["CPU", "CUDA"] = "CPU"
    cameras: list[str] = field(default_factory=list)
    gains: list[float] = field(default_factory=lambda: [1.0])
    lr: float = 1e-3
    beta: float | None = None
    note: str | None = None
    resume: bool = False


@dataclass
class Doctor:
    dataset: Path = field(metadata={"positional": True})
    repair: bool = False


def fails(words: list[str], cls: type = Options) -> str:
    with pytest.raises(UsageError) as caught:
        parse(cls, words)
    return str(caught.value)


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ([], {}),
        (["--dataset.num_episodes=7"], {"dataset": Dataset(num_episodes=7)}),
        (["--dataset.root=x/y"], {"dataset": Dataset(root=Path("x/y"))}),
        (["--dataset.root=~/x"], {"dataset": Dataset(root=Path.home() / "x")}),
        (["--cameras=front,wrist"], {"cameras": ["front", "wrist"]}),
        (["--cameras=['front', 'wrist']"], {"cameras": ["front", "wrist"]}),
        (["--gains=1,2.5"], {"gains": [1.0, 2.5]}),
        (["--lr=-1e-4"], {"lr": -1e-4}),
        (["--resume", "--loss=l1"], {"resume": True, "loss": "l1"}),
        (["--loss=l1", "--loss=mse"], {}),
        (
            ["--lr", "-1e-4", "--resume", "true", "--loss", "l1"],
            {"lr": -1e-4, "resume": True, "loss": "l1"},
        ),
    ],
)
def test_words_change_what_they_name(words, change):
    assert parse(Options, words) == Options(**change)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (
            ["--los=l1"],
            [
                "unknown option '--los'",
                "did you mean '--loss'",
                "--help lists all",
            ],
        ),
        (
            ["--repo_id=x"],
            ["unknown option '--repo_id' (did you mean '--small.repo_id'?)"],
        ),
        (["--dataset=x"], ["unknown option '--dataset' (did you mean '--dataset.root'"]),
        (["--lr=fast"], ["--lr", "expected FLOAT", "'fast'"]),
        (["--dataset.num_episodes=1.5"], ["--dataset.num_episodes", "expected INT", "'1.5'"]),
        (["--loss=mze"], ["expected mse|l1", "'mze'"]),
        (["--lr", "--resume"], ["--lr has no value; write --lr=VALUE"]),
        (["--resume=yes"], ["expected true|false", "'yes'"]),
        (["--gains=1,x"], ["expected FLOAT,..."]),
    ],
)
def test_a_users_mistake_is_named_with_what_was_expected(words, parts):
    message = fails(words)
    assert all(part in message for part in parts), message


def test_positional_values_are_taken_in_order():
    assert parse(Doctor, ["data/x", "--repair"]) == Doctor(Path("data/x"), repair=True)
    assert "DATASET is missing; expected PATH" in fails([], Doctor)
    assert "unexpected 'y'" in fails(["x", "y"], Doctor)
    assert "unknown option" in fails(["--dataset=x"], Doctor)


def test_words_beat_yaml_beats_defaults(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("# nothing\n")
    assert from_yaml(path, Options) == Options()
    path.write_text("dataset: {num_episodes: 9, root: a}\nlr: 1e-4\ncameras: [front]\nsmall:\n")
    options = parse(Options, ["--dataset.num_episodes=8", f"--config_path={path}"])
    assert options == Options(
        dataset=Dataset(num_episodes=8, root=Path("a")),
        lr=1e-4,
        cameras=["front"],
        small=Dataset(num_episodes=3),
    )


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (
            "dataset: {num_episode: 9}",
            ["dataset.num_episode", "did you mean 'dataset.num_episodes'"],
        ),
        ("resume: 1", ["resume: expected true|false, got 1"]),
        ("dataset: {repo_id: no}", ["expected TEXT, got False"]),
        ("a: [", ["is not YAML"]),
    ],
)
def test_a_mistake_in_yaml_names_file_and_key(tmp_path, text, parts):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    message = fails([f"--config_path={path}"])
    assert all(part in message for part in [str(path), *parts]), message
    assert "\n" not in message


text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
datasets = st.builds(
    Dataset,
    repo_id=text,
    root=st.none()
    | st.lists(st.from_regex(r"[\w. -]{1,8}", fullmatch=True), min_size=1).map(lambda p: Path(*p)),
    num_episodes=st.integers(min_value=1),
)
numbers = st.floats(allow_nan=False)
any_options = st.builds(
    Options,
    dataset=datasets,
    small=datasets,
    loss=st.sampled_from(["mse", "l1"]),
    device=st.sampled_from(["CPU", "CUDA"]),
    cameras=st.lists(text),
    gains=st.lists(numbers),
    lr=numbers,
    beta=numbers | st.none(),
    note=st.none() | text,
    resume=st.booleans(),
)


@settings(max_examples=30)
@given(any_options)
def test_options_survive_yaml(tmp_path_factory, options):
    path = tmp_path_factory.mktemp("yaml") / "config.yaml"
    path.write_text(dump_yaml(options), encoding="utf-8")
    assert from_yaml(path, Options) == replace(options, resume=False)  # it concerns one call alone


@given(any_options)
def test_options_survive_the_command_line(options):
    # a comma in an item, and the text "null", need YAML
    options = replace(options, cameras=[], note=None)
    words = [f"--{option.name}={word(option.value(options))}" for option in options_of(Options)]
    assert parse(Options, words) == options


@dataclass
class Settings:
    hz: int = option(20, "rate", at_least=1)
    robot: str = option("panda", "which", flag="robot.type")
    crf: float | None = option(23.0, "quality")
    own: int = 0  # no option


@dataclass
class Quality:
    crf: float | None = option(23.0, "quality")


@dataclass
class Command:
    env: Given = given_of(Settings, robot=None)
    more: Given = given_of(Quality, prefix="")


def test_of_a_group_of_anothers_options_only_what_was_given_is_held(tmp_path):
    assert parse(Command, []) == Command()
    command = parse(Command, ["--env.hz=30", "--robot.type=fetch", "--crf=null"])
    assert command == Command(env={"robot": "fetch", "hz": 30}, more={"crf": None})
    (tmp_path / "c.yaml").write_text(dump_yaml(Command()))
    assert from_yaml(tmp_path / "c.yaml", Command).env == {"robot": None, "hz": 20, "crf": 23.0}
    (tmp_path / "c.yaml").write_text("env: {hz: null}\n")  # of a file in which it was not given
    assert from_yaml(tmp_path / "c.yaml", Command) == Command()
    assert "unknown option '--env.own'" in fails(["--env.own=1"], Command)
    assert "--env.hz is 0; expected at least 1" in fails(["--env.hz=0"], Command)


@dataclass
class Fit:
    policy: Open = field(default_factory=dict)
    data: Dataset = field(default_factory=Dataset)
    steps: int = 10


def test_of_layers_the_later_one_counts():
    common = {"policy": {"width": 8, "depth": 1}, "data": {"num_episodes": 7}, "steps": 20}
    fit = from_layers(
        Fit, [("common", common), ("arm", {"policy.width": 16, "data.repo_id": "a/b", "steps": 5})]
    )
    assert fit == Fit({"width": 16, "depth": 1}, Dataset("a/b", num_episodes=7), 5)
    assert from_layers(Fit, []) == Fit()
