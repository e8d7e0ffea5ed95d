"""Several datasets are learnt from as one: in the shares asked for, in the units of all of them, or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.batches import order_of
from manip_il.learn.checkpoint import read_meta
from manip_il.learn.columns import learning_rows
from manip_il.learn.fit_config import FitConfig, check_weights
from manip_il.learn.network import fit_statistics
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.sources import Sources, check_same_sources
from manip_il.learn.train import fit

from .conftest import make_table

A, B = Path("a"), Path("b")
TINY = FitConfig({"width": 16, "depth": 2, "device": "cpu"}, steps=4, batch_size=32, eval_split=0.2)


def two_tables() -> dict[str, np.ndarray]:
    """Two tables one after the other; the second's states lie elsewhere."""
    one, two = make_table(0), make_table(1)
    for key in ("observation.state", "action"):
        two[key] = two[key] + np.float32(3.0)
    two["episode_index"] = two["episode_index"] + one["episode_index"].max() + 1
    return {key: np.concatenate([one[key], two[key]]) for key in one}


def test_samples_are_drawn_in_the_shares_of_the_weights_whatever_the_sizes():
    sources = Sources((A, B), (100, 900), (3.0, 1.0))
    rows = np.delete(np.arange(1000), np.arange(0, 60))  # some are held out
    weights = sources.row_weights(rows)
    assert weights is not None
    order = order_of(len(rows), weights, 4000, seed=0)
    drawn = rows[np.concatenate([order.batch(step).numpy() for step in range(5)])]
    assert (drawn < 100).mean() == pytest.approx(0.75, abs=0.02)
    assert Sources((A, B), (100, 900)).row_weights(rows) is None
    with pytest.raises(ManipError, match="a has no sample to learn from"):
        sources.row_weights(np.arange(100, 200))


def test_the_units_are_those_of_the_union_whatever_the_weights(spec, tmp_path):
    table = two_tables()
    rows = learning_rows(table)
    half = len(table["action"]) // 2
    for weights in ((), (9.0, 1.0)):
        config, sources = replace(TINY, eval_split=0.0), Sources((A, B), (half, half), weights)
        path = fit(table, config, tmp_path / str(len(weights)), spec=spec, sources=sources)
        network = LearnedPolicy.load(path).module
        expected = fit_statistics(rows.inputs, rows.targets, "mse")
        np.testing.assert_array_equal(network.input_mean, expected.input_mean)
        np.testing.assert_array_equal(network.target_scale, expected.target_scale)
        meta = read_meta(path)
        assert meta is not None
        assert [one["root"] for one in meta.datasets] == ["a", "b"]
        assert [one["weight"] for one in meta.datasets] == (list(weights) or [None, None])


def test_a_run_is_resumed_on_the_same_datasets_with_the_same_weights_only(spec, tmp_path):
    table = two_tables()
    half = len(table["action"]) // 2
    sources = Sources((A, B), (half, half), (2.0, 1.0))
    before = fit(table, TINY, tmp_path / "run", spec=spec, sources=sources)
    longer = replace(TINY, save_freq=2)
    assert fit(table, longer, tmp_path / "run", spec=spec, sources=sources, resume=True) == before
    other = {key: np.roll(column, half, axis=0) for key, column in table.items()}
    for data, these in ((other, sources), (table, Sources((A, B), (half, half), (1.0, 1.0))), (make_table(), None)):
        with pytest.raises(MismatchError, match="training data differs: checkpoint"):
            fit(data, TINY, tmp_path / "run", spec=spec, sources=these, resume=True)


@pytest.mark.parametrize(
    ("roots", "weights", "words"),
    [
        ((), (), "names no dataset"),
        ((A, Path("c/../a")), (), "names a and c/../a, one dataset"),
        ((A, B), (1.0,), "--dataset.weights has 1 numbers, --dataset.root 2 datasets"),
        ((A, B), (1.0, 0.0), "--dataset.weights is 0 for b; expected more than 0"),
        ((A, B), (1.0, float("inf")), "--dataset.weights is inf for b"),
    ],
)
def test_weights_that_do_not_fit_the_datasets_are_refused(roots, weights, words: str):
    with pytest.raises(UsageError, match=words):
        check_weights(roots, weights)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"robot": "leg"}, "robot differs: a has arm, b has leg"),
        ({"fps": 30}, "fps differs: a has 25, b has 30"),
        ({"action_meaning": "velocities"}, "action_meaning differs: a has .*, b has velocities"),
        ({"task": "lift"}, "task differs: a has reach, b has lift"),
        ({"cameras": ("front",), "image_size": (32, 32)}, r"cameras differs: a has \(\), b has \('front',\)"),
    ],
)
def test_datasets_that_mean_other_things_are_refused_with_both_named(spec: RobotTaskSpec, change, words: str):
    other = replace(spec, **change)
    with pytest.raises(MismatchError, match=words):
        check_same_sources((A, B), (spec, other), pictures=True, language=False)


def test_what_the_policy_does_not_see_may_differ(spec: RobotTaskSpec):
    check_same_sources(
        (A, B), (spec, replace(spec, cameras=("front",), image_size=(32, 32))), pictures=False, language=False
    )
    check_same_sources((A, B), (spec, replace(spec, task="lift")), pictures=True, language=True)
