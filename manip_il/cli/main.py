"""`manip-il COMMAND --option=value ...`: finds the command, answers for help and for errors.

Nothing heavy is imported before a command's options are sound, so that help and a mistake are answered at once:
an options class may have `check`, which refuses what its paths and values alone show to be wrong, before `run`.
"""

from __future__ import annotations

import importlib
import inspect
import os
import select
import sys
import threading
import traceback
from collections.abc import Collection, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from manip_il import __version__
from manip_il.cli import progress
from manip_il.cli.interrupt import Interrupted, resume_command
from manip_il.cli.options import Option, metavar, options_of, word
from manip_il.cli.parsing import parse
from manip_il.errors import ManipError, UnknownName, UsageError, printable

PROGRAM = "manip-il"
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells have it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE
LONGEST_LINE = 2_000  # of an error [characters]


class Command(NamedTuple):
    """target: `module:OptionsClass`, loaded when the command is called."""

    target: str
    summary: str


COMMANDS = {
    "view": Command("manip_il.cli.view:ViewOptions", "watch a robot at its task, in a window or a browser"),
    "record": Command("manip_il.cli.record:RecordOptions", "record demonstrations of the expert as a dataset"),
    "train": Command("manip_il.cli.train:TrainOptions", "train a policy on a dataset (behaviour cloning)"),
    "dagger": Command("manip_il.cli.dagger:DaggerOptions", "train by DAgger: roll out, label, refit, repeat"),
    "eval": Command("manip_il.cli.evaluate:EvalOptions", "measure a policy's success on unseen seeds"),
    "replay": Command("manip_il.cli.eval_files:ReplayOptions", "run one episode of an evaluation again, and film it"),
    "merge": Command("manip_il.cli.eval_files:MergeOptions", "merge parts of an evaluation from several machines"),
    "compare": Command("manip_il.cli.compare:CompareOptions", "compare two policies or runs on the same seeds"),
    "study": Command("manip_il.cli.study:StudyOptions", "run, test and compare several methods and training seeds"),
    "certify": Command("manip_il.cli.certify:CertifyOptions", "measure from which states the expert recovers"),
    "theory": Command("manip_il.cli.theory:TheoryOptions", "see what is proved of cloning and DAgger, on an arm, too"),
    "irl": Command("manip_il.cli.irl:IrlOptions", "learn a reward from demonstrations of carry"),
    "gail": Command(
        "manip_il.cli.adversarial:GailOptions", "imitate by GAIL: reinforcement learning from demonstrations"
    ),
    "airl": Command("manip_il.cli.adversarial:AirlOptions", "imitate by AIRL, which learns a reward, too"),
    "ppo": Command("manip_il.cli.ppo:PpoOptions", "improve a cloned policy on a reward learnt from preferences"),
    "preferences pairs": Command("manip_il.cli.preferences:PairsOptions", "choose pairs of clips to compare"),
    "preferences ask": Command("manip_il.cli.preferences:AskOptions", "make a page that asks which clip is better"),
    "preferences answer": Command(
        "manip_il.cli.preferences:AnswerOptions", "answer pairs by a simulated teacher, who knows true progress"
    ),
    "preferences fit": Command("manip_il.cli.preferences:PreferencesFitOptions", "learn a reward from answers"),
    "health": Command("manip_il.cli.health:HealthOptions", "check that this machine can evaluate and render"),
    "push": Command(
        "manip_il.cli.push_pull:PushOptions", "upload a dataset or policy to the Hub, S3, SFTP or a folder"
    ),
    "pull": Command("manip_il.cli.push_pull:PullOptions", "download a dataset or policy, every file verified"),
    "export": Command("manip_il.cli.export:ExportOptions", "export a policy as ONNX or TorchScript"),
    "data check": Command("manip_il.cli.doctor:CheckOptions", "find what is wrong with a dataset, of any origin"),
    "data repair": Command("manip_il.cli.doctor:RepairOptions", "repair a dataset, from its journals or its own data"),
    "data render": Command(
        "manip_il.cli.record:RenderOptions", "render a dataset again, with other cameras, sizes or lights"
    ),
    "data redraw": Command("manip_il.cli.redraw:RedrawOptions", "draw visited states anew, for policies on pictures"),
    "data relabel": Command("manip_il.cli.relabel:RelabelOptions", "relabel a dataset with the current expert"),
    "data build": Command("manip_il.cli.record:BuildOptions", "rebuild a dataset from its journals"),
    "data merge": Command("manip_il.cli.data_merge:DataMergeOptions", "merge datasets of one robot and task"),
    "data score": Command(
        "manip_il.cli.score:ScoreOptions", "score a dataset's episodes by a reward, to find bad ones"
    ),
    "data to-mcap": Command(
        "manip_il.cli.mcap:McapExportOptions", "convert a dataset to MCAP files, for Foxglove etc."
    ),
    "data from-mcap": Command(
        "manip_il.cli.mcap:McapImportOptions", "convert MCAP files to a dataset, by a mapping file"
    ),
    "robot new": Command("manip_il.cli.robot:RobotNewOptions", "write a first YAML for an arm's MJCF"),
    "robot check": Command("manip_il.cli.robot:RobotCheckOptions", "measure what an arm can do, before recording"),
    "quickstart": Command(
        "manip_il.cli.quickstart:QuickstartOptions", "run a small example: record, clone, DAgger, report"
    ),
}

