"""Run `manip-il reward pairs|ask|answer|fit`: rewards from preferences.

Run `manip-il reward irl`: learn a reward from demonstrations.

Run `manip-il data score`: score a dataset's episodes by a reward.

Run `manip-il theory`: the proven bounds of cloning and DAgger, on small MDPs and on the rounds of a
run.
"""

from itertools import chain
from pathlib import Path

from manip_il.chapter import inverse
from manip_il.chapter.inverse import learn
from manip_il.chapter.preferences import scores as scoring
from manip_il.chapter.preferences.asking import render_films, render_page
from manip_il.chapter.preferences.fitting import fit_answers, summary_lines
from manip_il.chapter.preferences.pairs import (
    Pairs,
    Preferences,
    Teacher,
    answer_pairs,
    choose_pairs,
    find_datasets,
    join_answers,
    read_clips,
    read_frames,
)
from manip_il.chapter.reward import LearnedReward, shape_for, write_reward
from manip_il.chapter.theory.bounds import PROCESSES, curves
from manip_il.chapter.theory.linear import drifts
from manip_il.chapter.theory.report import FILE_NAME, Theory, slope_table, theory_report
from manip_il.chapter.theory.shift import RoundData, Shift, find_rounds, measure_shift
from manip_il.cli.chapter import (
    AnswerOptions,
    AskOptions,
    FitOptions,
    IrlOptions,
    PairsOptions,
    TheoryOptions,
)
from manip_il.cli.data import ScoreOptions
from manip_il.cli.outputs import progress, publish, say
from manip_il.data.atomic import write_file, write_json
from manip_il.data.dataset import Dataset
from manip_il.evaluation.certify import certify, count_episodes
from manip_il.evaluation.side import read_member
from manip_il.learn.checkpoint import find_policy
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.seeding import rng_for, stream_base


def run_pairs(options: PairsOptions) -> None:
    """Read the sources, choose, and write the pairs."""
    options.check()
    rng = rng_for(stream_base("training", options.seed), "pairs")
    clips = choose_pairs(
        find_datasets(options.sources), options.clip, options.count, options.seed, rng
    )
    write_json(options.output, clips.pairs.to_json())
    say(f"{len(clips.pairs):,} pairs from {len(clips.pairs.sources)} datasets: {options.output}")


def run_ask(options: AskOptions) -> None:
    """Render the films and write the page."""
    options.check()
    clips = read_clips(Pairs.read(options.pairs), find_datasets(options.sources))
    with progress(len(clips.pairs), "render") as bar:
        films = render_films(clips, options.robot, bar.step)
    page = render_page(clips.pairs, clips.data.spec.instruction, films)
    write_file(options.output, page.encode())
    say(f"{len(clips.pairs):,} pairs: {options.output}")


def run_answer(options: AnswerOptions) -> None:
    """Compare every pair and write the answers."""
    options.check()
    teacher = Teacher.parse(options.teacher)
    clips = read_clips(Pairs.read(options.pairs), find_datasets(options.sources))
    rng = rng_for(stream_base("training", options.seed), "teacher")
    write_json(options.output, answer_pairs(teacher, clips, rng).to_json())
    say(f"{len(clips.pairs):,} answers: {options.output}")


def run_fit(options: FitOptions) -> None:
    """Fit, measure on held-out pairs, write the reward."""
    pairs = Pairs.read(options.pairs)
    answers = join_answers([Preferences.read(path, pairs) for path in options.answers])
    clips = read_clips(pairs, find_datasets(options.sources))
    with progress(None, f"fit {len(answers.better):,} answers") as bar:
        shape = shape_for(clips.data.spec, options.members)
        found = fit_answers(clips, answers, shape, stream_base("training", options.seed), bar.step)
    fingerprint = Dataset.open(clips.roots[0]).fingerprint
    stored = {"seed": options.seed, "pairs": clips.pairs.sha256, "clip": clips.pairs.clip}
    with options.open() as folder:
        target = folder / PRETRAINED_MODEL
        target.mkdir(parents=True, exist_ok=True)
        write_reward(target, found.network, clips.data.spec, stored, fingerprint)
        write_json(folder / "fit.json", found.to_json())
    say(*summary_lines(found, answers), f"reward: {folder}")


def run_irl(options: IrlOptions) -> None:
    """Read, learn, write the reward and the report, print the weights."""
    with progress(None, f"irl {options.dataset}") as bar:
        shown = inverse.read_carried(options.dataset, bar.step)
    rng = rng_for(stream_base("training", options.seed), "irl")
    learnt = learn(options.method, shown, rng)
    found = inverse.Inverse(str(options.dataset), tuple(shown), learnt)
    with options.open() as folder:
        page = inverse.inverse_report(found)
        publish(
            folder / inverse.FILE_NAME,
            found.to_json(),
            [inverse.weight_table(found)],
            *found.facts,
            page=page,
            options=options,
        )


PROGRESS = "progress"  # value of --reward: score by true progress


def run_score(options: ScoreOptions) -> None:
    """Score, print the worst episodes, write the files."""
    data = read_frames(options.dataset)
    if options.reward == PROGRESS:
        found = data.progress
    else:
        reward = LearnedReward.load(find_policy(Path(options.reward).expanduser()))
        reward.check_fits(str(options.dataset), data.spec)
        found = reward(data.inputs).astype("float64").clip(0.0, 1.0)
    scores = scoring.Scores(str(options.dataset), options.reward, data, found)
    with options.open() as folder:
        scoring.write_weights(folder / scoring.WEIGHTS_FILE, scores)
        worst = [scoring.worst_table(scores)]
        publish(folder / scoring.FILE_NAME, scores.to_json(), worst, *scoring.fact_lines(scores))


def run_theory(options: TheoryOptions) -> None:
    """Compute and measure; write the report and the JSON file; print the slopes."""
    rounds = find_rounds(options.source) if options.source else []
    with options.open() as folder:
        shift = _shift(options, options.source, rounds) if options.source else None
        theory = Theory(tuple(chain(*map(curves, PROCESSES))), tuple(drifts()), shift)
        page = theory_report(theory)
        fact = f"policies above their bound: {theory.above}"
        publish(
            folder / FILE_NAME,
            theory.to_json(),
            [slope_table(theory)],
            fact,
            page=page,
            options=options,
        )


def _shift(options: TheoryOptions, run: Path, rounds: list[RoundData]) -> Shift:
    validation = read_member(run).validation
    env = validation.env()
    count = count_episodes(env, options.cases) + options.episodes * (1 + len(rounds))
    with progress(count, f"theory {run}") as bar, options.open_engine() as engine:
        certificate = certify(engine, env, options.cases, on_episode=lambda _: bar.step())
        u, conditions = certificate.mu or 0, validation.settings.conditions
        return measure_shift(
            engine, env, rounds, u, options.episodes, lambda _: bar.step(), conditions
        )
