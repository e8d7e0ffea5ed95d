"""The chapter's other methods in Python, as the course uses them: theory, inverse RL, GAIL,
preferences.
"""

from manip_il.chapter.config import LearningConfig
from manip_il.chapter.inverse import Inverse, Learnt, learn, read_carried
from manip_il.chapter.learning import LearningRun
from manip_il.chapter.preferences.fitting import fit_answers
from manip_il.chapter.preferences.pairs import (
    Teacher,
    answer_pairs,
    choose_pairs,
    join_answers,
    read_frames,
)
from manip_il.chapter.reward import LearnedReward, shape_for
from manip_il.chapter.theory.bounds import PROCESSES, curves
from manip_il.chapter.theory.shift import measure_shift
from manip_il.collect.workers import Engine
from manip_il.learn.checkpoint import Origin
from manip_il.tasks.carry.layout import FEATURES, TASTES

__all__ = [
    "FEATURES",
    "PROCESSES",
    "TASTES",
    "Engine",
    "Inverse",
    "LearnedReward",
    "LearningConfig",
    "LearningRun",
    "Learnt",
    "Origin",
    "Teacher",
    "answer_pairs",
    "choose_pairs",
    "curves",
    "fit_answers",
    "join_answers",
    "learn",
    "measure_shift",
    "read_carried",
    "read_frames",
    "shape_for",
]
