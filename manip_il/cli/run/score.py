"""Run `manip-il data score`: score a dataset's episodes by a reward."""

from __future__ import annotations

from pathlib import Path

from manip_il.chapter.preferences import scores as scoring
from manip_il.chapter.preferences.pairs import read_frames
from manip_il.chapter.reward import LearnedReward
from manip_il.cli.data_check import ScoreOptions
from manip_il.cli.outputs import publish
from manip_il.errors import ManipError
from manip_il.learn.policy_folder import find_policy

PROGRESS = "progress"  # value of --reward: score by true progress


def run_score(options: ScoreOptions) -> None:
    """Score, print the worst episodes, write the files."""
    data = read_frames(options.dataset)
    if options.reward != PROGRESS:
        reward = LearnedReward.load(find_policy(Path(options.reward).expanduser()))
        reward.check_fits(str(options.dataset), data.spec)
        found = reward(data.inputs).astype("float64").clip(0.0, 1.0)
    elif data.progress is not None:
        found = data.progress
    else:
        raise ManipError(f"{options.dataset} has no progress column; give --reward=FOLDER")
    scores = scoring.Scores(str(options.dataset), options.reward, data, found)
    with options.open(Path(options.reward).expanduser()) as folder:
        scoring.write_weights(folder / scoring.WEIGHTS_FILE, scores)
        worst = [scoring.worst_table(scores)]
        publish(folder / scoring.FILE_NAME, scores.to_json(), worst, *scoring.fact_lines(scores))