RENAMED = {
    "doctor": "data check, and manip-il data repair in place of --repair",
    **{name: f"data {name}" for name in ("render", "redraw", "relabel", "build", "score")},
    "mcap export": "data to-mcap",
    "mcap import": "data from-mcap",
    "mcap": "data to-mcap, and manip-il data from-mcap",
}

_HELP_WORDS = ("--help", "-h", "help")
_GLOBAL_HELP = """\
  --debug      show the traceback of an error
  --quiet      no progress on standard error"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns 0 done, 1 the work failed, 2 the command line was invalid, 130 interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug, quiet = "--debug" in words, "--quiet" in words
    words = [word for word in words if word not in ("--debug", "--quiet")]
    progress.set_quiet(quiet)
    try:
        _dispatch(words)
        sys.stdout.flush()  # here, where a reader that has gone away can still be answered
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, BrokenPipeError) and _stdout_is_gone():
            # Python flushes once more at exit, and would complain there.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return EXIT_BROKEN_PIPE
        if debug:
            print(_clean(traceback.format_exc(), words), file=sys.stderr, end="")
        return _report(error, words)
    return 0


def script() -> NoReturn:
    """Run `main` and exit; after Ctrl-C without waiting for threads that still send or receive.

    Nothing is lost by that: what every command writes outlives a kill.
    """
    _reopen_streams()
    code = main()
    busy = any(not thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread())
    if code == EXIT_INTERRUPTED and busy:
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _reopen_streams() -> None:
    """Make /dev/null of the streams that the shell closed (`>&-`): else the next file opened would take their place."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free, so this one
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def load(name: str) -> type:
    """Return the dataclass of options of a command; `UnknownName` (exit code 2) names the known ones."""
    if name not in COMMANDS:
        raise UnknownName("command", name, COMMANDS)
    module, _, options_class = COMMANDS[name].target.partition(":")
    return getattr(importlib.import_module(module), options_class)


def _dispatch(words: list[str]) -> None:
    if words and words[0] in _HELP_WORDS and (rest := [word for word in words if word not in _HELP_WORDS]):
        words = [*rest, "--help"]
    if not words or words[0] in _HELP_WORDS:
        print(_help())
    elif words[0] == "--version":
        print(f"{PROGRAM} {__version__}")
    elif words[0].startswith("-"):
        raise UsageError(f"{words[0]!r} is given before a command; write {PROGRAM} COMMAND {words[0]} (see --help)")
    elif len(words) == 1 and _group(words[0]):
        print(_group_help(words[0]))
    elif "--help" in words or "-h" in words:
        name, _ = _split(words)
        print(_command_help(name, load(name), words) if name in COMMANDS else _group_help(name))
    else:
        name, words = _split(words)
        options = parse(load(name), words, command=name)
        if hasattr(options, "check"):
            options.check()
        from manip_il.errors import silence_ffmpeg_warning
        from manip_il.sim.gl import require_known_backend

        require_known_backend()
        silence_ffmpeg_warning()
        options.run()


def _split(words: list[str]) -> tuple[str, list[str]]:
    """A command's name, of one word or two, and the words behind it; a group's name where only help is asked for."""
    for name in (" ".join(words[:2]), words[0]):
        if name in RENAMED:
            raise UsageError(f"{name!r} has a new name: {PROGRAM} {RENAMED[name]}")
    group = _group(words[0])
    if not group:
        return words[0], words[1:]
    name = " ".join(words[:2])
    if name in COMMANDS:
        return name, words[2:]
    if words[1] in ("--help", "-h"):
        return words[0], []
    raise UnknownName("command", name, group)


