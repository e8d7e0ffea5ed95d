"""A server on loopback that answers whatever bytes a test tells it to, and remembers who asked."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from manip_il.cli.main import main

Script = Callable[[str], Iterable[bytes]]  # "GET /path?query" -> all that is sent


@dataclass
class Liar:
    """`asked`: the head of every request, as it came. One connection a request."""

    script: Script
    asked: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._threads: list[threading.Thread] = []
        self.closing = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def port(self) -> int:
        return self._socket.getsockname()[1]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def close(self) -> None:
        self.closing.set()
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            head = b""
            while b"\r\n\r\n" not in head:
                if not (piece := connection.recv(65536)):
                    return
                head += piece
            text, _, body = head.partition(b"\r\n\r\n")
            self.asked.append(text.decode())
            length = [line.split(b":")[1] for line in text.lower().splitlines() if line.startswith(b"content-length:")]
            left = int(length[0]) - len(body) if length else 0
            while left > 0 and (piece := connection.recv(65536)):
                left -= len(piece)
            for piece in self.script(" ".join(text.decode().split()[:2])):
                if self.closing.is_set():
                    return
                connection.sendall(piece)


@contextlib.contextmanager
def a_liar(script: Script) -> Iterator[Liar]:
    """A running one."""
    liar = Liar(script)
    try:
        yield liar
    finally:
        liar.close()


def answer(value: Any = b"", status: str = "200 OK", **headers: str) -> list[bytes]:
    """A whole answer; anything but bytes goes as JSON."""
    body = value if isinstance(value, bytes) else json.dumps(value).encode()
    return [head(status, **{"Content-Length": str(len(body)), **headers}), body]


def head(status: str = "200 OK", **headers: str) -> bytes:
    """The first part of an answer; `_` in a header's name is `-`."""
    given = {"Connection": "close", "Content_Type": "application/json", **headers}
    lines = [f"{name.replace('_', '-')}: {value}" for name, value in given.items()]
    return "\r\n".join([f"HTTP/1.1 {status}", *lines, "", ""]).encode()


def drip(line: str) -> Iterator[bytes]:
    """A body without an end, a byte at a time."""
    yield head(Content_Length="100000000", ETag='"1"')
    while True:
        time.sleep(0.01)
        yield b" "


def drip_headers(line: str) -> Iterator[bytes]:
    """Headers without an end, a byte at a time."""
    yield b"HTTP/1.1 200 OK\r\nX-Slow: "
    while True:
        time.sleep(0.01)
        yield b"x"


def endless(piece: bytes, status: str = "200 OK", **headers: str) -> Iterator[bytes]:
    """The same piece for ever."""
    return itertools.chain([head(status, **headers)], itertools.repeat(piece))


def error_of_pull(url: str, folder: Path, capsys: pytest.CaptureFixture[str], token: str) -> str:
    """The one line of the error that a pull ends in, without the token; nothing is left of it."""
    assert main(["pull", url, str(folder / "got"), "--quiet"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert len(error) < 1000
    assert token not in error
    assert not (folder / "got").exists()
    return error
