"""A serial port that a chain of servos answers on: a pseudo-terminal."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import pty
import select
import struct
import sys
import threading
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

from manip_il.serve.chain import EEPROM, Chain


class Port(Chain):
    """Servos that answer on a pseudo-terminal, from a thread of its own.

    path: to be opened by any program that speaks to serial ports. on_refusal: called with a line that says why a client
    gets no answer. eeprom: a file that keeps ids, limits and offsets; it is read first, where it is there.
    """

    def __init__(self, limits: Sequence[tuple[int, int]], eeprom: Path):
        super().__init__(limits)
        self.on_refusal: Callable[[str], None] = lambda line: None
        self._eeprom = eeprom
        if eeprom.is_file():
            for servo, kept in zip(self.servos, json.loads(eeprom.read_text()), strict=True):
                servo.memory[EEPROM.start : EEPROM.stop] = bytes.fromhex(kept)
        self._master, self._slave = pty.openpty()  # our hold on the other end keeps the port open between two clients
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = Path(os.ttyname(self._slave))
        self._opened = _Opened(self.path)
        self._stop_reading, self._stop = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"port {eeprom.stem}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and the port with it."""
        os.write(self._stop, b".")
        self._thread.join()
        self.keep()
        for one in (self._master, self._slave, self._stop, self._stop_reading):
            os.close(one)
        self._opened.close()

    def _run(self) -> None:
        waiting = b""
        while True:
            ready, _, _ = select.select([self._master, self._stop_reading], [], [])
            if self._stop_reading in ready:
                return
            received = waiting + os.read(self._master, 4096)
            for answer, rest in self.answers(received):
                waiting = rest
                if answer and not (_is_of_ping(answer) and self._is_shared()):
                    os.write(self._master, answer)

    def _is_shared(self) -> bool:
        """Return whether two other programs have the port open: who pings then comes second."""
        if shared := self._opened.count() > 1:
            self.on_refusal(f"{self.path} is open in another program already: the second gets no answer")
        return shared

    def keep(self) -> None:
        """Write what the servos keep to the file, if a client has changed it: not while one waits for an answer."""
        with self.lock:
            changed, self.eeprom_changed = self.eeprom_changed, False
            kept = [servo.memory[EEPROM.start : EEPROM.stop].hex() for servo in self.servos]
        if changed:
            partial = self._eeprom.with_suffix(".partial")
            partial.write_text(json.dumps(kept, indent=1))
            partial.replace(self._eeprom)


def _is_of_ping(answer: bytes) -> bool:
    """Whether it is one servo's, without parameters: of a client that looks who is there, or has written."""
    return len(answer) == 6


class _Opened:
    """Counts by how many others a file is open, by Linux's inotify; where there is none, nobody counts."""

    _OPEN, _CLOSE = 0x20, 0x08 | 0x10
    _EVENT = struct.Struct("iIII")

    def __init__(self, path: Path):
        self._count, self._events = 0, -1
        if sys.platform == "linux":
            libc = ctypes.CDLL(None)
            self._events = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
            libc.inotify_add_watch(self._events, bytes(path), self._OPEN | self._CLOSE)

    def count(self) -> int:
        """Return by how many it is open now."""
        with contextlib.suppress(OSError):  # nothing has happened
            while happened := os.read(self._events, 4096):
                for _, mask, _, _ in self._EVENT.iter_unpack(happened):
                    self._count += bool(mask & self._OPEN) - bool(mask & self._CLOSE)
        return self._count

    def close(self) -> None:
        """Stop counting."""
        if self._events >= 0:
            os.close(self._events)
