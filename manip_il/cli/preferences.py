"""`manip-il preferences pairs|ask|answer|fit`: from pairs of clips to a reward."""

from __future__ import annotations

import time
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.cli.inputs import require_folder
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import atomic_write, open_output, require_new, require_short_path
from manip_il.cli.progress import progress, say, warn
from manip_il.errors import UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.learn.reward import LearnedReward

_PAIRS = "pairs.json of manip-il preferences pairs"


@dataclass
class PairsOptions:
    """Choose pairs of clips of one task's datasets, to be compared by people (ask) or simulated teachers (answer).

    A SOURCE is a dataset or a run: each round's dataset of a DAgger run is a source. Every source is in as many pairs
    as any other. Clips are whole: episodes that are shorter than --clip are left out.
    """

    example: ClassVar[str] = "manip-il preferences pairs runs/dagger --count=200 --output=pairs.json"
    sources: list[Path] = option(MISSING, "LeRobot datasets with our columns, or runs", positional=True)
    clip: int = option(20, "length of a clip [control steps]")
    count: int = option(200, "number of pairs")
    reward: Path | None = option(None, "choose those about which the networks of this reward disagree most")
    seed: int = option(0, "seed of the choice, 0 to 1000")
    output: Path = option(Path("pairs.json"), "the file")
    overwrite: bool = option(False, "replace an existing file")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        from manip_il.seeding import stream_base

        for name in ("clip", "count"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; expected at least 1")
        stream_base("training", self.seed)
        _require_new_file(self.output, ".json", self.overwrite)

    def run(self) -> None:
        """Read the sources, choose, and write the pairs."""
        from manip_il.evaluation.results import write_json
        from manip_il.preferences.choose import choose_pairs, open_supply
        from manip_il.preferences.frames import find_datasets
        from manip_il.seeding import rng_for, stream_base

        reward = load_reward(self.reward) if self.reward else None
        supply = open_supply(find_datasets(self.sources), self.clip)
        if reward is not None:
            reward.check_fits(str(supply.roots[0]), supply.frames[0].spec)
        rng = rng_for(stream_base("training", self.seed), "pairs")
        members = reward.members if reward is not None else None
        pairs = choose_pairs(supply, self.count, self.seed, rng, members)
        write_json(self.output, pairs.to_json())
        if supply.too_short:
            warn(f"{supply.too_short:,} episodes are shorter than {self.clip} control steps: no clip is from them")
        say(f"{len(pairs):,} pairs from {len(pairs.sources)} datasets: {self.output}")
        say(f"next: manip-il preferences ask {self.output} --output=ask.html")


@dataclass
class AskOptions:
    """Write one page that shows the pairs as films and asks which is better: offline, on a phone too.

    Keys: left and right arrow, down for equal, S to skip, U to undo. The answers stay in the browser until they are
    saved as preferences.json.
    """

    example: ClassVar[str] = "manip-il preferences ask pairs.json --output=ask.html"
    pairs: Path = option(MISSING, _PAIRS, positional=True)
    output: Path = option(Path("ask.html"), "the page")
    robot: Path | None = option(None, "the YAML of the sources' robot, where that does not ship")
    overwrite: bool = option(False, "replace an existing file")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        _require_file(self.pairs, _PAIRS)
        _require_new_file(self.output, ".html", self.overwrite)

    def run(self) -> None:
        """Render the films and write the page."""
        from manip_il.preferences.asking import render_films, render_page
        from manip_il.preferences.pairs import Pairs, read_clips

        clips = read_clips(Pairs.read(self.pairs))
        with progress(len(clips.pairs), "render") as bar:
            films = render_films(clips, str(self.robot) if self.robot else None, bar.advance)
        page = render_page(clips.pairs, clips.frames[0].spec.instruction, films)
        atomic_write(self.output, page)
        say(f"{len(clips.pairs):,} pairs, {len(page) / 1e6:.1f} MB: {self.output}")
        say("open it in a browser, compare, and save the answers as preferences.json")
        say(f"next: manip-il preferences fit {self.pairs} preferences.json --output_dir=runs/reward")


@dataclass
class AnswerOptions:
    """Answer pairs by a simulated teacher, who compares the clips' true progress (B-Pref, Lee et al. 2021).

    perfect; boltzmann:TEMPERATURE, who is less sure where returns are near; mistaken:EPSILON, the wrong way round in a
    share of the pairs; myopic:GAMMA, for whom a clip's end counts most; skipping:DELTA, who skips pairs in which
    neither clip has DELTA of the mean return. A clip's return is the sum of progress over its steps.
    """

    example: ClassVar[str] = "manip-il preferences answer pairs.json --teacher=mistaken:0.1 --output=preferences.json"
    pairs: Path = option(MISSING, _PAIRS, positional=True)
    teacher: str = option("perfect", "perfect, boltzmann[:1], mistaken[:0.1], myopic[:0.9] or skipping[:0.1]")
    seed: int = option(0, "seed of the teacher's chances, 0 to 1000")
    output: Path = option(Path("preferences.json"), "the file")
    overwrite: bool = option(False, "replace an existing file")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        from manip_il.preferences.teachers import Teacher
        from manip_il.seeding import stream_base

        _require_file(self.pairs, _PAIRS)
        Teacher.parse(self.teacher)
        stream_base("training", self.seed)
        _require_new_file(self.output, ".json", self.overwrite)

    def run(self) -> None:
        """Compare every pair and write the answers."""
        from manip_il.evaluation.results import write_json
        from manip_il.preferences.pairs import Pairs, read_clips
        from manip_il.preferences.teachers import Teacher, answer_pairs
        from manip_il.seeding import rng_for, stream_base

        clips = read_clips(Pairs.read(self.pairs))
        rng = rng_for(stream_base("training", self.seed), "teacher")
        found = answer_pairs(Teacher.parse(self.teacher), clips, rng)
        write_json(self.output, found.to_json())
        given = [one.answer for one in found.answers]
        counts = ", ".join(f"{given.count(answer):,} {answer}" for answer in dict.fromkeys(sorted(given)))
        say(f"{counts}: {self.output}")
        say(f"next: manip-il preferences fit {self.pairs} {self.output} --output_dir=runs/reward")


@dataclass
class PreferencesFitOptions:
    """Learn a reward of state and action from answers about pairs (Bradley-Terry): an ensemble of small networks.

    Every pair is held out by one network; agreement and calibration on those are in report.html. ANSWERS are files of
    ask or answer, of one person or several, about these pairs or those of --more_pairs. OUTPUT_DIR/pretrained_model
    holds the reward.
    """

    example: ClassVar[str] = "manip-il preferences fit pairs.json preferences.json --output_dir=runs/reward"
    pairs: Path = option(MISSING, _PAIRS, positional=True)
    answers: list[Path] = option(MISSING, "preferences.json of ask or answer", positional=True)
    more_pairs: list[Path] = option(list, "further files of pairs of the same task and length of clip")
    members: int = option(8, "networks of the ensemble, and folds of the pairs; at least 3")
    seed: int = option(0, "seed of weights, folds and batches, 0 to 1000")
    output_dir: Path = option(Path("runs/reward"), "folder of pretrained_model and report.html")
    overwrite: bool = option(False, "replace an existing one")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        from manip_il.seeding import stream_base

        if not 3 <= self.members <= 64:
            raise UsageError(f"--members is {self.members}; expected 3 to 64")
        for path in (self.pairs, *self.more_pairs):
            _require_file(path, _PAIRS)
        for path in self.answers:
            _require_file(path, "preferences.json of manip-il preferences ask")
        stream_base("training", self.seed)
        require_new(self.output_dir, overwrite=self.overwrite)

    def run(self) -> None:
        """Fit, measure on held-out pairs, write the reward and the page."""
        from manip_il.learn.reward import shape_for
        from manip_il.preferences.answers import Preferences, join_answers
        from manip_il.preferences.fitting import fit_answers, fit_report, summary_lines
        from manip_il.preferences.pairs import Pairs, join_pairs, read_clips
        from manip_il.seeding import stream_base

        pairs = [Pairs.read(path) for path in (self.pairs, *self.more_pairs)]
        given = [Preferences.read(path, pairs) for path in self.answers]
        begin, answers, clips = time.monotonic(), join_answers(given), read_clips(join_pairs(pairs))
        with progress(None, f"fit {len(answers.better):,} answers") as bar:
            shape = shape_for(clips.frames[0].spec, self.members)
            found = fit_answers(clips, answers, shape, stream_base("training", self.seed), bar.advance)
        timings = {"fit": time.monotonic() - begin}
        who = [one.who or "somebody" for one in given]
        with open_output(self) as folder:
            self._write(folder, found, clips)
            page = folder / "report.html"
            command = command_line("preferences fit", self)
            fit_report(found, clips, answers, who, command, to_plain(self), timings).write(page)
        for line in summary_lines(found, answers):
            say(line)
        if answers.contradictory:
            warn(f"{answers.contradictory:,} pairs are answered left and right: both answers count")
        say(f"report: {page}")
        say(f"next: manip-il data score DATASET --reward={folder} --output_dir=runs/scores")

    def _write(self, folder: Path, found: Any, clips: Any) -> None:
        from manip_il.data.dataset import Dataset
        from manip_il.evaluation.results import write_json
        from manip_il.learn.reward import write_reward
        from manip_il.learn.training_state import PRETRAINED_MODEL

        target = folder / PRETRAINED_MODEL
        target.mkdir(parents=True, exist_ok=True)
        fingerprint = Dataset.open(Path(clips.pairs.sources[0].root)).fingerprint
        options = {"seed": self.seed, "pairs": clips.pairs.sha256, "clip": clips.pairs.length}
        write_reward(target, found.fit.network, found.shape, clips.frames[0].spec, options, fingerprint)
        write_json(folder / "fit.json", found.to_json())


def load_reward(path: Path) -> LearnedReward:
    """Return the reward in a folder of `fit`, or in its `pretrained_model`. Raises what `LearnedReward.load` raises."""
    from manip_il.learn.reward import LearnedReward

    require_folder(path, "a reward of manip-il preferences fit")
    return LearnedReward.load(reward_folder(path))


def reward_folder(path: Path) -> Path:
    """Return the `pretrained_model` folder that a path means."""
    inner = path / "pretrained_model"
    return inner if (inner / "config.json").is_file() else path


def _require_file(path: Path, what: str) -> None:
    if not path.is_file():
        raise UsageError(f"{path} {'is no file' if path.exists() else 'does not exist'}; expected {what}")


def _require_new_file(path: Path, suffix: str, overwrite: bool) -> None:
    require_short_path(path)
    if path.suffix != suffix:
        raise UsageError(f"--output is {path}; expected a file, NAME{suffix}")
    if path.is_dir() or (path.exists() and not overwrite):
        raise UsageError(f"{path} exists already; choose another --output, or give --overwrite=true")
