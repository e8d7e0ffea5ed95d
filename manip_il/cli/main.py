"""`manip-il COMMAND --option=value ...`: dispatch of commands, help, and error messages.

Nothing heavy is imported before a command's options are read, so that help and errors appear at
once.
"""

import importlib
import inspect
import logging
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import MISSING
from typing import Any

from manip_il import __version__
from manip_il.bridges.store.errors import redact
from manip_il.cli import outputs
from manip_il.cli.parsing import Option, metavar, options_of, parse, word
from manip_il.errors import ManipError, UnknownName, printable, silence_ffmpeg_warning, told

PROGRAM = "manip-il"
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells


# name -> `module:OptionsClass` in `manip_il.cli`, and a summary. The function `run_` and the last
# word of the name is in the module of `manip_il.cli.run` with the same name or, so that it imports
# only what it needs, in the one that a third part names.
COMMANDS = {
    "demo": (
        "imitation:DemoOptions",
        "run a small complete example: record, clone, DAgger, report",
    ),
    "record": (
        "imitation:RecordOptions:record",
        "record demonstrations of the expert as a dataset",
    ),
    "train": ("imitation:TrainOptions:train", "train a policy on a dataset (behaviour cloning)"),
    "dagger": ("imitation:DaggerOptions", "train by DAgger: roll out, label, refit, repeat"),
    "eval": ("evaluate:EvalOptions", "measure a policy's success on unseen seeds"),
    "compare": (
        "evaluate:CompareOptions:imitation",
        "compare policies, runs or whole studies on the same seeds",
    ),
    "view": ("robots:ViewOptions:view", "watch a robot at its task, in a window or from a file"),
    "serve": ("robots:ServeOptions:serve", "run a virtual SO-101 for LeRobot's own programs"),
    "push": ("transfer:PushOptions", "upload a dataset or policy to the Hub, S3, SFTP or a folder"),
    "pull": ("transfer:PullOptions", "download a dataset or policy and verify every file"),
    "export": ("transfer:ExportOptions:train", "export a policy as ONNX"),
    "theory": (
        "chapter:TheoryOptions",
        "compare the proven bounds of cloning and DAgger with a run",
    ),
    "data check": ("data:CheckOptions", "find errors in any LeRobot dataset"),
    "data repair": ("data:RepairOptions", "compute wrong counts and statistics of a dataset again"),
    "data render": (
        "data:RenderOptions",
        "render a dataset again, with other cameras, sizes or lights",
    ),
    "data redraw": (
        "data:RedrawOptions",
        "randomise and render visited states for policies with cameras",
    ),
    "data relabel": ("data:RelabelOptions", "relabel a dataset with the current expert"),
    "data annotate": ("data:AnnotateOptions", "add texts that are true of every frame"),
    "data build": ("data:BuildOptions", "rebuild a dataset from its journals"),
    "data merge": ("data:MergeOptions", "merge datasets of one robot"),
    "data score": (
        "data:ScoreOptions:chapter",
        "score a dataset's episodes by a reward, to find bad ones",
    ),
    "data to-mcap": (
        "transfer:McapExportOptions:mcap",
        "convert a dataset to MCAP files, for Foxglove etc.",
    ),
    "data from-mcap": (
        "transfer:McapImportOptions:mcap",
        "convert MCAP files to a dataset with a mapping file",
    ),
    "robot new": ("robots:RobotNewOptions", "write a first YAML file for an arm's MJCF"),
    "robot check": ("robots:RobotCheckOptions", "measure what an arm can do, before recording"),
    "robot certify": ("robots:CertifyOptions", "measure from which states the expert recovers"),
    "robot identify": ("robots:IdentifyOptions", "find a real arm's servos from a dataset"),
    "robot preflight": (
        "robots:PreflightOptions",
        "check a policy against a recording of the real arm, before it moves",
    ),
    "robot excite": ("robots:ExciteOptions", "write a motion that tells a real arm's servos"),
    "robot board": ("robots:BoardOptions", "write a board to print, for `robot align`"),
    "robot align": ("robots:AlignOptions", "find a real arm's cameras and zeros from a dataset"),
    "env check": (
        "robots:EnvCheckOptions:env",
        "does a world of your own keep the contract, and how good is its expert",
    ),
    "rl gail": (
        "chapter:GailOptions:learning",
        "imitate by GAIL: reinforcement learning from demonstrations",
    ),
    "rl airl": ("chapter:AirlOptions:learning", "imitate by AIRL, which also learns a reward"),
    "rl ppo": (
        "chapter:PpoOptions:learning",
        "improve a cloned policy with a reward learnt from preferences",
    ),
    "reward irl": ("chapter:IrlOptions", "learn a reward from demonstrations of the task carry"),
    "reward pairs": ("chapter:PairsOptions", "choose pairs of clips to compare"),
    "reward ask": ("chapter:AskOptions", "make a page that asks which clip is better"),
    "reward answer": (
        "chapter:AnswerOptions",
        "let a simulated teacher answer pairs by true progress",
    ),
    "reward fit": ("chapter:FitOptions", "learn a reward from answers"),
}
GROUPS = {
    "data": "check, repair, edit, score and convert datasets",
    "robot": "add an arm of your own; measure what an arm can do",
    "env": "check an environment and an expert of your own",
    "rl": "reinforcement learning: GAIL, AIRL, PPO",
    "reward": "learn rewards from demonstrations or preferences",
}
HELP = ("--help", "-h")
_GLOBAL_HELP = """\
  --debug      show the traceback of an error
  --quiet      show no progress on standard error"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Return 0 (done), 1 (the work failed), 2 (invalid command line) or 130 (interrupted).
    """
    given = list(sys.argv[1:] if argv is None else argv)
    # the words after `--` are another program's
    end = given.index("--") if "--" in given else len(given)
    own = [word for word in given[:end] if word not in ("--debug", "--quiet")]
    outputs.set_quiet("--quiet" in given[:end])
    logging.getLogger("manip_il").handlers = [outputs.Warnings()]
    try:
        _dispatch(own, given[end:])
    except (Exception, KeyboardInterrupt) as error:
        if "--debug" in given[:end]:
            print(_clean(traceback.format_exc(), given), file=sys.stderr, end="")
        return _report(error, given)
    return 0


