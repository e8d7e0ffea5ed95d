from __future__ import annotations

import inspect
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import URLError

import numpy as np
import pandas as pd
import pytest
import torch
from huggingface_hub import ModelCard
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.cli.main import main
from manip_il.cli.outputs import read_jsonl
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_library import read_metadata
from manip_il.errors import FolderExistsError, ManipError, MismatchError
from manip_il.learn import fit_policy, train
from manip_il.learn.checkpoint import CheckpointMeta
from manip_il.learn.columns import LEARNING_COLUMNS
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.fit_policy import PolicyTrainer
from manip_il.learn.lerobot_config import policy_config, set_features
from manip_il.learn.lerobot_policy import usable_statistics
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.samples import Samples, load_samples

from .tiny_policies import ACT, DIFFUSION

VISION = {**ACT, "pretrained_backbone_weights": None, "use_vae": False}


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("demos") / "d"
    assert main(["record", f"--dataset.root={root}", "--dataset.num_episodes=5", "--workers=1"]) == 0
    return root


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    """Demonstrations with pictures."""
    root = tmp_path_factory.mktemp("pictures") / "d"
    words = ["--cameras=front,wrist", "--image.height=64", "--image.width=64", "--task.type=reach"]
    assert main(["record", f"--dataset.root={root}", "--dataset.num_episodes=2", "--workers=1", *words]) == 0
    return root


def config(settings=ACT, **changes) -> FitConfig:
    values = {"steps": 4, "batch_size": 8, "save_freq": 2, "log_freq": 1, "eval_split": 0.2}
    return FitConfig(settings, **(values | changes))


def fit(root: Path, folder: Path, settings=ACT, stop_after: int | None = None, resume=False, **changes) -> Path:
    done = 0

    def step(_record) -> None:
        nonlocal done
        done += 1
        if done == stop_after:
            raise KeyboardInterrupt

    return PolicyTrainer(root, config(settings, **changes), folder, spec=Dataset.open(root).spec, resume=resume).fit(
        step
    )


def records(folder: Path) -> list[dict[str, Any]]:
    """The metrics of a run."""
    return read_jsonl(folder / "metrics.jsonl")


def saved(folder: Path) -> dict[str, bytes]:
    last = folder / "checkpoints" / "last"
    return {p.name: p.read_bytes() for p in sorted(last.rglob("*.safetensors"))}


@pytest.mark.parametrize("settings", [ACT, DIFFUSION], ids=["act", "diffusion"])
def test_a_resumed_fit_ends_with_the_same_bits(demos, tmp_path, settings) -> None:
    fit(demos, tmp_path / "straight", settings)
    with pytest.raises(KeyboardInterrupt):
        fit(demos, tmp_path / "stopped", settings, stop_after=3)
    assert (tmp_path / "stopped/checkpoints/last").resolve().name == "000003"
    fit(demos, tmp_path / "stopped", settings, resume=True)
    straight, stopped = saved(tmp_path / "straight"), saved(tmp_path / "stopped")
    assert "model.safetensors" in straight
    assert "optimizer_state.safetensors" in straight
    assert straight == stopped
    keys = ("step", "loss", "val_loss")
    one, other = ([[r[key] for key in keys] for r in records(tmp_path / name)] for name in ("straight", "stopped"))
    assert one == other


def test_metrics_and_checkpoints_do_not_change_the_weights(demos, tmp_path) -> None:
    fit(demos, tmp_path / "often", DIFFUSION, log_freq=1, save_freq=1)
    fit(demos, tmp_path / "seldom", DIFFUSION, log_freq=4, save_freq=4)
    assert saved(tmp_path / "often")["model.safetensors"] == saved(tmp_path / "seldom")["model.safetensors"]


def test_a_fit_lowers_the_loss(demos, tmp_path) -> None:
    fit(demos, tmp_path / "r", {**ACT, "use_vae": False}, steps=60, log_freq=20, save_freq=60, lr=3e-3)
    first, second, last = records(tmp_path / "r")
    assert [record["step"] for record in (first, second, last)] == [20, 40, 60]
    assert last["loss"] < 0.7 * first["loss"]
    assert last["val_loss"] < first["val_loss"]
    assert {"grad_norm", "lr", "samples_per_s", "data_share", "l1_loss"} <= first.keys()


