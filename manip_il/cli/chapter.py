"""`manip-il reward pairs|ask|answer|fit`: rewards from preferences.

`manip-il theory`: the proven bounds of cloning and DAgger, on small MDPs and on the rounds of a
run.

`manip-il rl gail`, `airl`, `ppo`: reinforcement learning from demonstrations or a learnt reward.
"""

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.chapter.config import DiscriminatorConfig, LearningConfig, PPOConfig
from manip_il.cli.common_options import DatasetRoots, EngineOptions, OfDataset, worker_count
from manip_il.cli.outputs import Output, OutputFile, output_file, output_folder
from manip_il.cli.parsing import Given, given
from manip_il.option import Seeded, option


@dataclass(frozen=True)
class OfPairs:
    """Options of a command on pairs of clips."""

    pairs: Path = option(MISSING, "pairs.json from manip-il reward pairs", positional=True)
    sources: list[Path] = option(MISSING, "the datasets or runs from which the pairs were chosen")


@dataclass(frozen=True)
class PairsOptions(Seeded, OutputFile):
    """Choose pairs of clips from datasets of one task, for comparison by people (ask) or simulated
    teachers (answer).

    A SOURCE is a dataset or a run; each round of a DAgger run is one source. All sources appear
    equally often. Episodes shorter than --clip are left out.

    Example: manip-il reward pairs runs/dagger --count=200 --output=pairs.json
    """

    sources: list[Path] = option(MISSING, "manip-il datasets, or runs", positional=True)
    clip: int = option(20, "length of a clip [control steps]", at_least=1)
    count: int = option(200, "number of pairs", at_least=1)
    output: Path = output_file("pairs.json")


@dataclass(frozen=True)
class AskOptions(OfPairs, OutputFile):
    """Write a page that shows the pairs as films and asks which is better.

    It works offline and on a phone.

    Keys: left and right arrow, down for equal, S to skip, U to undo. The browser keeps the answers
    until they are saved as preferences.json.

    Example: manip-il reward ask pairs.json --sources=runs/dagger --output=ask.html
    """

    output: Path = output_file("ask.html")
    robot: Path | None = option(None, "YAML file of the sources' robot, if it is your own")


@dataclass(frozen=True)
class AnswerOptions(OfPairs, Seeded, OutputFile):
    """Let a simulated teacher answer pairs by the clips' true progress (B-Pref, Lee et al. 2021).

    Teachers: perfect; boltzmann:TEMPERATURE, less certain if returns are close; mistaken:SHARE,
    wrong on that share of the pairs. A clip's return is the sum of progress over its steps.

    Example: manip-il reward answer pairs.json --sources=runs/dagger --output=preferences.json
    """

    teacher: str = option(
        "perfect", "perfect, boltzmann[:TEMPERATURE] (default 1) or mistaken[:SHARE] (default 0.1)"
    )
    output: Path = output_file("preferences.json")


@dataclass(frozen=True)
class FitOptions(OfPairs, Seeded, Output):
    """Fit a reward of state and action to answers about pairs (Bradley-Terry), as an ensemble of
    small networks.

    Each pair is held out from one network; fit.json has the agreement on held-out pairs. ANSWERS
    are files from ask or answer, by one person or several, about PAIRS.
    OUTPUT_DIR/pretrained_model holds the reward.

    Example: manip-il reward fit pairs.json preferences.json --sources=runs/dagger
    --output_dir=runs/reward
    """

    answers: list[Path] = option(MISSING, "preferences.json from ask or answer", positional=True)
    members: int = option(
        8, "number of networks in the ensemble, and of folds of the pairs", at_least=3, at_most=64
    )
    output_dir: Path = output_folder("runs/reward")


@dataclass(frozen=True)
class IrlOptions(OfDataset, Seeded, Output):
    """Learn the weights of a reward from a dataset of demonstrations of the task carry.

    Writes reward.json, for --task.type=carry:FILE, and report.html, with the weights and maps of
    the cost.

    Example: manip-il reward irl datasets/carry --method=bayesian --output_dir=runs/irl
    """

    method: Literal["max_margin", "bayesian", "max_entropy"] = option("max_entropy", "algorithm")
    output_dir: Path = output_folder("runs/irl")


@dataclass(frozen=True)
class TheoryOptions(EngineOptions, Output):
    """Compare the proven bounds of cloning and DAgger with exactly solved MDPs, linear systems and
    the arm.

    Writes report.html and theory.json. SOURCE is a run of `manip-il dagger`: for every round, the
    policy's distribution shift and the gap between its value and the expert's are measured, and
    the gap is compared with the bounds of cloning and DAgger.

    Example: manip-il theory runs/dagger --output_dir=runs/theory
    """

    source: Path | None = option(
        None, "a run of manip-il dagger, to measure its rounds", positional=True
    )
    episodes: int = option(50, "episodes of the expert and of every round's policy", at_least=2)
    cases: int = option(
        30, "episodes per kind of perturbation, to measure the cost of a wrong action", at_least=1
    )
    output_dir: Path = output_folder("runs/theory")


@dataclass(frozen=True)
class Learning(EngineOptions, Output):
    """What `rl gail`, `rl airl` and `rl ppo` share: options, run, progress and report."""

    method: ClassVar[str]
    init: Path | None = option(
        None, "a cloned mlp (a checkpoint or a run) to start from; by default a new policy"
    )
    settings: Given = given(LearningConfig, prefix="")
    ppo: PPOConfig = field(default_factory=PPOConfig)
    workers: int | None = worker_count(1)


@dataclass(frozen=True, kw_only=True)
class GailOptions(Learning):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the expert's, and PPO learns to fool it.
    OUTPUT_DIR/best holds the policy with the highest validation success: an mlp like that of
    `manip-il train`.

    Example: manip-il rl gail --dataset.root=datasets/demos --init=runs/cloned
    --output_dir=runs/gail
    """

    method: ClassVar[str] = "gail"
    dataset: DatasetRoots
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    output_dir: Path = output_folder("runs/gail")


@dataclass(frozen=True, kw_only=True)
class AirlOptions(GailOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il rl gail`, with the discriminator exp f / (exp f + pi): f is a learnt reward and
    its shaping, pi the policy's density. With --discriminator.state_only=true, OUTPUT_DIR/reward
    holds the reward after the last iteration, for `manip-il data score` and `rl ppo`.

    Example: manip-il rl airl --dataset.root=datasets/demos --init=runs/cloned
    --output_dir=runs/airl
    """

    method: ClassVar[str] = "airl"
    output_dir: Path = output_folder("runs/airl")


@dataclass(frozen=True, kw_only=True)
class PpoOptions(Learning):
    """Improve a cloned policy (--init) by PPO with a learnt reward, from preferences or AIRL.

    Episodes continue after success, because the reward scores every state. OUTPUT_DIR/best holds
    the policy with the highest validation success, which may be the initial one.

    Example: manip-il rl ppo --init=runs/cloned --reward=runs/reward --output_dir=runs/ppo
    """

    method: ClassVar[str] = "ppo"
    init: Path = option(MISSING, "the cloned mlp (a checkpoint or a run) to improve")
    reward: Path = option(MISSING, "the reward: a folder from manip-il reward fit or rl airl")
    output_dir: Path = output_folder("runs/ppo")