def _group(word: str) -> list[str]:
    """The commands of two words that begin with this one."""
    return [name for name in COMMANDS if name.startswith(f"{word} ")]


def _report(error: BaseException, words: list[str]) -> int:
    """Say on standard error what happened, in one line; return the exit code."""
    code = 1
    if isinstance(error, KeyboardInterrupt):
        text, code = f"interrupted{_how_to_go_on(error, words)}", EXIT_INTERRUPTED
    elif isinstance(error, ManipError):
        text, code = f"error: {error}", error.exit_code
    elif isinstance(error, OSError) and error.strerror and error.filename:
        text = f"error: {error.strerror}: {error.filename}"
    else:
        text = f"error: {type(error).__name__}: {error}; run again with --debug for the traceback"
    line = " ".join(_clean(text, words).split())
    if len(line) > LONGEST_LINE:  # without its middle: what to do next stands at the end
        line = f"{line[: LONGEST_LINE - 500]} ... {line[-400:]}"
    print(f"{PROGRAM}: {line}", file=sys.stderr, flush=True)
    return code


def _how_to_go_on(error: KeyboardInterrupt, words: list[str]) -> str:
    if isinstance(error, Interrupted):
        return f"; kept: {error.kept}; continue with: {error.resume_command or resume_command(words)}"
    try:
        name, rest = _split(words)
        options: Any = parse(load(name), rest)
    except (Exception, KeyboardInterrupt):  # stopped while it was loading, or stopped once more
        return ""
    if not hasattr(options, "resume") or not getattr(options, "output_dir", Path()).exists():  # nothing to resume
        return ""
    return f"; finished work is kept; continue with: {resume_command(words)}"


def _clean(text: str, words: list[str]) -> str:
    """Without tokens, keys and passwords, which a word that was given may hold, or an error of a library.

    Without control characters, too.
    """
    from manip_il.store.errors import redact

    return printable(redact(text, words))


def _help() -> str:
    return (
        f"usage: {PROGRAM} COMMAND [--option=value ...]\n\n"
        "Robot-arm imitation learning without teleoperation.\n\n"
        f"commands:\n{_commands(COMMANDS)}\n\n{_GLOBAL_HELP}\n  --version    show the version\n\n"
        f"{PROGRAM} COMMAND --help lists a command's options.\n"
        f"example: {PROGRAM} quickstart --output_dir=runs/quickstart"
    )


def _group_help(group: str) -> str:
    return f"usage: {PROGRAM} {group} COMMAND [--option=value ...]\n\ncommands:\n{_commands(_group(group))}"


def _commands(names: Collection[str]) -> str:
    width = max(map(len, names)) + 2
    return "\n".join(f"  {name:{width}}{COMMANDS[name].summary}" for name in names)


def _command_help(name: str, cls: Any, words: Sequence[str] = ()) -> str:
    """Help of one command. words: all that was given, as some have help for a choice, too (`more_help`)."""
    options = options_of(cls)
    positional = [option for option in options if option.positional]
    places = "".join(f" {one.label}" if one.default is MISSING else f" [{one.label}]" for one in positional)
    rows = [_row(option) for option in options]
    rows.append(("--config_path=FILE.yaml", "read options from YAML; those on the command line win"))
    width = max(len(left) for left, _ in rows) + 2
    lines = "\n".join(f"  {left:{width}}{right}".rstrip() for left, right in rows)
    example = getattr(cls, "example", "")
    more = cls.more_help(words) if hasattr(cls, "more_help") else ""
    return (
        f"usage: {PROGRAM} {name}{places} [--option=value ...]\n\n{inspect.getdoc(cls)}\n\n"
        f"options:\n{lines}{more}\n\n{_GLOBAL_HELP}" + (f"\n\nexample: {example}" if example else "")
    )


def _row(option: Option) -> tuple[str, str]:
    left = option.label if option.positional else f"{option.label}={metavar(option.type)}"
    if option.default is MISSING:
        default = "required"
    elif option.is_open or option.default is None or option.default == []:
        default = "none"
    else:
        default = word(option.default) or "empty"
    return left, f"{option.help} [{default}]".lstrip()


def _stdout_is_gone() -> bool:
    """Whether nobody reads our output any more: a broken pipe to a worker is a real error."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    except (OSError, ValueError):
        return False


if __name__ == "__main__":
    script()
