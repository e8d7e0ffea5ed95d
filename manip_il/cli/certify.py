"""`manip-il certify`: from which states the expert recovers, and what a wrong action costs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_policy, find_policy
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, open_output, require_new
from manip_il.cli.progress import progress, say
from manip_il.errors import UsageError
from manip_il.option import option


@dataclass
class VisitorGroup:
    """`--policy.*` of the policy whose visited states the expert takes over in."""

    path: Path | None = option(None, "a checkpoint or a run: also let the expert take over from it")


@dataclass
class CertifyOptions:
    """Measure how the expert recovers from perturbed states and wrong actions; writes certificate.json and a report."""

    example: ClassVar[str] = "manip-il certify --policy.path=runs/dagger --output_dir=runs/certificate"
    robot: common.MaybeRobotGroup = field(default_factory=common.MaybeRobotGroup)
    task: common.MaybeTaskGroup = field(default_factory=common.MaybeTaskGroup)
    policy: VisitorGroup = field(default_factory=VisitorGroup)
    env: common.EnvGroup = field(default_factory=common.EnvGroup)
    cases: int = option(500, "episodes of each kind")
    seed: int = common.seed_option()
    engine: Literal["local", "ray"] = common.engine_option()
    workers: int | None = common.workers_option()
    trust: bool = common.trust_option()
    output_dir: Path = option(Path("runs/certificate"), "folder of certificate.json")
    overwrite: bool = option(False, "replace an existing certificate")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if self.cases < 1:
            raise UsageError(f"--cases is {self.cases}; expected at least 1")
        common.require_workers(self.workers)
        if self.policy.path is not None:
            find_policy(self.policy.path)
        require_new(self.output_dir, overwrite=self.overwrite)
        self.env.config(self.robot.type, self.task.type, shape=self.task.object, reward=self.task.reward)

    def run(self) -> None:
        """Run the episodes, write `certificate.json`, print the tables."""
        policy = checkpoint = None
        if self.policy.path is not None:
            from manip_il.learn.checkpoint import Checkpoint

            policy = find_policy(self.policy.path)
            checkpoint = Checkpoint.open(policy)
        meta = checkpoint.origin if checkpoint else None
        env = self.env.config(self.robot.type, self.task.type, meta, self.task.object, self.task.reward)
        if checkpoint is not None:
            check_policy(checkpoint, env, draw=self.engine == "local", trust=self.trust)
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.certificate import FILE_NAME, certificate_report
        from manip_il.evaluation.certify import certify, count_episodes
        from manip_il.evaluation.tables import print_table
        from manip_il.seeding import stream_seeds

        stream_seeds("certificate", self.cases, self.seed)  # refuses numbers out of range before a folder is made
        engine, count = Engine(self.workers, self.engine), count_episodes(env, self.cases, policy)
        with open_output(self) as folder:
            with progress(count, f"certify {env.robot} {env.task}") as bar, engine:
                advance = bar.advance
                certificate = certify(engine, env, self.cases, self.seed, policy, lambda _: advance(), trust=self.trust)
            certificate.write(folder / FILE_NAME)
            report = certificate_report(certificate, command_line("certify", self), to_plain(self))
            report.write(folder / REPORT_FILE)
        for table in certificate.tables():
            print_table(table, empty="-")
        for line in certificate.facts():
            say(line)
        say(f"result: {folder / FILE_NAME}")
        say(f"report: {folder / REPORT_FILE}")
