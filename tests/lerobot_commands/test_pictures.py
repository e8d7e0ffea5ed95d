"""LeRobot's commands with cameras: OpenGL in their processes and in those of their environments."""

import json

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.data.schema import EXECUTED_ACTION
from manip_il.sim.config import CameraConfig
from manip_il.worlds.table import make_config

pytestmark = [pytest.mark.slow, pytest.mark.gl]
SIDE, STEPS, COUNT = 32, 10, 4


def frames(path) -> np.ndarray:
    pictures: list[np.ndarray] = []
    with av.open(str(path)) as film:
        pictures += [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    return np.stack(pictures)


def test_act_on_pictures_trains_and_acts_alike_in_lerobot_eval_and_in_ours(
    command, trial, record, act_words, lerobots, tmp_path
):
    demos = record("seen", 3, "--cameras=front", f"--image.height={SIDE}", f"--image.width={SIDE}")
    reach = trial(
        make_config("panda", "reach", horizon=STEPS, tolerance=0.3),
        COUNT,
        CameraConfig(("front",), SIDE, SIDE),
    )
    inputs = {  # LeRobot would take environment_state too: it is a column of every dataset of ours
        "observation.state": {"type": "STATE", "shape": [8]},
        "observation.images.front": {"type": "VISUAL", "shape": [3, SIDE, SIDE]},
    }
    train = act_words(demos, tmp_path / "run", steps=3)
    images_only = f"--policy.input_features={json.dumps(inputs)}"
    command(
        "lerobot-train", *train, images_only, "--batch_size=4", *reach.words(2, asynchronous=True)
    )
    policy = tmp_path / "run/checkpoints/last/pretrained_model"
    assert json.loads((policy / "config.json").read_text())["input_features"] == inputs
    film = frames(next(tmp_path.glob("run/eval/**/eval_episode_0.mp4")))
    assert film.shape == (STEPS, 480, 640, 3)
    assert film[0].std() > 10
    assert (film[0] != film[-1]).any()

    words = [*reach.words(COUNT, asynchronous=False), "--eval.recording=true"]
    command("lerobot-eval", f"--policy.path={policy}", *words, f"--output_dir={tmp_path / 'eval'}")
    executed: dict[int, np.ndarray] = {}
    ours = reach.ours(
        policy, lambda episode: executed.update({episode.seed: episode.columns[EXECUTED_ACTION]})
    )
    assert lerobots(tmp_path / "eval")["sum_rewards"] == [episode.ret for episode in ours]
    for i, seed in enumerate(reach.seeds):
        folder = tmp_path / f"eval/recordings/manip_il_0/env_{i}"
        recorded = pq.read_table(next(folder.glob("data/**/*.parquet")))
        np.testing.assert_allclose(
            np.stack(recorded["action"].to_numpy()), executed[seed], atol=1e-5
        )
        assert frames(next(folder.glob("videos/observation.images.front/**/*.mp4"))).shape == (
            STEPS,
            SIDE,
            SIDE,
            3,
        )
