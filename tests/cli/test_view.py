"""Episodes are watched as they happen: in a file of Rerun's every step is what was simulated."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.experimental import RrdReader

from manip_il.cli.main import main
from manip_il.collect.job import RolloutJob
from manip_il.data import schema
from manip_il.evaluation.watch import FRAME
from manip_il.mdp import Episode
from manip_il.sim.config import CAMERAS
from manip_il.worlds.table import make_config

REACH = ["view", "--task.type=reach"]
SCALARS, TEXT = "Scalars:scalars", "TextLog:text"


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def column(path: Path, entity: str, component: str) -> list[Any]:
    """What an entity has on every frame, in their order."""
    rows: dict[int, Any] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == f"/{entity}" and not chunk.is_static:
            batch = chunk.to_record_batch().to_pydict()
            rows |= {
                f: v
                for f, v in zip(batch[FRAME], batch.get(component, []), strict=False)
                if v is not None
            }
    return [rows[frame] for frame in sorted(rows)]


def simulated(task: str) -> Iterator[Episode]:
    """The same episodes, without anybody watching."""
    return RolloutJob(make_config("panda", task), hold=10).run([3_000_000, 3_000_001])


@pytest.mark.gl
def test_a_file_holds_every_step_and_a_picture_of_every_camera(tmp_path, capsys):
    path = tmp_path / "reach.rrd"
    assert main([*REACH, "--n_episodes=2", f"--output={path}"]) == 0
    out = capsys.readouterr().out
    episodes = list(simulated("reach"))
    steps = [len(episode) for episode in episodes]
    assert out.splitlines() == [
        f"seed 3000000: solved, {steps[0]} steps",
        f"seed 3000001: solved, {steps[1]} steps",
        f"next: rerun {path}",
        f"in a browser: rerun --web-viewer {path}",
    ]
    for name in (schema.STATE, schema.ACTION, schema.EXECUTED_ACTION):
        recorded = np.concatenate([episode.columns[name] for episode in episodes])
        shown = np.array(column(path, name, SCALARS)).astype(recorded.dtype)
        np.testing.assert_array_equal(shown, recorded)
    progress = np.array(column(path, schema.PROGRESS, SCALARS)).ravel()
    recorded = np.concatenate(
        [episode.columns[schema.PROGRESS].ravel() for episode in episodes]
    ).astype(float)
    np.testing.assert_allclose(progress, recorded, atol=1e-6)
    events = [line for [line] in column(path, "events", TEXT)]
    assert events == [f"seed {3_000_000 + i}: solved, {steps[i]} steps" for i in range(2)]
    assert f"/{schema.EXPERT_PHASE}" in entities(path)
    for camera in CAMERAS:
        pictures = column(path, schema.IMAGES + camera, "EncodedImage:blob")
        # JPEG
        assert [bytes(np.array(one, np.uint8).ravel()[:2]) for one in pictures] == [
            b"\xff\xd8"
        ] * sum(steps)
