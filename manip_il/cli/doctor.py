"""`manip-il doctor DATASET`: find what is wrong with a dataset, and repair it."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.cli.inputs import hub_hint, require_folder
from manip_il.cli.progress import progress, say
from manip_il.errors import ManipError
from manip_il.option import option

if TYPE_CHECKING:
    from collections.abc import Iterator

    from manip_il.doctor.finding import Finding
    from manip_il.doctor.patient import Patient

_MODEL = "model_sha256"


@dataclass
class DoctorOptions:
    """Check any LeRobot v3.0 dataset: files, rows, decoded video frames, statistics, journals.

    One line per finding on standard output; exit code 1 after errors, 0 after warnings alone.
    --repair builds the dataset again from its journals; without them it computes statistics and moves leftovers away.
    What it replaces is kept in DATASET.before-repair.
    """

    example: ClassVar[str] = "manip-il doctor datasets/demos"
    dataset: Path = option(MISSING, "folder of a LeRobot v3.0 dataset", positional=True)
    repair: bool = option(False, "repair what can be repaired, and keep a copy")

    def check(self) -> None:
        """Refuse what is no folder."""
        require_folder(self.dataset, f"the folder of a LeRobot dataset{hub_hint(self.dataset, 'datasets/')}")

    def run(self) -> None:
        """Examine, repair where asked, and say the verdict; raises `NotWhole` where something stays wrong."""
        from manip_il.data.episode_table import summarise_drawn
        from manip_il.doctor.examine import has_errors, repair, verdict
        from manip_il.doctor.finding import NotWhole

        dataset, findings = self._examine()
        if self.repair and any(finding.remedy.name != "NONE" for finding in findings):
            for line in repair(dataset, findings):
                say(f"repair   {line}")
            dataset, findings = self._examine()
        elif self.repair:
            say("repair   nothing to repair" if not findings else "repair   nothing that can be repaired")
        if has_errors(findings):
            raise NotWhole(verdict(dataset, findings))
        say(verdict(dataset, findings))
        if dataset.episodes and (drawn := summarise_drawn(dataset.episodes.drawn.values())):
            say(f"its episodes draw {drawn}")

    def _examine(self) -> tuple[Patient, list[Finding]]:
        from manip_il.doctor.examine import CHECKS, examine
        from manip_il.doctor.patient import Patient

        findings: list[Finding] = []
        with progress(None, "files examined") as bar:
            named = self.dataset.name not in ("", "..")  # journals and copies beside it are named after it
            dataset = Patient(self.dataset if named else self.dataset.resolve(), on_file=bar.advance)
            for finding in examine(dataset, (*CHECKS, check_robot)):
                say(str(finding))
                findings.append(finding)
        return dataset, findings


def check_robot(dataset: Patient) -> Iterator[Finding]:
    """Compare joints, state and compiled model with those of the robot and task in this program."""
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.data.lerobot_layout import OURS
    from manip_il.doctor.finding import error, warning

    try:
        own = dataset.own
    except ManipError:
        return  # named by the check of the spec
    if own is None:
        return
    spec, fingerprint = own.spec, own.fingerprint
    from manip_il.collect.environments import env_fingerprint, env_spec, is_known
    from manip_il.sim.env import EnvConfig
    from manip_il.sim.variation import OLDER

    if not is_known(spec.robot, spec.task):  # a user's own arm or task, of which a dataset holds the name alone
        return
    env = EnvConfig(spec.robot, spec.task, spec.fps, object=spec.object)
    here = env_spec(env)
    for what in ("joint_names", "environment_state_names", "sim_state_size", "action_meaning"):
        found, wanted = getattr(spec, what), getattr(here, what)
        older = what == "sim_state_size" and here.sim_state_size - found in OLDER  # before it held all draws
        if found != wanted and not older:
            yield error(OURS, f"{what} is {_short(found)}; {spec.robot} {spec.task} has {_short(wanted)} here")
    # Versions are compared elsewhere; tolerance and horizon are not part of a dataset.
    if _MODEL in fingerprint:
        theirs, ours = ({_MODEL: table[_MODEL]} for table in (fingerprint, env_fingerprint(env)))
        for text in compare_fingerprints("the dataset", theirs, "this program", ours):
            yield warning(OURS, text)


def _short(value: Any) -> str:
    text = ", ".join(value) if isinstance(value, tuple) else str(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
