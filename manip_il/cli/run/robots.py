"""Run `manip-il robot new`, `check`, `certify`, `identify`, `excite`, `board`, `align`,
`preflight`.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from manip_il import checks
from manip_il.bridges.doctor.examine import examine_folder
from manip_il.calibrate import align_page
from manip_il.calibrate.align import ROUNDS as ALIGN_ROUNDS
from manip_il.calibrate.align import align
from manip_il.calibrate.board import sheet
from manip_il.calibrate.excite import excite
from manip_il.calibrate.page import advice as untold
from manip_il.calibrate.page import identified_report, servo_table, to_yaml
from manip_il.calibrate.preflight import Preflight
from manip_il.calibrate.servos import ROUNDS, ServoArm, identify, in_units, motions_of
from manip_il.calibrate.sightings import sightings_of
from manip_il.cli.outputs import OutputFile, about, progress, publish, say
from manip_il.cli.robots import (
    AlignOptions,
    BoardOptions,
    CertifyOptions,
    ExciteOptions,
    IdentifyOptions,
    PreflightOptions,
    RobotCheckOptions,
    RobotNewOptions,
)
from manip_il.collect.inputs import env_config
from manip_il.collect.workers import Engine
from manip_il.data.atomic import write_file
from manip_il.data.dataset import Dataset, EpisodeData
from manip_il.data.lerobot_write import write_episodes
from manip_il.errors import ManipError
from manip_il.evaluation.certify import FILE_NAME, certify, count_episodes
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.robot_check import FILE_NAME as CHECK_FILE
from manip_il.evaluation.robot_check import (
    advice,
    check_report,
    check_robot,
    verdict,
)
from manip_il.learn.policy import LearnedPolicy
from manip_il.option import NameOrPath
from manip_il.progress import Progress
from manip_il.robots.found import suggest, yaml_of
from manip_il.robots.gripper import sweep
from manip_il.robots.table import get_robot
from manip_il.seeding import rng_for
from manip_il.tasks import NAMES
from manip_il.tasks.table import get_task
from manip_il.worlds.ladder.world import scene_of


def run_new(options: RobotNewOptions) -> None:
    """Write the YAML file, check the robot, print what is left to do.

    Raises `ManipError` if it can do no task.
    """
    target = options.output or options.model.with_suffix(".yaml")
    checks.name(f"the name of {target}, which becomes the robot's,", target.stem)
    OutputFile(output=target, overwrite=options.overwrite).check()
    paths = [
        os.path.relpath(path, target.parent) if path else ""
        for path in (options.model, options.gripper)
    ]
    found = suggest(options.model, options.gripper)
    write_file(target, yaml_of(found, *paths).encode())
    say(f"robot: {target}")
    with Engine(None) as engine:
        checked = check_robot(target, list(NAMES), 0, engine, Progress())
    say(verdict(checked), *(f"change: {line}" for line in advice(checked)))
    if len(checked.failed) == len(NAMES):
        raise ManipError(f"{target} cannot do any task yet; see above")


def run_check(options: RobotCheckOptions) -> None:
    """Measure, print the tables, write the report. Raises `ManipError` if a task cannot be done."""
    # raises, before anything is written, if the robot cannot be used
    sweep(get_robot(options.robot))
    tasks = options.tasks or list(NAMES)
    for task in tasks:
        get_task(task)
    with options.open() as folder:
        with (
            progress(2 * options.episodes * len(tasks), f"check {options.robot}") as bar,
            Engine(None) as engine,
        ):
            found = check_robot(options.robot, tasks, options.episodes, engine, bar)
        page = check_report(found)
        publish(
            folder / CHECK_FILE,
            found.to_json(),
            page.sections[0].tables,
            page.verdict,
            *(f"change: {line}" for line in page.facts),
            page=page,
            options=options,
        )
    if found.failed:
        names = ", ".join(task.name for task in found.failed)
        raise ManipError(
            f"{options.robot} cannot do {len(found.failed)} of {len(tasks)} tasks: {names}; see"
            " above"
        )


def run_certify(options: CertifyOptions) -> None:
    """Run the episodes, write `certificate.json`, print the tables."""
    env = env_config(options.env)
    count = count_episodes(env, options.cases)
    with options.open() as folder:
        with (
            progress(count, f"certify {env.robot} {env.task}") as bar,
            options.open_engine() as engine,
        ):
            certificate = certify(engine, env, options.cases, options.seed, lambda _: bar.step())
        mu = certificate.mu
        lines = () if mu is None else (f"u of Ross et al. (2011) is at least {mu} steps",)
        publish(folder / FILE_NAME, certificate.to_json(), [certificate.table()], *lines)


def run_identify(options: IdentifyOptions) -> None:
    """Fit, write the servos and the page, print the table."""
    dataset = Dataset.open(options.dataset)
    scene = scene_of(options.robot, "reach")
    motions = motions_of(dataset, scene)
    with options.open() as folder:
        arm = ServoArm.of_scene(scene, dataset.fps)
        with progress(ROUNDS, f"identify {options.dataset}") as bar:
            joints = scene.actions.names
            found = identify(arm, motions, joints, lambda: bar.step())
        path = folder / "arm.yaml"
        write_file(path, to_yaml(found, _extended(options.robot, folder)).encode())
        page = replace(identified_report(found, dataset.fps), **about(options))
        servo_table(found).print()
        say(*untold(found), f"robot: {path}", f"report: {page.write(folder)}")


def _extended(robot: NameOrPath, folder: Path) -> str:
    """Return a robot as `extends` names it in a YAML in a folder."""
    return os.path.relpath(robot, folder) if isinstance(robot, Path) else robot


def run_board(options: BoardOptions) -> None:
    """Write the sheet."""
    options.check()
    write_file(options.output, sheet())
    say(f"board: {options.output}; print it on A4 at 100 %, and measure the line below the board")


def run_align(options: AlignOptions) -> None:
    """Find the board, fit, write the robot and the page, print the tables."""
    dataset = Dataset.open(options.dataset)
    robot = get_robot(options.robot)
    with options.open() as folder:
        with progress(None, f"board in {options.dataset}") as bar:
            seen = sightings_of(dataset, robot, options.ruler, lambda: bar.step())
        with progress(ALIGN_ROUNDS, f"align {options.dataset}") as bar:
            found = align(robot, seen, str(options.dataset), lambda: bar.step())
        path = folder / "arm.yaml"
        extends = _extended(options.robot, folder)
        write_file(path, align_page.to_yaml(found, robot, extends).encode())
        page = replace(align_page.aligned_report(found, robot, dataset), **about(options))
        for table in (
            align_page.thrown_table(found),
            align_page.camera_table(found),
            align_page.zero_table(found, robot),
        ):
            table.print()
        say(*align_page.untold(found, robot), page.verdict)
        say(f"robot: {path}", f"report: {page.write(folder)}")


def run_preflight(options: PreflightOptions) -> None:
    """Compare, write the page, print every finding. Raises `ManipError` for no-go."""
    dataset = Dataset.open(options.dataset)
    policy = LearnedPolicy.load(options.policy, task=dataset.instruction, trust=options.trust)
    origin = policy.checkpoint.origin
    robot = options.robot or (origin.robot if origin else "so101")
    preflight = Preflight(dataset, policy, scene_of(robot, "reach"), options.limit)
    with options.open() as folder:
        findings = examine_folder(options.dataset, [preflight.check])
        errors = sum(finding.is_error for finding in findings)
        verdict = f"no-go, faults: {errors}" if errors else "go"
        figure = preflight.figure()
        section = Section("Recorded and simulated", figures=(figure,) if figure else ())
        page = Report(
            title="Preflight",
            verdict=f"{options.dataset}: {verdict}.",
            sections=(section,),
            facts=tuple(map(str, findings)),
            **about(options),
        )
        say(*map(str, findings), f"report: {page.write(folder)}")
    if errors:
        raise ManipError(f"{options.dataset}: {verdict}; see above")
    say(f"{options.dataset}: {verdict}")


def run_excite(options: ExciteOptions) -> None:
    """Draw the motion, write it as a dataset."""
    scene = scene_of(options.robot, "reach")
    robot, names = scene.robot, list(scene.actions.names)
    goals = excite(scene, robot.fps, options.seconds, rng_for(options.seed, "motion"))
    actions = in_units(robot, goals).astype(np.float32)
    episode = EpisodeData({"action": actions}, ["move every joint"] * len(actions))
    column = {"dtype": "float32", "shape": [len(names)], "names": names}
    write_episodes(
        [episode],
        options.dataset,
        {"action": column},
        robot.fps,
        robot.lerobot.robot_type if robot.lerobot else "",
        replace=options.overwrite,
    )
    say(f"{len(actions)} frames in {options.dataset}; put the arm near its first posture:")
    said = zip(names, actions[0].tolist(), strict=True)
    say(", ".join(f"{name} {value:.0f}" for name, value in said))
