"""Run `manip-il reward irl`: learn a reward from demonstrations."""

from __future__ import annotations

from manip_il.chapter import inverse
from manip_il.chapter.inverse import learn
from manip_il.cli.outputs import publish
from manip_il.cli.progress import progress
from manip_il.cli.reward import IrlOptions
from manip_il.seeding import rng_for, stream_base


def run_irl(options: IrlOptions) -> None:
    """Read, learn, write the reward and the report, print the weights."""
    with progress(None, f"irl {options.dataset}") as bar:
        carried = inverse.read_carried(options.dataset, bar.step)
    rng = rng_for(stream_base("training", options.seed), "irl")
    learnt = learn(options.method, [one.demonstration for one in carried], rng)
    found = inverse.Inverse(str(options.dataset), tuple(carried), learnt)
    with options.open() as folder:
        page = inverse.inverse_report(found)
        publish(folder / inverse.FILE_NAME, found.to_json(), [inverse.weight_table(found)], page=page, options=options)
