"""Runs one of LeRobot's programs against a station and does what a person would: presses its keys, moves its arms."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import signal
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import Actor
from manip_il.serve.log import SessionLog
from manip_il.serve.station import Read, Station

F64 = NDArray[np.float64]
RIGHT, LEFT, ENTER, PAUSE, CORRECT, INTERRUPT = b"\x1b[C", b"\x1b[D", b"\n", b" ", b"\t", b"\x03"
HELD = 1.0  # how long the task is solved before an episode ends [s]
_SETTLED = 0.5  # a new world stands for so long before the program is told that it is ready [s]
_TERMINAL = 0.001  # that what is printed may take to get here [s]
_PATIENCE = 2  # horizons before an episode counts as failed
_DIFFERS = 0.25  # how long a policy differs from the expert before it is corrected [s]
_DWELL = 0.5  # of a joint at the end of its range [s]
_TELEOPERATED = 3  # commands in a row that are no setup any more
URGENT = 10  # how far the priority of what answers is above the program's
_HIDDEN = ("DISPLAY", "WAYLAND_DISPLAY")  # without them LeRobot reads its keys from the terminal


class Operator:
    """A program in a terminal of its own, and who sits at it.

    seeds: of the worlds, one after another. intervene: by how much a policy's targets may differ from the expert's
    before it is corrected, with LeRobot's DAgger strategy [rad]. failed, solved: episodes so far.
    """

    def __init__(
        self,
        command: Sequence[str],
        station: Station,
        seeds: Iterator[int],
        log: SessionLog | None = None,
        intervene: float = 0.15,
    ):
        self.station, self._seeds, self._log, self._intervene = station, seeds, log, intervene
        self._driver, self._keep, self.solved, self.failed = Actor.EXPERT, True, 0, 0
        self._heard, self.status = "", None
        self._happened = deque[str | Read]()
        self._says = [  # what LeRobot's programs print, and what is done then
            (r"Rollout strategy: ", self._roll_out),
            (r"Recording episode", self._record),
            (r"Reset the environment", self._renew),
            (r"Stop recording", self._finish),
            (r"Replaying episode", self._follow),
            (r"Base strategy control loop started", self._watch),
            (r"corrections-only recording started|DAgger continuous recording started", self._supervise),
            (r"Phase transition: autonomous -> paused", self._hand_over),
            (r"Phase transition: paused -> correcting", self._correct),
            (r"Phase transition: correcting -> paused", self._resume),
            (r"Phase transition: paused -> autonomous", self._go_on),
            (r"Press ENTER to use provided calibration file", self._confirm),
            (r"Connect the controller board to the '(\w+)' motor only", self._connect),
            (r"Move .* to the middle of its range of motion", self._centre),
            (r"sequentially through their entire ranges|Move all joints except", self._sweep),
            (r"Move robot to ALL joint limits", self._explore),
        ]
        self._doing = self._teleoperate()
        self._pid, self._terminal = _start(command)
        station.on_read = self._was_read

    def each_step(self) -> bool:
        """Read what the program says and act; returns False once it has ended, with its exit code in `status`."""
        self._listen(0.0)
        while self._happened:
            event = self._happened.popleft()
            if isinstance(event, str):
                self._hear(event)
            elif self._log is not None:
                self._log.frame(event)
        next(self._doing, None)
        if self.status is not None:
            self._end(keep=self._keep)
        return self.status is None

    def _listen(self, patience: float) -> None:
        """Take what the program has printed. patience: how long to wait for something [s]."""
        with self.station.buses["follower"].lock:
            while self.status is None and select.select([self._terminal], [], [], patience)[0]:
                try:
                    said = os.read(self._terminal, 65_536)
                except OSError:  # it has closed its terminal
                    self.status = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
                    return
                self._happened.append(said.decode(errors="replace"))

    def _was_read(self, read: Read) -> None:
        """Keep order: a program prints that an episode begins before it reads its first frame."""
        self._listen(_TERMINAL)
        self._happened.append(read)

    def stop(self) -> None:
        """Press Ctrl-C: LeRobot's programs then save what is whole and end."""
        self._press(INTERRUPT)

    def kill(self) -> None:
        """End the program if it still runs."""
        if self.status is None:
            os.kill(self._pid, signal.SIGTERM)

    def _hear(self, text: str) -> None:
        """Pass on what it has printed, which a slow disk may hold up, and act."""
        os.write(sys.stdout.fileno(), text.encode())
        self._heard += text
        while found := [(match, act) for pattern, act in self._says if (match := re.search(pattern, self._heard))]:
            match, act = min(found, key=lambda one: one[0].start())
            self._heard = self._heard[match.end() :]
            self._doing = act(*match.groups())
            next(self._doing, None)
        self._heard = self._heard[-200:]

    def _press(self, key: bytes) -> None:
        os.write(self._terminal, key)

    def _wait(self, seconds: float) -> Iterator[None]:
        yield from [None] * max(1, round(seconds * self.station.env.config.control_hz))

    def _begin(self, driver: Actor) -> None:
        """Let an episode begin in the world as it is; the expert moves the leader if it drives."""
        self.station.mover = self.station.expert if driver is Actor.EXPERT else lambda: None
        if self._log is not None:
            self._log.begin()
            self._log.driver = driver

    def _end(self, *, keep: bool) -> None:
        if self._log is not None:
            self._log.end(keep=keep)

    def _start_world(self) -> None:
        self.station.mover = lambda: None
        self.station.reset(next(self._seeds))

    @property
    def _is_solved(self) -> bool:
        """Whether the task has been solved for a while."""
        return self.station.solved_for >= HELD

    def _attempt(self) -> Iterator[None]:
        """Wait until the task is solved, or for longer than that may take."""
        for _ in range(_PATIENCE * self.station.env.config.horizon):
            if self._is_solved:
                break
            yield

    def _count(self) -> None:
        self.solved, self.failed = self.solved + self._is_solved, self.failed + (not self._is_solved)

    # Without episodes: `lerobot-teleoperate`, `lerobot-replay`, the base strategy

    def _teleoperate(self) -> Iterator[None]:
        """Move the leader as soon as the follower follows."""
        bus = self.station.buses["follower"]
        while bus.commands < _TELEOPERATED:
            yield
        yield from self._watch()

    def _follow(self) -> Iterator[None]:
        """Log what the program does to its end."""
        self._begin(Actor.LEARNER)
        yield

    def _watch(self) -> Iterator[None]:
        """Let one attempt follow another, each in a new world."""
        while True:
            self._begin(self._driver)
            yield from self._attempt()
            self._end(keep=True)
            self._count()
            self._start_world()

    # An episode of `lerobot-record`, or of the episodic strategy

    def _roll_out(self) -> Iterator[None]:
        """From here on a policy drives."""
        self._driver = Actor.LEARNER
        yield

    def _record(self) -> Iterator[None]:
        """Demonstrate; a demonstration that fails is recorded again, a policy's attempt is kept as it is."""
        self._begin(self._driver)
        yield from self._attempt()
        self._count()
        self._keep = self._is_solved or self._driver is Actor.LEARNER
        self._press(RIGHT if self._keep else LEFT)

    def _renew(self) -> Iterator[None]:
        self._end(keep=self._keep)
        self._start_world()
        yield from self._wait(_SETTLED)
        self._press(RIGHT)

    def _finish(self) -> Iterator[None]:
        self._end(keep=self._keep)
        yield

    # A policy that is corrected

    def _supervise(self) -> Iterator[None]:
        """Watch the policy until it would do something else than the expert, or gets nowhere: then pause it."""
        while True:
            self._begin(Actor.LEARNER)
            differs = 0
            for _ in self._attempt():
                yield
                differs = differs + 1 if self._differs() else 0
                if differs > _DIFFERS * self.station.env.config.control_hz:
                    break
            if not self._is_solved:
                break
            self._count()
            self._end(keep=True)
            self._start_world()
        self._press(PAUSE)

    def _differs(self) -> bool:
        """Whether the arm is on its way to somewhere else than the expert would go."""
        wanted = self.station.wanted()
        return wanted is not None and np.abs(self.station.follower.goal() - wanted)[:-1].max() > self._intervene

    def _hand_over(self) -> Iterator[None]:
        yield from self._wait(_SETTLED)
        self._press(CORRECT)

    def _correct(self) -> Iterator[None]:
        self.station.mover = self.station.expert
        if self._log is not None:
            self._log.driver = Actor.EXPERT
        yield from self._attempt()
        self._count()
        self._press(CORRECT)

    def _resume(self) -> Iterator[None]:
        self._end(keep=True)
        yield from self._wait(_SETTLED)
        self._press(PAUSE)

    def _go_on(self) -> Iterator[None]:
        self._start_world()
        yield from self._supervise()

    # Setting up

    def _confirm(self) -> Iterator[None]:
        yield from self._wait(_SETTLED)
        self._press(ENTER)

    def _connect(self, name: str) -> Iterator[None]:
        for bus in self.station.buses.values():
            bus.connected = {bus.servos[self.station.names.index(name)]}
        yield from self._confirm()

    @property
    def _middle(self) -> F64:
        """Joints in the middle of their ranges, the arm's that can be at zero there [rad], (n,)."""
        low, high = self.station.limits.T
        return np.where((low < 0) & (high > 0) & (np.arange(len(low)) < len(low) - 1), 0, (low + high) / 2)

    def _centre(self) -> Iterator[None]:
        self.station.hand = self._middle
        yield from self._confirm()

    def _sweep(self) -> Iterator[None]:
        for end in self.station.limits.T:
            self.station.hand = end
            yield from self._wait(_DWELL)
        self._press(ENTER)
        yield from self._wait(_DWELL)
        self.station.hand = None
        self.station.reset(self.station.seed)

    def _explore(self) -> Iterator[None]:
        """Move the leader, and the follower by it, a joint at a time to both ends of its range."""
        for joint, ends in enumerate(self.station.limits):
            for end in ends:
                q = self._middle
                q[joint] = end
                self.station.mover = lambda q=q: q
                yield from self._wait(3 * _DWELL)


def _start(command: Sequence[str]) -> tuple[int, int]:
    """Run a program in a new terminal; its process and the terminal's other end."""
    pid, terminal = pty.fork()
    if pid == 0:
        weigh_session()
        os.nice(URGENT if os.nice(0) < 0 else 0)
        for name in _HIDDEN:
            os.environ.pop(name, None)
        try:
            os.execvp(command[0], list(command))
        except OSError as error:
            print(f"{command[0]}: {error.strerror}")
            os._exit(127)
    return pid, terminal


def weigh_session() -> None:
    """Raise the priority of this process's session if permitted; Linux shares its time among sessions first.

    The program and its servos run in two sessions, and each must answer the other within milliseconds.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("-20")
