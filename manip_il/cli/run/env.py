"""Run `manip-il env check`."""

from manip_il.cli.outputs import progress, say
from manip_il.cli.robots import EnvCheckOptions
from manip_il.collect.inputs import env_config
from manip_il.errors import ManipError
from manip_il.evaluation.world_check import check_world


def run_check(options: EnvCheckOptions) -> None:
    """Print the checks. Raises `ManipError` if a part of the contract is not kept."""
    config = env_config({"robot": options.world, "task": options.task})
    failed = list[str]()
    with progress(options.episodes, f"check {options.world}") as bar:
        for check in check_world(config, options.episodes, bar.step):
            say(str(check))
            failed += [check.what] if check.advice else []
    if failed:
        raise ManipError(f"{options.world} does not keep the contract: {', '.join(failed)}")
