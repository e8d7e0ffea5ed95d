"""Training is a function of data, options and seed, for every kind of policy.

It refuses what it cannot learn from.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from manip_il.cli.main import main
from manip_il.data.atomic import UNFINISHED_MARK, read_lines
from manip_il.errors import FolderExistsError, ManipError, MismatchError, NotFiniteError
from manip_il.learn.checkpoint import Checkpoint, Origin
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.samples import check_same_sources
from manip_il.learn.train import Trainer
from manip_il.learn.training_state import METRICS_FILE

from .conftest import LENGTH, make_table, write_table
from .tiny_policies import ACT, CNN, DIFFUSION, observations

MLP = {"type": "mlp", "width": 16, "depth": 2, "device": "cpu"}
VISION = {**ACT, "pretrained_backbone_weights": None, "use_vae": False}
CROPPED = {"crop_shape": [32, 48], "pretrained_backbone_weights": None}
SEEING = {**DIFFUSION, **CROPPED, "spatial_softmax_num_keypoints": 4}
VQBET = {
    "type": "vqbet",
    "device": "cpu",
    "n_vqvae_training_steps": 2,
    "spatial_softmax_num_keypoints": 4,
    **CROPPED,
}


def config(settings: Any = MLP, **changes: Any) -> FitConfig:
    values = {"steps": 4, "batch_size": 8, "save_freq": 2, "log_freq": 1, "eval_split": 0.2}
    return FitConfig(settings, **(values | changes))


@pytest.fixture
def fit(dataset, tmp_path):
    """Fits a tiny policy to a dataset in a folder of the test's."""

    def run(
        settings: Any = MLP,
        name: str = "run",
        data: Any = dataset,
        stop_after: int = 0,
        **more: Any,
    ) -> Path:
        given = {key: more.pop(key) for key in ("resume", "weights") if key in more}
        done = 0

        def step(_record: Any) -> None:
            nonlocal done
            done += 1
            if done == stop_after:
                raise KeyboardInterrupt

        return Trainer(data, config(settings, **more), tmp_path / name, **given).fit(step)

    return run


def saved(run: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes()
        for path in sorted((run / "checkpoints/last").rglob("*.safetensors"))
    }


@pytest.mark.parametrize("settings", [MLP, {**MLP, "loss": "mixture"}, ACT, DIFFUSION], ids=str)
def test_a_resumed_fit_ends_with_the_same_bits(fit, tmp_path, settings):
    fit(settings, "straight")
    with pytest.raises(KeyboardInterrupt):
        fit(settings, "stopped", stop_after=3)
    assert (tmp_path / "stopped/checkpoints/last").resolve().name == "000003"
    fit(settings, "stopped", resume=True)
    straight, stopped = saved(tmp_path / "straight"), saved(tmp_path / "stopped")
    assert {"model.safetensors", "optimizer_state.safetensors"} <= straight.keys()
    assert straight == stopped
    one, other = (
        [
            [record[key] for key in ("step", "loss", "val_loss")]
            for record in read_lines(tmp_path / name / METRICS_FILE)
        ]
        for name in ("straight", "stopped")
    )
    assert one == other


@pytest.mark.parametrize(
    ("settings", "observation"),
    [(VISION, "both"), (CNN, "images"), (SEEING, "images"), (VQBET, "images")],
    ids=lambda value: str(value["type"] if isinstance(value, dict) else value),
)
@pytest.mark.slow
def test_two_steps_are_saved_resumed_and_act(
    fit, table, write, pictured, settings, observation, tmp_path
):
    data = write(table, spec=replace(pictured, cameras=("front",)))
    more = {"data": data, "observation": observation, "save_freq": 2}
    with pytest.raises(KeyboardInterrupt):
        fit(settings, stop_after=2, **more)
    path = fit(settings, resume=True, **more)
    policy = LearnedPolicy.load(path)
    assert policy.checkpoint.observation == observation
    states, environments = observations(2)
    assert policy.act(
        states, environments, {"front": np.zeros((2, 32, 48, 3), np.uint8)}
    ).shape == (2, 4)
    records = read_lines(tmp_path / "run" / METRICS_FILE)
    assert [record["step"] for record in records] == [1, 2, 3, 4]
    assert {"grad_norm", "lr", "samples_per_s", "update_s"} <= records[0].keys()


def test_the_seed_decides_and_metrics_and_checkpoints_change_nothing(fit, weights):
    a = weights(fit({**DIFFUSION}, "a", log_freq=4, save_freq=4))
    b = weights(fit({**DIFFUSION}, "b", log_freq=1, save_freq=1))
    c = weights(fit({**DIFFUSION}, "c", seed=1))
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert not all(torch.equal(a[key], c[key]) for key in a)


