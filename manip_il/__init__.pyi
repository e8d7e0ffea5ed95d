from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.imitation import dagger
from manip_il.collect.record import record
from manip_il.data.dataset import Dataset
from manip_il.evaluation.measuring import evaluate
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import train
from manip_il.mdp import Label, State
from manip_il.sim.config import CameraConfig
from manip_il.worlds.gym.world import GymWorld
from manip_il.worlds.ladder.expert import LadderExpert as Expert
from manip_il.worlds.ladder.world import make_env
from manip_il.worlds.table import make_config

__all__ = [
    "CameraConfig",
    "Checkpoint",
    "Dataset",
    "Expert",
    "FitConfig",
    "GymWorld",
    "Label",
    "LearnedPolicy",
    "RunConfig",
    "State",
    "dagger",
    "evaluate",
    "make_config",
    "make_env",
    "record",
    "train",
]
__version__: str