def acts(path: Path) -> bytes:
    """What the policy in a folder does in six states of three episodes."""
    rng, policy = np.random.default_rng(0), LearnedPolicy.load(path)
    states, environment = rng.normal(size=(6, 3, 8)), rng.normal(size=(6, 3, 25))
    actions = [
        policy.act(joints.astype(np.float32), scene.astype(np.float32), episodes=[5, 6, 7])
        for joints, scene in zip(states, environment, strict=True)
    ]
    return np.stack(actions).tobytes()


ACTS = f"""
import sys
from pathlib import Path
import numpy as np
from manip_il.learn.policy import LearnedPolicy
{inspect.getsource(acts)}
print(*(acts(Path(path)).hex() for path in sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_fresh_process_acts_to_the_bit_as_the_trained_policy(warm_lerobot, demos, tmp_path) -> None:
    paths = [fit(demos, tmp_path / settings["type"], settings) for settings in (ACT, DIFFUSION)]
    table = Dataset.open(demos).columns(LEARNING_COLUMNS)
    paths.append(train.fit(table, FitConfig(steps=4, batch_size=8), tmp_path / "mlp", spec=Dataset.open(demos).spec))
    done = warm_lerobot.run("python", "-c", ACTS, *paths)
    assert done.returncode == 0, done.stderr
    [line] = done.stdout.splitlines()  # loading prints nothing
    fresh = [bytes.fromhex(word) for word in line.split()]
    assert fresh == [acts(path) for path in paths]
    # Diffusion draws: in a rollout alone its generator is seeded by the episode.
    trainer = PolicyTrainer(demos, config(ACT), tmp_path / "act", spec=Dataset.open(demos).spec, resume=True)
    policy, rng = trainer.policy.eval(), np.random.default_rng(0)
    states, environment = rng.normal(size=(6, 3, 8)), rng.normal(size=(6, 3, 25))
    batch = {
        "observation.state": torch.from_numpy(states[0, :1].astype(np.float32)),
        "observation.environment_state": torch.from_numpy(environment[0, :1].astype(np.float32)),
    }
    with torch.inference_mode():
        ours = trainer.postprocessor(policy.select_action(trainer.preprocessor(batch)))
    first = np.frombuffer(fresh[0]).reshape(6, 3, 8)[0, :1]
    assert ours.numpy().astype(np.float64).tobytes() == first.tobytes()


def loaded(root: Path, config: FitConfig, observation: str) -> Samples:
    meta, policy = read_metadata(root), policy_config(config.policy)
    set_features(policy, meta, observation)
    return load_samples([root], policy, config, meta)


def loaded_all(roots: list[Path], config: FitConfig) -> Samples:
    """Several datasets for a policy on pictures."""
    meta, policy = read_metadata(*roots), policy_config(config.policy)
    set_features(policy, meta, "images")
    return load_samples(roots, policy, config, meta)


def edit_tasks(root: Path, text: str) -> None:
    """Give a dataset of one instruction another."""
    path = root / "meta" / "tasks.parquet"
    tasks = pd.read_parquet(path)
    tasks.rename(index=lambda _: text).to_parquet(path)


def test_held_out_episodes_are_never_learnt_from(demos) -> None:
    samples = loaded(demos, config(eval_split=0.4), "state")
    episodes = Dataset.open(demos).columns(["episode_index"])["episode_index"]
    assert len(np.unique(episodes[samples.held_out])) == 2
    assert not set(episodes[samples.held_out]) & set(episodes[samples.train])
    assert len(np.unique(episodes[samples.train])) == 3


@pytest.mark.parametrize(
    ("dataset", "settings", "observation"),
    [
        pytest.param("demos", ACT, "state", id="act"),
        pytest.param("demos", DIFFUSION, "state", id="diffusion"),
        pytest.param("pictures", VISION, "images", id="images", marks=[pytest.mark.slow, pytest.mark.gl]),
        pytest.param("pictures", VISION, "both", id="both", marks=[pytest.mark.slow, pytest.mark.gl]),
    ],
)
def test_a_batch_from_memory_and_the_cache_is_lerobots(
    request, dataset, settings, observation, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    root = request.getfixturevalue(dataset)
    meta, source = read_metadata(root), loaded(root, config(settings), observation).source
    ahead = {key: [delta / meta.fps for delta in deltas.tolist()] for key, deltas in source.windows.deltas.items()}
    lerobots: Any = LeRobotDataset(meta.repo_id, root=root, delta_timestamps=ahead or None)
    rows = [np.array([0, 3, 20, meta.total_frames - 1]), np.array([7])]
    for ours, own in zip(source.batches(rows), rows, strict=True):
        theirs = torch.utils.data.default_collate([lerobots[int(row)] for row in own])
        for key, value in ours.items():
            if key == "task":
                assert list(value) == list(theirs[key])
                continue
            other = theirs[key]
            if value.dtype == torch.uint8:
                value = value.to(torch.float32) / 255.0
                other = other.to(torch.float32) / (255.0 if other.dtype == torch.uint8 else 1.0)
            assert torch.equal(value.to(torch.float64), other.to(torch.float64).reshape(value.shape)), key


@pytest.mark.slow
@pytest.mark.gl
def test_an_image_policy_trains_from_the_cache_and_without_it(pictures, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    one = {"observation": "images", "batch_size": 4, "steps": 2, "image_augment": False}
    fit(pictures, tmp_path / "cached", VISION, **one)
    fit(pictures, tmp_path / "loaded", VISION, **one, image_cache_gb=0.0, num_workers=0)
    ours, theirs = ([record["loss"] for record in records(tmp_path / name)] for name in ("cached", "loaded"))
    assert ours == theirs


@pytest.mark.slow
@pytest.mark.gl
def test_several_datasets_with_pictures_are_one_in_the_cache_and_without_it(pictures, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    other = tmp_path / "other"
    words = ["--cameras=front,wrist", "--image.height=64", "--image.width=64", "--task.type=reach", "--seed=1"]
    assert main(["record", f"--dataset.root={other}", "--dataset.num_episodes=1", "--workers=1", *words]) == 0
    edit_tasks(other, "Touch the ball.")
    roots, settings = [pictures, other], {"type": "cnn", "width": 16, "device": "cpu"}
    both = [loaded_all(roots, config(settings, image_cache_gb=limit, num_workers=0)) for limit in (1.0, 0.0)]
    assert [one.source.workers for one in both] == [None, 0]
    frames = [read_metadata(root).total_frames for root in roots]
    rows = np.array([0, frames[0] - 1, frames[0], sum(frames) - 1])
    ours, theirs = (next(one.source.batches([rows])) for one in both)
    assert ours["task"] == theirs["task"]
    assert ours["task"][2:] == ["Touch the ball."] * 2
    for key in ("index", "episode_index", "task_index", "action", "observation.images.front"):
        assert torch.equal(ours[key].reshape(-1), theirs[key].reshape(-1)), key
    assert ours["index"].tolist() == rows.tolist()


@pytest.mark.slow
@pytest.mark.gl
def test_a_cnn_is_trained_and_evaluated_on_the_pictures_that_it_saw(pictures, tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run, small = tmp_path / "r", ["--policy.channels=[4, 8]", "--policy.keypoints=4", "--policy.width=8"]
    words = ["train", f"--dataset.root={pictures}", "--policy.type=cnn", *small, "--batch_size=4", "--steps=2"]
    assert main([*words, f"--output_dir={run}"]) == 0
    evaluate = ["eval", f"--policy.path={run}", "--eval.n_episodes=1", "--env.horizon=6", "--workers=1"]
    evaluate.append("--eval.films=0")
    assert main([*evaluate, f"--output_dir={tmp_path / 'eval'}"]) == 0
    result = json.loads((tmp_path / "eval" / "eval.json").read_text())
    assert result["fingerprint"]["cameras_sha256"]
    assert result["episodes"][0]["steps"] == 6
    assert main([*evaluate, "--robot.type=fetch", f"--output_dir={tmp_path / 'other'}"]) == 1
    assert re.search("panda.*fetch|fetch.*panda", capfd.readouterr().err.strip().splitlines()[-1])
    assert not (tmp_path / "other").exists()


def test_a_run_is_neither_trained_over_nor_continued_with_other_options_or_data(demos, tmp_path) -> None:
    fit(demos, tmp_path / "r")
    with pytest.raises(FolderExistsError):
        fit(demos, tmp_path / "r")
    with pytest.raises(MismatchError, match="batch_size"):
        fit(demos, tmp_path / "r", resume=True, batch_size=4)
    with pytest.raises(MismatchError, match="policy"):
        fit(demos, tmp_path / "r", {**ACT, "dropout": 0.0}, resume=True)
    other = tmp_path / "other"
    assert main(["record", f"--dataset.root={other}", "--dataset.num_episodes=4", "--workers=1"]) == 0
    with pytest.raises(MismatchError, match="training data"):
        fit(other, tmp_path / "r", resume=True)


def test_a_backbone_that_cannot_be_downloaded_is_one_line_with_two_ways_out(demos, tmp_path, monkeypatch) -> None:
    def no_network(*_args, **_kwargs):
        raise URLError("no network")

    monkeypatch.setattr("manip_il.learn.lerobot_policy.make_policy", no_network)
    with pytest.raises(ManipError) as raised:
        fit(demos, tmp_path / "r")
    for word in ("--policy.pretrained_backbone_weights=null", "checkpoints", "ResNet18_Weights"):
        assert word in str(raised.value)


def test_a_column_that_hardly_moves_is_not_blown_up() -> None:
    flat = {"mean": np.zeros(2), "std": np.array([1e-7, 0.5]), "min": np.zeros(2), "max": np.array([1e-6, 2.0])}
    usable = usable_statistics({"observation.state": flat, "observation.images.front": flat})
    assert usable["observation.state"]["std"].tolist() == [1e-3, 0.5]
    assert usable["observation.state"]["max"].tolist() == [1e-2, 2.0]
    assert usable["observation.images.front"]["std"].tolist() == [1e-7, 0.5]


def test_a_checkpoint_has_lerobots_layout_and_a_card(demos, tmp_path) -> None:
    path = fit(demos, tmp_path / "r")
    made = {file.name for file in path.iterdir()}
    assert {"config.json", "model.safetensors", "train_config.json", "manip_il.json", "README.md"} <= made
    assert {"policy_preprocessor.json", "policy_postprocessor.json"} <= made
    assert json.loads((path / "config.json").read_text())["pretrained_backbone_weights"] is None
    card = ModelCard.load(path / "README.md")
    assert card.data.to_dict().items() >= {"library_name": "lerobot", "pipeline_tag": "robotics"}.items()
    assert "5 episodes" in card.text
    assert "val_loss" in card.text
    assert str(tmp_path) not in card.text
    meta = LearnedPolicy.load(path).meta
    assert meta is not None
    assert meta.options["steps"] == 4
    assert replace(meta, options={}) == CheckpointMeta.of(Dataset.open(demos).spec, action_space="joint_target")


def test_curves_for_tensorboard_and_weights_and_biases(demos, tmp_path, curves) -> None:
    fit(demos, tmp_path / "r", **curves.options)
    assert curves.steps(tmp_path / "r") == [1, 2, 3, 4]


def test_a_checkpoint_to_start_from_that_does_not_fit_is_one_line(demos, tmp_path) -> None:
    path = fit(demos, tmp_path / "r")
    (path / "model.safetensors").write_bytes(b"\x08" + bytes(7) + b"nothing}")
    with pytest.raises(ManipError, match=r"does not fit this policy.*cannot be read"):
        fit(demos, tmp_path / "again", {"path": str(path)})


@pytest.mark.parametrize(
    "name", ["training_step.json", "optimizer_state.safetensors", "scheduler_state.json", "rng_state.safetensors"]
)
def test_a_run_whose_state_is_broken_is_not_resumed(name, demos, tmp_path) -> None:
    settings = {**DIFFUSION, "scheduler_warmup_steps": 1}
    fit(demos, tmp_path / "r", settings)
    (tmp_path / "r/checkpoints/last/training_state" / name).write_bytes(b"[[[")
    with pytest.raises(ManipError, match=rf"{name} is not valid JSON|cannot be resumed .*--overwrite=true"):
        fit(demos, tmp_path / "r", settings, resume=True)


def test_a_step_that_its_checkpoint_names_is_not_run_on_resuming(demos, tmp_path) -> None:
    path = fit(demos, tmp_path / "r") / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    values["steps"].append({"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil/x"}})
    path.write_text(json.dumps(values))
    with pytest.raises(ManipError, match=r"evil/x.*--trust=true"):
        fit(demos, tmp_path / "r", resume=True)


def test_half_precision_trains_in_bfloat16_on_a_cpu(demos, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(fit_policy, "_on_this_cpu", lambda: "bf16")  # also one that has it not, slowly
    path = fit(demos, tmp_path / "half", {**ACT, "use_amp": True})
    fit(demos, tmp_path / "full", ACT)
    assert saved(tmp_path / "half")["model.safetensors"] != saved(tmp_path / "full")["model.safetensors"]
    assert json.loads((path / "config.json").read_text())["use_amp"] is True


def test_a_policy_starts_from_a_checkpoints_weights(demos, tmp_path, weights) -> None:
    first = fit(demos, tmp_path / "first")
    second = fit(demos, tmp_path / "second", {"path": str(first)}, steps=1, lr=1e-12)
    before, after = weights(first), weights(second)
    assert all(torch.allclose(before[name], after[name], atol=1e-6) for name in before)


# `torchrun --standalone --nproc_per_node=2`, with processes that need not import torch again
LAUNCH = """
import sys
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from manip_il.cli.main import main
place = {"rdzv_backend": "c10d", "rdzv_endpoint": "localhost:0"}
config = LaunchConfig(min_nodes=1, max_nodes=1, nproc_per_node=2, run_id="two", start_method="fork", **place)
sys.exit(max(elastic_launch(config, main)(sys.argv[1:]).values()))
"""


@pytest.mark.slow
def test_two_processes_learn_what_one_learns_from_both_shares(warm_lerobot, demos, tmp_path, weights) -> None:
    """Every process takes its share of the batch; the gradients are averaged."""
    words = ["train", f"--dataset.root={demos}", "--steps=3", "--save_freq=3"]
    words += ["--optimizer.type=sgd", "--optimizer.lr=0.001"]
    words += [f"--policy.{k}={json.dumps(v) if not isinstance(v, str) else v}" for k, v in ACT.items()]
    # One action a chunk: ACT's mean over all that is no padding is then the mean of the shares' means.
    words += ["--policy.use_vae=false", "--policy.dropout=0.0", "--policy.chunk_size=1", "--policy.n_action_steps=1"]
    two = tmp_path / "two"
    done = warm_lerobot.run("python", "-c", LAUNCH, *words, "--batch_size=4", f"--output_dir={two}")
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("checkpoint:") == 1
    assert done.stderr.count("3/3") == 1
    assert main([*words, "--batch_size=8", f"--output_dir={tmp_path / 'one'}"]) == 0
    one, both = (weights(run / "checkpoints/last/pretrained_model") for run in (tmp_path / "one", two))
    assert all(torch.allclose(one[name], both[name], atol=1e-5) for name in one)


@pytest.mark.slow
def test_lerobot_train_goes_on_with_our_run(warm_lerobot, demos, tmp_path) -> None:
    path = fit(demos, tmp_path / "r")
    words = [f"--config_path={path / 'train_config.json'}", "--resume=true", "--steps=6", "--num_workers=0"]
    done = warm_lerobot.run("lerobot-train", *words)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "r/checkpoints/last").resolve().name == "000006"
    policy = LearnedPolicy.load(tmp_path / "r/checkpoints/last/pretrained_model")
    assert policy.interface.numbers["observation.state"] == 8
