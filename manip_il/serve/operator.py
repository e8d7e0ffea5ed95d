"""Run a LeRobot program on a station, and do what a person would: press its keys and move the
arms.
"""

import contextlib
import os
import pty
import re
import select
import signal
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from manip_il.mdp import Actor
from manip_il.serve.episodes import ServedEpisodes
from manip_il.serve.station import Read, Station

RIGHT = b"\x1b[C"
LEFT = b"\x1b[D"
ENTER = b"\n"
PAUSE = b" "
CORRECT = b"\t"
INTERRUPT = b"\x03"
# time for a new world, or a joint at the end of its range, to settle before a key is pressed [s]
_SETTLED = 0.5
_TERMINAL = 0.001  # time for printed text to arrive [s]
_PATIENCE = 2  # number of horizons after which an episode counts as failed
_DIFFERS = 0.25  # how long a policy must differ from the expert before it is corrected [s]
_TELEOPERATED = 3  # number of commands after which a client's setup is over
_REMEMBERED = 400  # characters of output that are kept, as a message may arrive in parts
_AUTOGROUP = Path("/proc/self/autogroup")
_HIDDEN = ("DISPLAY", "WAYLAND_DISPLAY")  # without them LeRobot reads its keys from the terminal


class Operator:
    """A program in a terminal of its own, and its simulated operator.

    Attributes:
        failed: Number of episodes so far that were not solved.
        solved: Number of episodes so far that were solved.
        status: The program's exit code, once it has ended; else None.
    """

    def __init__(
        self, command: Sequence[str], station: Station, episodes: ServedEpisodes, intervene: float
    ):
        """Start the program.

        Args:
            command: The program and its arguments.
            station: The station whose ports the program uses.
            episodes: The station's episodes, which the operator begins and ends.
            intervene: How far a policy's targets may differ from the expert's before it is
                corrected, with LeRobot's DAgger strategy [rad].
        """
        self._station = station
        self._episodes = episodes
        self._intervene = intervene
        self._driver = Actor.EXPERT
        self._keep = True
        self.solved = 0
        self.failed = 0
        self._heard, self.status = "", None
        self._happened = deque[str | Read]()
        self._says = [  # what LeRobot's programs print, and the reaction to it
            (r"Rollout strategy: |Replaying episode", self._hand_over),
            (r"Recording episode", self._record),
            (r"Reset the environment", self._renew),
            (r"Stop recording", self._finish),
            (
                r"corrections-only recording started|DAgger continuous recording started",
                self._supervise,
            ),
            (r"Phase transition: autonomous -> paused", partial(self._reply, CORRECT)),
            (r"Phase transition: paused -> correcting", self._correct),
            (r"Phase transition: correcting -> paused", self._resume),
            (r"Phase transition: paused -> autonomous", self._supervise),
            (
                r"(?s)Mismatch between calibration.*Press ENTER to use provided",
                partial(self._reply, ENTER),
            ),
            (r"Press ENTER to use provided calibration file", partial(self._reply, b"c" + ENTER)),
            (r"Move .* to the middle of its range of motion", self._centre),
            (r"sequentially through their entire ranges|Move all joints except", self._sweep),
        ]
        self._doing = self._watch()
        self._pid, self._terminal = _start(command)
        station.on_read = self._was_read

    def each_step(self) -> bool:
        """Read the program's output and react.

        Return False once it has ended, with its exit code in `status`.
        """
        self._listen(0.0)
        while self._happened:
            event = self._happened.popleft()
            if isinstance(event, str):
                self._hear(event)
            else:
                self._episodes.frame(event)
        next(self._doing, None)
        if self.status is not None:
            self._episodes.end(keep=self._keep)
        return self.status is None

    def _listen(self, patience: float) -> None:
        """Collect what the program has printed. patience: how long to wait for output [s]."""
        with self._station.buses["follower"].lock:
            while self.status is None and select.select([self._terminal], [], [], patience)[0]:
                try:
                    said = os.read(self._terminal, 65_536)
                except OSError:  # the program has closed its terminal
                    self.status = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
                    return
                self._happened.append(said.decode(errors="replace"))

    def _was_read(self, read: Read) -> None:
        """Keep events in order: a program announces an episode before it reads the first frame."""
        self._listen(_TERMINAL)
        self._happened.append(read)

    def kill(self) -> None:
        """Terminate the program if it is still running."""
        if self.status is None:
            os.kill(self._pid, signal.SIGTERM)

    def _hear(self, text: str) -> None:
        """Forward printed text to standard output, which may block, and react to it."""
        os.write(sys.stdout.fileno(), text.encode())
        self._heard += text
        while found := [
            (match, act)
            for pattern, act in self._says
            if (match := re.search(pattern, self._heard))
        ]:
            match, act = min(found, key=lambda pair: pair[0].start())
            self._heard = self._heard[match.end() :]
            self._doing = act()
            next(self._doing, None)
        self._heard = self._heard[-_REMEMBERED:]

    def press(self, key: bytes) -> None:
        """Press a key in the program's terminal.

        On Ctrl-C LeRobot's programs save what is complete and exit.
        """
        os.write(self._terminal, key)

    def _settle(self) -> Iterator[None]:
        yield from [None] * max(1, round(_SETTLED * self._station.env.config.control_hz))

    def _reply(self, key: bytes) -> Iterator[None]:
        yield from self._settle()
        self.press(key)

    def _attempt(self, *, supervised: bool = False) -> Iterator[None]:
        """Wait until the task is solved or time is up, and count the episode.

        supervised: also end it when a policy deviates from the expert; only a solved episode counts
        then.
        """
        astray, config = 0, self._station.env.config
        for _ in range(_PATIENCE * config.horizon):
            wanted = self._station.expert() if supervised else None
            told = self._station.buses["follower"].goals()
            differs = wanted is not None and np.abs(told - wanted)[:-1].max() > self._intervene
            astray = astray + 1 if differs else 0
            if self._station.is_solved or astray > _DIFFERS * config.control_hz:
                break
            yield
        self.solved += self._station.is_solved
        self.failed += not (supervised or self._station.is_solved)

    def _watch(self) -> Iterator[None]:
        """For programs without episodes: once the follower moves, run attempts in a row, each in
        a new world.
        """
        while self._station.buses["follower"].commands < _TELEOPERATED:
            yield
        while True:
            self._episodes.begin(self._driver)
            yield from self._attempt()
            self._episodes.renew()

    def _hand_over(self) -> Iterator[None]:
        """Let the program drive from now on, instead of the leader."""
        self._driver = Actor.LEARNER
        yield from self._watch()

    def _record(self) -> Iterator[None]:
        """Demonstrate.

        Record a failed demonstration again, but keep a policy's attempt as it is.
        """
        self._keep = False  # an attempt that Ctrl-C cuts off is not in the program's dataset either
        self._episodes.begin(self._driver)
        yield from self._attempt()
        self._keep = self._station.is_solved or self._driver is Actor.LEARNER
        self.press(RIGHT if self._keep else LEFT)

    def _renew(self) -> Iterator[None]:
        self._episodes.renew(keep=self._keep)
        yield from self._reply(RIGHT)

    def _finish(self) -> Iterator[None]:
        self._episodes.end(keep=self._keep)
        yield

    def _supervise(self) -> Iterator[None]:
        """Watch a policy in new worlds until it deviates from the expert or fails.

        Then pause it.
        """
        is_solved = True
        while is_solved:
            self._episodes.renew()
            self._episodes.begin(Actor.LEARNER)
            yield from self._attempt(supervised=True)
            is_solved = self._station.is_solved
        self.press(PAUSE)

    def _correct(self) -> Iterator[None]:
        self._episodes.drive(Actor.EXPERT)
        yield from self._attempt()
        self.press(CORRECT)

    def _resume(self) -> Iterator[None]:
        self._episodes.end(keep=True)
        yield from self._reply(PAUSE)

    # Setting up

    def _centre(self) -> Iterator[None]:
        self._station.hand = np.clip(0.0, *self._station.limits.T)
        yield from self._reply(ENTER)

    def _sweep(self) -> Iterator[None]:
        for end in self._station.limits.T:
            self._station.hand = end
            yield from self._settle()
        yield from self._reply(ENTER)
        yield from self._settle()
        self._station.hand = None
        self._station.reset(self._station.seed)


def _start(command: Sequence[str]) -> tuple[int, int]:
    """Run a program in a new terminal; return its process id and our end of the terminal."""
    pid, terminal = pty.fork()
    if pid == 0:
        weigh_session()
        for name in _HIDDEN:
            os.environ.pop(name, None)
        try:
            os.execvp(command[0], list(command))
        except OSError as error:
            print(f"{command[0]}: {error.strerror}")
            os._exit(127)
    return pid, terminal


def weigh_session(weight: str = "-20") -> str:
    """Give this process's session the nice value `weight` and return the former one, or "" if this
    is not permitted.

    Linux first shares CPU time among sessions (autogroups). The program and its servos run in two
    sessions, and each must answer the other within milliseconds. Real-time priority would block the
    kernel's own threads, which carry bytes from one end of a terminal to the other.
    """
    with contextlib.suppress(OSError):
        # "/autogroup-12 nice 0"; empty if autogroups are off
        before = _AUTOGROUP.read_text().split()
        if before:
            _AUTOGROUP.write_text(weight)
            return before[-1]
    return ""