def test_held_out_episodes_are_never_learnt_from(dataset, tmp_path):
    data = Trainer(dataset, config(eval_split=0.25), tmp_path).data
    assert len(set(data.held_out // LENGTH)) == 3
    assert not set(data.held_out // LENGTH) & set(data.train // LENGTH)


def test_frames_without_a_valid_label_do_not_touch_the_weights(table, write, fit, weights):
    table["label_valid"][np.random.default_rng(0).random(len(table["action"])) < 0.3] = 0
    invalid = table["label_valid"][:, 0] == 0
    rubbish = {key: column.copy() for key, column in table.items()}
    rubbish["action"][invalid] = 1e6
    rubbish["observation.environment_state"][invalid] = -1e6
    a, b = (
        weights(fit(name=name, data=write(data, name)))
        for name, data in (("a", table), ("b", rubbish))
    )
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_a_finished_run_is_neither_trained_over_nor_changed_by_resuming(fit, tmp_path, weights):
    before = weights(fit(ACT))
    assert sorted(path.name for path in (tmp_path / "run/checkpoints").iterdir()) == [
        "000002",
        "000004",
        "last",
    ]
    after = weights(fit(ACT, resume=True))
    assert all(torch.equal(before[key], after[key]) for key in before)
    with pytest.raises(FolderExistsError, match="--resume=true"):
        fit(ACT)


def test_a_half_written_checkpoint_is_passed_over(fit, tmp_path, weights):
    straight = weights(fit(name="a"))
    for stale in (".000002.partial/pretrained_model", "000002/pretrained_model"):
        (tmp_path / "b/checkpoints" / stale).mkdir(parents=True)
    (tmp_path / "b/checkpoints/.000002.partial" / UNFINISHED_MARK).touch()
    (tmp_path / "b/checkpoints/000002/pretrained_model/config.json").write_text('{"type": "mlp"}')
    after = weights(fit(name="b", resume=True))
    assert all(torch.equal(straight[key], after[key]) for key in after)


def test_a_step_that_its_checkpoint_names_is_not_run_on_resuming(fit):
    path = fit(ACT) / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    values["steps"].append(
        {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil/x"}}
    )
    path.write_text(json.dumps(values))
    with pytest.raises(ManipError, match=r"evil/x.*--trust=true"):
        fit(ACT, resume=True)


@pytest.mark.parametrize("key", ["observation.state", "observation.environment_state", "action"])
def test_nan_is_refused_with_column_and_frame(key, table, write, fit):
    data = write(table)
    [file] = data[0].data_files
    columns = pq.read_table(file).to_pydict()
    columns[key][47][1] = math.nan
    stored = pq.read_table(file)
    pq.write_table(type(stored).from_pydict(columns, schema=stored.schema), file)
    with pytest.raises(NotFiniteError, match=rf"column {key}: nan at frame 47"):
        fit(data=data)


def test_a_warm_mlp_acts_as_the_one_it_came_from_in_the_units_of_new_data(
    table, write, fit, weights
):
    first = fit(steps=50, data=write(table, "one"), name="first")
    wider = {key: column.copy() for key, column in table.items()}
    wider["observation.environment_state"] *= 3.0  # other statistics
    inputs = table["observation.state"], table["observation.environment_state"]
    for name, settings, more in (("a", MLP, {"init_from": first}), ("b", {"path": str(first)}, {})):
        second = fit(settings, name, write(wider, f"wider_{name}"), steps=1, lr=1e-12, **more)
        assert not torch.equal(
            weights(first)["model.input_scale"], weights(second)["model.input_scale"]
        )
        before, after = (LearnedPolicy.load(path).act(*inputs) for path in (first, second))
        np.testing.assert_allclose(after, before, atol=2e-5)


def test_a_policy_of_lerobots_starts_from_a_checkpoints_weights(fit, weights):
    first = fit(ACT, "first")
    for name, settings, more in (("a", {"path": str(first)}, {}), ("b", ACT, {"init_from": first})):
        before, after = weights(first), weights(fit(settings, name, steps=1, lr=1e-12, **more))
        assert all(torch.allclose(before[key], after[key], atol=1e-6) for key in before)
    (first / "model.safetensors").write_bytes(b"\x08" + bytes(7) + b"nothing}")
    with pytest.raises(ManipError, match=r"does not fit this policy"):
        fit({"path": str(first)}, "again")


def test_a_feature_that_never_moves_is_not_seen(table, fit):
    policy = LearnedPolicy.load(fit())
    environment = table["observation.environment_state"].copy()
    before = policy.act(table["observation.state"], environment)
    environment[:, 2] += 100.0
    assert np.array_equal(before, policy.act(table["observation.state"], environment))


def test_a_checkpoint_has_lerobots_layout_and_no_place_of_this_machine(
    fit, spec, dataset, tmp_path
):
    for settings in (MLP, ACT):
        path = fit(settings, settings["type"], init_from=fit(settings, f"first_{settings['type']}"))
        made = {file.name for file in path.iterdir()}
        assert {"config.json", "model.safetensors", "train_config.json", "manip_il.json"} <= made
        assert {"policy_preprocessor.json", "policy_postprocessor.json"} <= made
        for file in path.glob("*.json"):
            assert str(tmp_path) not in file.read_text(), file
            assert str(dataset[0].root.parent) not in file.read_text(), file
        origin = Checkpoint.open(path).origin
        assert origin is not None
        space = "joint_delta" if settings is MLP else "joint_target"
        assert replace(origin, options={}, datasets=[]) == Origin.of(
            spec, {"mujoco": "3.11"}, action_space=space
        )
        assert origin.options["eval_split"] == 0.2
        assert origin.datasets == [{"name": "dataset", "frames": 240, "weight": None}]
        origin.check_fits(spec)


def test_several_datasets_are_one_in_the_units_of_all_and_the_shares_asked_for(spec, tmp_path):
    tables = make_table(0), make_table(1)
    for key in ("observation.state", "action"):
        tables[1][key] = tables[1][key] + np.float32(3.0)
    roots = [
        write_table(table, tmp_path / name, spec)[0]
        for table, name in zip(tables, "ab", strict=True)
    ]
    inputs = np.concatenate(
        [
            np.hstack([one["observation.state"], one["observation.environment_state"]])
            for one in tables
        ]
    )
    for weights in ((), (3.0, 1.0)):
        trainer = Trainer(
            roots, config(eval_split=0.0), tmp_path / f"run{len(weights)}", shares=weights
        )
        np.testing.assert_allclose(trainer.policy.model.input_mean, inputs.mean(0), rtol=1e-5)
        drawn = np.concatenate([trainer.batch(step)["index"].numpy() for step in range(1000)])
        assert (drawn < 240).mean() == pytest.approx(0.75 if weights else 0.5, abs=0.02)
        assert trainer.fit().is_dir()
    weights = (np.arange(480) < 20).astype(float)
    trainer = Trainer(roots, config(), tmp_path / "few", weights=weights)
    assert max(int(trainer.batch(step)["index"].max()) for step in range(50)) < 20


def test_datasets_that_mean_other_things_are_refused_with_both_named(spec):
    for change, words in (
        ({"robot": "leg"}, r"robot differs: one has arm, other has leg"),
        ({"fps": 30}, r"fps differs: one has 25, other has 30"),
        ({"task": "lift"}, r"task differs: one has reach, other has lift"),
        ({"cameras": ("front",), "image_size": (32, 32), "video": False}, r"cameras differs"),
    ):
        both = {"one": spec, "other": replace(spec, **change)}
        with pytest.raises(MismatchError, match=words):
            check_same_sources(both, pictures=True, language=False)
    check_same_sources(both, pictures=False, language=False)


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
def test_two_processes_learn_what_one_learns_from_both_shares(
    warm_lerobot, dataset, tmp_path, weights
):
    """Every process takes its share of the batch; the gradients are averaged."""
    words = ["train", f"--dataset.root={dataset[0].root}", "--steps=3", "--save_freq=3"]
    words += ["--optimizer.type=sgd", "--optimizer.lr=0.001"]
    words += [
        f"--policy.{k}={json.dumps(v) if not isinstance(v, str) else v}" for k, v in ACT.items()
    ]
    # One action a chunk: ACT's mean over all that is no padding is then the mean of the shares'
    # means.
    words += [
        "--policy.use_vae=false",
        "--policy.dropout=0.0",
        "--policy.chunk_size=1",
        "--policy.n_action_steps=1",
    ]
    two = tmp_path / "two"
    done = warm_lerobot.run("python", "-c", LAUNCH, *words, "--batch_size=4", f"--output_dir={two}")
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("checkpoint:") == 1
    assert main([*words, "--batch_size=8", f"--output_dir={tmp_path / 'one'}"]) == 0
    one, both = (
        weights(run / "checkpoints/last/pretrained_model") for run in (tmp_path / "one", two)
    )
    assert all(torch.allclose(one[name], both[name], atol=1e-5) for name in one)
