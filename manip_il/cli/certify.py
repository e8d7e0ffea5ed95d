"""`manip-il certify`: from where the expert recovers, and what a wrong action costs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.folders import prepare_output
from manip_il.cli.groups import (
    DEFAULT_HZ,
    DEFAULT_ROBOT,
    DEFAULT_TASK,
    ENGINE_HELP,
    WORKERS_HELP,
    EnvGroup,
    MaybeRobotGroup,
    MaybeTaskGroup,
    find_policy,
    option,
    save_options,
    trust_option,
)
from manip_il.cli.paths import require_new, require_workers
from manip_il.cli.policy_check import check_policy
from manip_il.cli.progress import progress, say
from manip_il.errors import FolderExistsError, UsageError

if TYPE_CHECKING:
    from manip_il.engine.engine import Engine
    from manip_il.evaluation.certificate import Certificate
    from manip_il.sim.env import EnvConfig


@dataclass
class VisitorGroup:
    """`--policy.*` of who visits the states that the expert goes on from."""

    path: Path | None = field(
        default=None, metadata={"help": "a checkpoint or a run: also let the expert take over from it"}
    )


@dataclass
class CertifyOptions:
    """Measure how the expert recovers from perturbed states and wrong actions; writes certificate.json."""

    example: ClassVar[str] = "manip-il certify --policy.path=runs/dagger --output_dir=runs/certificate"
    robot: MaybeRobotGroup = field(default_factory=MaybeRobotGroup)
    task: MaybeTaskGroup = field(default_factory=MaybeTaskGroup)
    policy: VisitorGroup = field(default_factory=VisitorGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    cases: int = option(500, "episodes of each kind")
    seed: int = option(0, "shifts every random stream, 0 to 1000")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    trust: bool = trust_option()
    output_dir: Path = field(default=Path("runs/certificate"), metadata={"help": "folder of certificate.json"})
    overwrite: bool = option(False, "replace an existing certificate")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if self.cases < 1:
            raise UsageError(f"--cases is {self.cases}; expected at least 1")
        require_workers(self.workers)
        if self.policy.path is not None:
            find_policy(self.policy.path)
        require_new(self.output_dir, overwrite=self.overwrite)
        self.env.config(self.robot.type or DEFAULT_ROBOT, self.task.type or DEFAULT_TASK)

    def run(self) -> None:
        """Run the episodes, write `certificate.json`, print the tables."""
        env, policy = self._who()
        from manip_il.data.atomic import exclusive
        from manip_il.engine.engine import Engine
        from manip_il.evaluation.certificate import FILE_NAME, summary_lines
        from manip_il.seeding import stream_seeds

        stream_seeds("certificate", self.cases, self.seed)  # numbers out of range are said before a folder is made
        engine = Engine(self.workers, self.engine)
        with exclusive(self.output_dir):
            try:
                prepare_output(self.output_dir, resume=False, overwrite=self.overwrite)
            except FolderExistsError:
                raise UsageError(f"{self.output_dir} exists already; replace it with --overwrite=true") from None
            save_options(self.output_dir, self)
            certificate = self._certify(engine, env, policy)
            certificate.write(self.output_dir / FILE_NAME)
        for line in summary_lines(certificate):
            say(line)
        say(f"result: {self.output_dir / FILE_NAME}")

    def _who(self) -> tuple[EnvConfig, Path | None]:
        if self.policy.path is None:
            return self.env.config(self.robot.type or DEFAULT_ROBOT, self.task.type or DEFAULT_TASK), None
        from manip_il.learn.checkpoint import read_meta

        path = find_policy(self.policy.path)
        meta = read_meta(path)
        robot = self.robot.type or (meta.robot if meta else DEFAULT_ROBOT)
        task = self.task.type or (meta.task if meta else DEFAULT_TASK)
        env = self.env.config(robot, task, meta.fps if meta else DEFAULT_HZ)
        check_policy(path, meta, env, draw=self.engine == "local", trust=self.trust)
        return env, path

    def _certify(self, engine: Engine, env: EnvConfig, policy: Path | None) -> Certificate:
        from manip_il.evaluation.certify import certify, count_episodes

        count = count_episodes(env, self.cases, policy)
        with progress(count, f"certify {env.robot} {env.task}") as bar, engine:
            advance = bar.advance
            return certify(engine, env, self.cases, self.seed, policy, lambda _: advance(), trust=self.trust)
