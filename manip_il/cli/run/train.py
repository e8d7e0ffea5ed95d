"""Run `manip-il train`: behaviour cloning on datasets, with our policies and LeRobot's.

Run `manip-il export`: a policy as one ONNX file.
"""

import contextlib
import os

from manip_il.cli.imitation import RANK, TrainOptions
from manip_il.cli.outputs import Stages, say, say_next, set_quiet
from manip_il.cli.transfer import ExportOptions
from manip_il.collect.inputs import named_env, open_dataset
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, requires
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.export import export_onnx
from manip_il.learn.train import train


def run_train(options: TrainOptions) -> None:
    """Read the datasets, fit, and print the checkpoint's path."""
    writes = os.environ.get(RANK, "0") == "0"  # only the first of several processes writes
    if not writes:
        set_quiet(True)
    folder = options.output_dir
    datasets = [*map(open_dataset, options.dataset.root)]
    kept = f"every finished checkpoint, in {folder}"
    output = options.lock() if writes else contextlib.nullcontext()
    with output as prepare, Stages(kept, prepare) as stages:
        policy = train(
            datasets,
            folder,
            seed=options.seed,
            shares=options.dataset.weights,
            weights=options.weights,
            resume=options.resume,
            progress=stages,
            trust=options.trust,
            **options.fit,
        )
    if not writes:
        return
    say(f"checkpoint: {policy.path}")
    [first, *_] = datasets
    if named_env(first):
        say_next("eval", f"--policy.path={policy.path}", f"--output_dir={folder}/eval")


EXPORTABLE = ("mlp", "cnn")


def run_export(options: ExportOptions) -> None:
    """Export, compare, write."""
    options.check()
    policy = Checkpoint.of(options.policy)
    path = policy.path
    if policy.kind not in EXPORTABLE:
        raise ManipError(
            f"{path} is a policy of type {policy.kind!r}; only {' and '.join(EXPORTABLE)} can be"
            " exported"
        )
    with requires("an ONNX file", "'manip_il[export]'"):
        content, difference = export_onnx(policy)
    write_file(options.output, content)
    say(f"largest difference from {path} over random observations: {difference:.1e}")
    say(f"exported: {options.output} ({len(content):,} bytes)")
