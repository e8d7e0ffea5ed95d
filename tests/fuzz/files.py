"""Targets of options, studies, suites, evaluations, runs and manifests."""

from __future__ import annotations

import shutil
from dataclasses import MISSING
from pathlib import Path

from manip_il.cli import quickstart
from manip_il.cli.candidates import limit_of, read_candidate, run_history
from manip_il.cli.eval_files import EpisodeJournal, ReplayOptions
from manip_il.cli.main import COMMANDS, load
from manip_il.cli.options import options_of
from manip_il.cli.outputs import check_same_options
from manip_il.cli.parsing import dump_yaml, parse
from manip_il.cli.study_file import check_same_file, keep_file, read_plan
from manip_il.cli.trials import suite_conditions
from manip_il.collect.job import RolloutJob
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.rounds import Rule
from manip_il.store.cards import command as command_of_card

from ..cli.made_runs import ENV, OPTIONS, make_eval
from ..cli.made_runs import make_run as make_dagger_run
from .remotes import make_small_policy
from .target import Read, Target, command, runs
from .trees import mutate_json, mutate_json_lines, mutate_yaml

CONFIGS = Path(__file__).parents[2] / "configs"


def _make_config(name: str):
    """`options.yaml`: every option of a command, as its runs keep them."""

    def make(folder: Path) -> None:
        needed = [option for option in options_of(load(name)) if option.default is MISSING]
        words = ["0" if option.positional else f"--{option.name}=0" for option in needed]
        (folder / "options.yaml").write_text(dump_yaml(parse(load(name), words)))

    return make


def _read_config(name: str) -> Read:
    """The options, and what a command makes of them before it works."""

    def read(folder: Path) -> None:
        options = parse(load(name), [f"--config_path={folder / 'options.yaml'}"])
        if hasattr(options, "config"):
            options.config()  # pyright: ignore[reportAttributeAccessIssue]

    return read


def _copy_of(source: str, name: str):
    def make(folder: Path) -> None:
        shutil.copy(CONFIGS / source, folder / name)

    return make


def _read_plan(folder: Path) -> None:
    read_plan(folder / "study.yaml", None)


def make_study(folder: Path) -> None:
    """`study.yaml` as a study keeps it."""
    keep_file(folder, read_plan(CONFIGS / "studies" / "chunk_labels.yaml", None).file)


def _same_study(folder: Path) -> None:
    check_same_file(folder, read_plan(CONFIGS / "studies" / "chunk_labels.yaml", None).file)


def _read_suite(folder: Path) -> None:
    conditions = suite_conditions(str(folder / "suite.yaml"), "pick_place", sees=True)
    EvalSettings.from_json(EvalSettings(8, 0.02, conditions=conditions).to_json())


def make_evals(folder: Path) -> None:
    """`left/eval.json` and `right/eval.json` on the same seeds, `more/eval.json` on others."""
    make_eval(folder / "left" / "eval.json", [True, False, True])
    make_eval(folder / "right" / "eval.json", [True, True, False])
    make_eval(folder / "more" / "eval.json", [True, True, False], seed=4_001_000)
    for path in folder.glob("*/eval.json"):
        text = path.read_text().replace('"policy": "left"', '"policy": "expert"')
        path.write_text(text.replace('"policy": "more"', '"policy": "expert"'))


def _replay(folder: Path) -> None:
    """What `replay` makes of an evaluation before it runs anything."""
    result = EvalResult.read(folder / "left")
    ReplayOptions(folder / "left" / "eval.json", 0)._job(result)
    result.to_json()


def make_kept(folder: Path) -> None:
    """`episodes.jsonl` of an evaluation that was stopped."""
    kept = _kept(folder)
    for seed in range(5):
        kept.add(EpisodeResult(seed, True, False, 8, 1.5, "lifted", {"condition": "nominal", "steps_to_success": 3}))


def _kept(folder: Path):
    return EpisodeJournal.open(folder, RolloutJob(ENV, label="last"), "nominal")


def _read_kept(folder: Path) -> None:
    _kept(folder).results(range(5))


def make_run(folder: Path) -> None:
    """`run`: a DAgger run of three rounds."""
    policy = folder / "policy"
    policy.mkdir()
    (policy / "config.json").write_text('{"type": "act"}')
    (policy / "manip_il.json").write_text("{}")
    make_dagger_run(folder / "run", policy)


def _side(folder: Path) -> None:
    for at in ("end", "labels", "seconds"):
        rule = Rule.parse("best", at)
        for source in (side := read_candidate(folder / "run")).sources:
            source.select(rule, limit_of(rule, side.sources))


def _resume_dagger(folder: Path) -> None:
    """What `dagger --resume=true` reads before it goes on."""
    check_same_options(folder / "run", OPTIONS, ("output_dir", "resume", "rounds"))
    run_history(folder / "run")


def _command_of_card(folder: Path) -> None:
    command_of_card(folder / "run" / "config.yaml")


def make_timings(folder: Path) -> None:
    """What a quickstart that was stopped had taken."""
    (folder / "timings.json").write_text('{"demonstrations and DAgger": 61.5, "evaluations": 8.25}')


def _read_timings(folder: Path) -> None:
    quickstart.read_timings(folder / "timings.json")


def make_store(folder: Path) -> None:
    """`store`: a policy's folder, pushed."""
    make_small_policy(folder / "policy")
    command("push", str(folder / "policy"), f"file://{folder}/store")


_MERGE = runs("merge", "{folder}/left", "{folder}/more", "--output_dir={folder}/merged")
_COMPARE = runs("compare", "{folder}/left", "{folder}/right", "--output_dir={folder}/compared")
_PULL = runs("pull", "file://{folder}/store", "{folder}/pulled")
_PUSH = runs("push", "{folder}/policy", "file://{folder}/store")
TARGETS = (
    *(
        Target(f"options of {name}", _make_config(name), "options.yaml", mutate_yaml, (_read_config(name),), share=0.3)
        for name in COMMANDS
    ),
    Target("study", _copy_of("studies/chunk_labels.yaml", "study.yaml"), "study.yaml", mutate_yaml, (_read_plan,)),
    Target("kept study", make_study, "study.yaml", mutate_yaml, (_same_study,), share=0.5),
    *(
        Target(
            f"suite {name}", _copy_of(f"suites/{name}.yaml", "suite.yaml"), "suite.yaml", mutate_yaml, (_read_suite,)
        )
        for name in ("knocked", "sensing", "object", "view", "dynamics")
    ),
    Target("eval.json", make_evals, "left/eval.json", mutate_json, (_MERGE, _COMPARE, _replay), share=1.5),
    Target("episodes.jsonl", make_kept, "episodes.jsonl", mutate_json_lines, (_read_kept,)),
    Target("metrics.jsonl", make_run, "run/metrics.jsonl", mutate_json_lines, (_side, _resume_dagger)),
    Target("config.yaml", make_run, "run/config.yaml", mutate_yaml, (_side, _resume_dagger, _command_of_card)),
    Target("timings", make_timings, "timings.json", mutate_json, (_read_timings,), share=0.3),
    Target("manifest", make_store, "store/manip_il_manifest.json", mutate_json, (_PULL, _PUSH)),
)
