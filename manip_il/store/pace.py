"""A least speed for connections, so that a server that sends a byte now and then cannot hold a program for ever."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import httpcore

from manip_il.store.errors import RemoteError

LEAST_SPEED = 1000  # [bytes/s]; a modem of 1990 has twice that
WINDOW = 60.0  # of waiting, over which the speed is the mean [s]
_PIECE = 16 * 1024  # that is written between two looks at the clock [bytes]


class Pace:
    """What one connection has moved, and for how long it was waited for. name: the server's, in messages."""

    def __init__(self, name: str):
        self._name = name
        self._seconds, self._bytes = 0.0, 0

    def add(self, seconds: float, count: int) -> None:
        """Count one wait. Raises `RemoteError` where a window of waiting is full and too little has come or gone."""
        self._seconds, self._bytes = self._seconds + seconds, self._bytes + count
        if self._seconds < WINDOW:
            return
        if self._bytes < LEAST_SPEED * self._seconds:
            raise RemoteError(
                f"{self._name} moved {self._bytes:,} bytes in {self._seconds:.0f} s, expected at least {LEAST_SPEED:,} "
                "bytes a second; try again later, or over another connection: what has been transferred is kept"
            )
        self._seconds, self._bytes = 0.0, 0


class PacedBackend(httpcore.NetworkBackend):
    """Opens connections that keep to the least speed, once an answer has begun and while a request is sent."""

    def __init__(self, inner: httpcore.NetworkBackend):
        self._inner = inner

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """As httpcore's."""
        stream = self._inner.connect_tcp(host, port, timeout, local_address, socket_options)
        return _PacedStream(stream, f"{host}:{port}")

    def connect_unix_socket(
        self, path: str, timeout: float | None = None, socket_options: Iterable[Any] | None = None
    ) -> httpcore.NetworkStream:
        """As httpcore's."""
        return self._inner.connect_unix_socket(path, timeout, socket_options)

    def sleep(self, seconds: float) -> None:
        """As httpcore's."""
        self._inner.sleep(seconds)


class _PacedStream(httpcore.NetworkStream):
    def __init__(self, inner: httpcore.NetworkStream, name: str):
        self._inner, self._name = inner, name
        self._sent, self._come = Pace(name), Pace(name)
        self._answering = False

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        seconds, data = _timed(lambda: self._inner.read(max_bytes, timeout))
        if self._answering:  # for its first bytes a server may have to work; there is a time limit for that
            self._come.add(seconds, len(data))
        self._answering = True
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        if self._answering:
            self._answering, self._come = False, Pace(self._name)
        for start in range(0, len(buffer), _PIECE):
            piece = buffer[start : start + _PIECE]
            seconds, _ = _timed(lambda piece=piece: self._inner.write(piece, timeout))
            self._sent.add(seconds, len(piece))

    def close(self) -> None:
        self._inner.close()

    def start_tls(
        self, ssl_context: Any, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        return _PacedStream(self._inner.start_tls(ssl_context, server_hostname, timeout), self._name)

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)


def _timed[T](work: Callable[[], T]) -> tuple[float, T]:
    started = time.monotonic()
    result = work()
    return time.monotonic() - started, result
