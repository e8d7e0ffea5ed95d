"""`manip-il reward irl|pairs|ask|answer|fit`: rewards from demonstrations and preferences."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.cli.common_options import OfDataset
from manip_il.cli.options import command_line, group, to_plain
from manip_il.cli.outputs import Output, OutputFile, publish
from manip_il.cli.progress import progress, say, say_next
from manip_il.data.atomic import write_file, write_json
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import Seeded, option
from manip_il.seeding import rng_for, stream_base


@dataclass(frozen=True)
class OfPairs:
    """Options of a command on pairs of clips."""

    pairs: Path = option(MISSING, "pairs.json from manip-il reward pairs", positional=True, exists="")
    sources: list[Path] = option(MISSING, "the datasets or runs from which the pairs were chosen", exists="datasets/")


def sources_option(options: OfPairs | PairsOptions) -> str:
    """Return the option that names the sources again, for the next command."""
    return f"--sources={','.join(map(str, options.sources))}"


@dataclass(frozen=True)
class IrlOptions(OfDataset, Seeded):
    """Learn the weights of a reward from a dataset of demonstrations of the task carry.

    Writes reward.json, for --task.type=carry:FILE, and report.html, with the weights and maps of the cost.
    """

    example: ClassVar[str] = "manip-il reward irl datasets/carry --method=bayesian --output_dir=runs/irl"
    method: Literal["max_margin", "bayesian", "max_entropy"] = option("max_entropy", "algorithm")
    output: Output = group(Output(Path("runs/irl")), prefix="")

    def run(self) -> None:
        """Read, learn, write the reward and the report, print the weights."""
        from manip_il.algorithms import inverse
        from manip_il.rewards.methods import learn

        with progress(None, f"irl {self.dataset}") as bar:
            carried = inverse.read_carried(self.dataset, bar.step)
        rng = rng_for(stream_base("training", self.seed), "irl")
        learnt = learn(self.method, [one.demonstration for one in carried], rng)
        found = inverse.Inverse(str(self.dataset), tuple(carried), learnt)
        with self.output.open(self) as folder:
            page = inverse.inverse_report(found, command_line(), to_plain(self))
            publish(folder / inverse.FILE_NAME, found.to_json(), [inverse.weight_table(found)], page=page)
        say_next("eval", "--policy.type=expert", f"--task.type=carry:{folder / inverse.FILE_NAME}")


@dataclass(frozen=True)
class PairsOptions(Seeded):
    """Choose pairs of clips from datasets of one task, for comparison by people (ask) or simulated teachers (answer).

    A SOURCE is a dataset or a run; each round of a DAgger run is one source. Without --reward all sources appear
    equally often. Episodes shorter than --clip are left out.
    """

    example: ClassVar[str] = "manip-il reward pairs runs/dagger --count=200 --output=pairs.json"
    sources: list[Path] = option(MISSING, "manip-il datasets, or runs", positional=True)
    clip: int = option(20, "length of a clip [control steps]", at_least=1)
    count: int = option(200, "number of pairs", at_least=1)
    reward: Path | None = option(None, "a fitted reward, for pairs on which its networks disagree most", exists="")
    file: OutputFile = group(OutputFile(Path("pairs.json")), prefix="")

    def run(self) -> None:
        """Read the sources, choose, and write the pairs."""
        from manip_il.learn.reward import LearnedReward
        from manip_il.preferences.frames import find_datasets
        from manip_il.preferences.pairs import choose_pairs

        self.file.check()
        reward = LearnedReward.load(find_policy(self.reward)) if self.reward else None
        rng = rng_for(stream_base("training", self.seed), "pairs")
        clips = choose_pairs(find_datasets(self.sources), self.clip, self.count, self.seed, rng, reward)
        write_json(self.file.output, clips.pairs.to_json())
        say(f"{len(clips.pairs):,} pairs from {len(clips.pairs.sources)} datasets: {self.file.output}")
        say_next("reward", "ask", self.file.output, sources_option(self), "--output=ask.html")


@dataclass(frozen=True)
class AskOptions(OfPairs):
    """Write a page that shows the pairs as films and asks which is better; it works offline and on a phone.

    Keys: left and right arrow, down for equal, S to skip, U to undo. The browser keeps the answers until they are saved
    as preferences.json.
    """

    example: ClassVar[str] = "manip-il reward ask pairs.json --sources=runs/dagger --output=ask.html"
    file: OutputFile = group(OutputFile(Path("ask.html")), prefix="")
    robot: Path | None = option(None, "YAML file of the sources' robot, if it is your own")

    def run(self) -> None:
        """Render the films and write the page."""
        from manip_il.preferences.asking import render_films, render_page
        from manip_il.preferences.frames import find_datasets
        from manip_il.preferences.pairs import Pairs, read_clips

        self.file.check()
        clips = read_clips(Pairs.read(self.pairs), find_datasets(self.sources))
        with progress(len(clips.pairs), "render") as bar:
            films = render_films(clips, self.robot, bar.step)
        page = render_page(clips.pairs, clips.frames[0].spec.instruction, films)
        write_file(self.file.output, page.encode())
        say(f"{len(clips.pairs):,} pairs: {self.file.output}")
        say_next("reward", "fit", self.pairs, "preferences.json", sources_option(self), "--output_dir=runs/reward")


@dataclass(frozen=True)
class AnswerOptions(OfPairs, Seeded):
    """Let a simulated teacher answer pairs by the clips' true progress (B-Pref, Lee et al. 2021).

    Teachers: perfect; boltzmann:TEMPERATURE, less certain if returns are close; mistaken:SHARE, wrong on that share
    of the pairs. A clip's return is the sum of progress over its steps.
    """

    example: ClassVar[str] = "manip-il reward answer pairs.json --sources=runs/dagger --output=preferences.json"
    teacher: str = option("perfect", "perfect, boltzmann[:TEMPERATURE] (default 1) or mistaken[:SHARE] (default 0.1)")
    file: OutputFile = group(OutputFile(Path("preferences.json")), prefix="")

    def run(self) -> None:
        """Compare every pair and write the answers."""
        from manip_il.preferences.answers import Teacher, answer_pairs
        from manip_il.preferences.frames import find_datasets
        from manip_il.preferences.pairs import Pairs, read_clips

        self.file.check()
        teacher = Teacher.parse(self.teacher)
        clips = read_clips(Pairs.read(self.pairs), find_datasets(self.sources))
        rng = rng_for(stream_base("training", self.seed), "teacher")
        write_json(self.file.output, answer_pairs(teacher, clips, rng).to_json())
        say(f"{len(clips.pairs):,} answers: {self.file.output}")
        say_next("reward", "fit", self.pairs, self.file.output, sources_option(self), "--output_dir=runs/reward")


@dataclass(frozen=True)
class FitOptions(OfPairs, Seeded):
    """Fit a reward of state and action to answers about pairs (Bradley-Terry), as an ensemble of small networks.

    Each pair is held out from one network; fit.json has the agreement on held-out pairs. ANSWERS are files from ask or
    answer, by one person or several, about PAIRS or --more_pairs. OUTPUT_DIR/pretrained_model holds the reward.
    """

    example: ClassVar[str] = (
        "manip-il reward fit pairs.json preferences.json --sources=runs/dagger --output_dir=runs/reward"
    )
    answers: list[Path] = option(MISSING, "preferences.json from ask or answer", positional=True, exists="")
    more_pairs: list[Path] = option(list, "further pairs.json of the same task and clip length", exists="")
    members: int = option(8, "number of networks in the ensemble, and of folds of the pairs", at_least=3, at_most=64)
    output: Output = group(Output(Path("runs/reward")), prefix="")

    def run(self) -> None:
        """Fit, measure on held-out pairs, write the reward."""
        from manip_il.data.dataset import Dataset
        from manip_il.learn.reward import shape_for, write_reward
        from manip_il.learn.training_state import PRETRAINED_MODEL
        from manip_il.preferences.answers import Preferences, join_answers
        from manip_il.preferences.fitting import fit_answers, summary_lines
        from manip_il.preferences.frames import find_datasets
        from manip_il.preferences.pairs import Pairs, join_pairs, read_clips

        pairs = [Pairs.read(path) for path in (self.pairs, *self.more_pairs)]
        answers = join_answers([Preferences.read(path, pairs) for path in self.answers])
        clips = read_clips(join_pairs(pairs), find_datasets(self.sources))
        with progress(None, f"fit {len(answers.better):,} answers") as bar:
            shape = shape_for(clips.frames[0].spec, self.members)
            found = fit_answers(clips, answers, shape, stream_base("training", self.seed), bar.step)
        fingerprint = Dataset.open(clips.roots[0]).fingerprint
        options = {"seed": self.seed, "pairs": clips.pairs.sha256, "clip": clips.pairs.clip}
        with self.output.open(self) as folder:
            target = folder / PRETRAINED_MODEL
            target.mkdir(parents=True, exist_ok=True)
            write_reward(target, found.fit.network, found.shape, clips.frames[0].spec, options, fingerprint)
            write_json(folder / "fit.json", found.to_json())
        say(*summary_lines(found, answers))
        say_next("data", "score", "DATASET", f"--reward={folder}", "--output_dir=runs/scores")
