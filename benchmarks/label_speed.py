"""Time of one expert label relative to the bare quadratic program that it solves, and to a label of
pick_place.

python benchmarks/label_speed.py [--quick]

The states are from episodes driven by the expert and by random actions. The limit is daqp on the
same problems, built beforehand; both alternate in the same run, state by state, and the tasks
alternate, too.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import qpsolvers
from _machine import describe_machine

from manip_il import Expert
from manip_il.collect.drivers import driver_of
from manip_il.collect.job import RolloutJob
from manip_il.mdp import State
from manip_il.robots import ROBOTS, ik
from manip_il.seeding import stream_seeds
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import make_config


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few states: shows that it runs, measures little"
    )
    options = parser.parse_args()
    episodes, repeats = (2, 2) if options.quick else (20, 5)
    print(describe_machine())
    compare_with_solver(episodes, repeats)
    compare_tasks(episodes, repeats)
    return 0


def compare_with_solver(episodes: int, repeats: int) -> None:
    """Print the median time of a pick_place label beside that of its bare quadratic program."""
    print("robot  states  label [us]  bare QP [us]  label / QP")
    for robot in ROBOTS:
        expert = Expert(scene_of(robot, "pick_place"))
        states = visited(robot, episodes)
        problems = [problem_of(expert, state) for state in states]
        pairs = [(s, p) for s, p in zip(states, problems, strict=True) if p is not None]
        labels, solves = np.empty((repeats, len(pairs))), np.empty((repeats, len(pairs)))
        for repeat in range(repeats):
            for i, (state, problem) in enumerate(pairs):
                labels[repeat, i] = seconds(expert.label, state)
                solves[repeat, i] = seconds(
                    partial(qpsolvers.solve_problem, solver="daqp"), problem
                )
        label, solve = np.median(labels.min(axis=0)), np.median(solves.min(axis=0))
        print(
            f"{robot:5s}  {len(pairs):6d}  {1e6 * label:10.1f}  {1e6 * solve:12.1f} "
            f" {label / solve:10.2f}"
        )


def compare_tasks(episodes: int, repeats: int) -> None:
    """Print the median label time of every task beside that of pick_place."""
    print("robot  task          states  label [us]  of pick_place's")
    robot = next(iter(ROBOTS))  # some tasks are out of reach for other arms
    experts = {task: Expert(scene_of(robot, task)) for task in TASKS}
    states = {task: visited(robot, episodes, task)[:: episodes // 2] for task in TASKS}
    times = {task: np.empty((repeats, len(states[task]))) for task in TASKS}
    for repeat in range(repeats):
        for task, expert in experts.items():
            times[task][repeat] = [seconds(expert.label, state) for state in states[task]]
    medians = {task: float(np.median(times[task].min(axis=0))) for task in TASKS}
    for task, label in medians.items():
        ratio = label / medians["pick_place"]
        print(f"{robot:5s}  {task:12s}  {len(states[task]):6d}  {1e6 * label:10.1f}  {ratio:15.2f}")


def visited(robot: str, episodes: int, task: str = "pick_place") -> list[State]:
    """Return states of `episodes` episodes driven by the expert, and of as many driven by random
    actions.
    """
    states: list[State] = []
    horizon = {"expert": TASKS[task].horizon, "random": 50}
    for driver in ("expert", "random"):
        job = RolloutJob(
            make_config(robot, task, horizon=horizon[driver]), driver_of(driver), hold=5
        )
        for episode in job.run(stream_seeds("certificate", episodes)):
            states += [State.from_vector(row) for row in episode.columns["sim_state"]]
    return states


def problem_of(expert: Expert, state: State) -> qpsolvers.Problem | None:
    """Return the quadratic program that a label solves, intercepted at the solver.

    None if it solves none.
    """
    caught: list[qpsolvers.Problem] = []
    plain = ik.daqp.solve

    def catch(*args: Any) -> Any:
        caught.append(qpsolvers.Problem(*(one.copy() for one in args[:4])))
        return plain(*args)

    ik.daqp.solve = catch
    try:
        expert.label(state)
    finally:
        ik.daqp.solve = plain
    return caught[0] if caught else None


def seconds(call: Callable[[Any], object], argument: object) -> float:
    started = time.perf_counter()
    call(argument)
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