def load(name: str) -> type:
    """Return the dataclass of a command's options; `UnknownName` lists the known commands."""
    if name not in COMMANDS:
        raise UnknownName("command", name, COMMANDS)
    module, options_class, *_ = COMMANDS[name][0].split(":")
    return getattr(importlib.import_module(f"manip_il.cli.{module}"), options_class)


def run(name: str, options: Any) -> None:
    """Run a command with its options."""
    module, _, *other = COMMANDS[name][0].split(":")
    work = importlib.import_module(f"manip_il.cli.run.{[*other, module][0]}")
    getattr(work, f"run_{name.split()[-1].replace('-', '_')}")(options)


def _dispatch(own: list[str], others: list[str]) -> None:
    count = 2 if own and own[0] in GROUPS else 1
    name, words = " ".join(own[:count]), own[count:]
    if name in ("", "help", *HELP):
        print(_help())
    elif name == "--version":
        print(f"{PROGRAM} {__version__}")
    elif own[0] in GROUPS and (not own[1:] or own[1] in HELP):
        print(_help(own[0]))
    elif {*HELP} & {*words}:
        print(_command_help(name, load(name), words))
    else:
        options = parse(load(name), [*words, *others])
        silence_ffmpeg_warning()
        run(name, options)


def _report(error: BaseException, words: list[str]) -> int:
    """Print an error as one line on standard error; return the exit code."""
    code = 1
    # the reader of standard output, such as `head`, has ended
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return code
    if isinstance(error, KeyboardInterrupt):
        text, code = f"interrupted{f'; {error}' if error.args else ''}", EXIT_INTERRUPTED
    elif isinstance(error, ManipError):
        text, code = f"error: {error}", error.exit_code
    elif isinstance(error, OSError) and error.strerror and error.filename:
        text = f"error: {error.strerror}: {error.filename}"
    else:
        text = f"error: {told(error)}; run again with --debug for the traceback"
    print(f"{PROGRAM}: {' '.join(_clean(text, words).split())}", file=sys.stderr, flush=True)
    return code


def _clean(text: str, words: list[str]) -> str:
    """Remove control characters, and tokens, keys and passwords from the command line or a
    library's errors.
    """
    return printable(redact(text, words))


def _help(group: str = "") -> str:
    """Return the help of a group of commands, or of all."""
    if group:
        rows = {
            name: summary for name, (_, summary) in COMMANDS.items() if name.startswith(f"{group} ")
        }
        return f"usage: {PROGRAM} {group} COMMAND [--option=value ...]\n\ncommands:\n{_table(rows)}"
    single = {name: summary for name, (_, summary) in COMMANDS.items() if " " not in name}
    groups = {f"{name} ...": summary for name, summary in GROUPS.items()}
    return (
        f"usage: {PROGRAM} COMMAND [--option=value ...]\n\nRobot-arm imitation learning without"
        f" teleoperation.\n\ncommands:\n{_table(single | groups)}\n\n{_GLOBAL_HELP}\n  --version   "
        f" show the version\n\n{PROGRAM} COMMAND --help lists a command's options.\nexample:"
        f" {PROGRAM} demo --output_dir=runs/demo"
    )


def _command_help(name: str, cls: Any, words: Sequence[str]) -> str:
    """Return the help of one command.

    words: the command line; with `--policy.type=act` the options of that policy are listed, too.
    """
    options = options_of(cls)
    positional = [option for option in options if option.positional]
    places = "".join(
        f" {one.label}" if one.default is MISSING else f" [{one.label}]" for one in positional
    )
    rows = dict(map(_row, options))
    rows["--config_path=FILE.yaml"] = "read options from YAML; the command line overrides them"
    kind = next((word.partition("=")[2] for word in words if word.startswith("--policy.type=")), "")
    more = ""
    if kind and any(one.is_open for one in options):
        from manip_il.learn.lerobot_config import option_lines

        lines = _table({left: f"[{right}]" for left, right in option_lines(kind)})
        more = f"\n\noptions of {kind}:\n{lines}"
    text, _, example = str(inspect.getdoc(cls)).partition("Example: ")
    return (
        f"usage: {PROGRAM} {name}{places} [--option=value ...]\n\n{text.strip()}\n\n"
        f"options:\n{_table(rows)}{more}\n\n{_GLOBAL_HELP}\n\nexample: {' '.join(example.split())}"
    )


def _table(rows: Mapping[str, str]) -> str:
    """Return lines of help: a name and its meaning."""
    width = max(map(len, rows)) + 2
    return "\n".join(f"  {left:{width}}{right}".rstrip() for left, right in rows.items())


def _row(option: Option) -> tuple[str, str]:
    left = option.label if option.positional else f"{option.label}={metavar(option.type)}"
    if option.default is MISSING:
        default = "required"
    elif option.is_open or option.default is None or option.default == []:
        default = "none"
    else:
        default = word(option.default) or "empty"
    return left, f"{option.metadata.get('help', '')} [{default}]".lstrip()


if __name__ == "__main__":
    sys.exit(main())
