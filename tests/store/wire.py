"""HTTP servers of the tests: bodies, ranges, a log of what travelled, and faults on demand."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

_CHUNK = 16 * 1024


@dataclass
class Fault:
    """What goes wrong with the next `times` requests whose `METHOD /path?query` matches.

    status: answer this, with `headers` and `body`. cut: close the connection after so many bytes of the body, of the
    answer's for GET, else of the request's. lost: do the work, then close the connection without an answer. corrupt:
    flip the body's first byte, the answer's for GET, else the request's. pause: wait so long before every piece of the
    body [s].
    """

    match: str
    times: int = 1
    status: int | None = None
    headers: dict[str, str] = field(default_factory=dict)
    body: Any = field(default_factory=lambda: {"error": "told to fail"})
    cut: int | None = None
    lost: bool = False
    corrupt: bool = False
    pause: float = 0.0


@dataclass(frozen=True)
class Request:
    """One request that was answered, or given up."""

    method: str
    path: str
    query: str
    received: int  # bytes of its body
    sent: int  # bytes of the answer's body


@dataclass(frozen=True)
class Answer:
    """What a route answers; a dict or a list goes out as JSON."""

    status: int = 200
    body: Any = b""
    headers: dict[str, str] = field(default_factory=dict)

    def content(self) -> bytes:
        return self.body if isinstance(self.body, bytes) else json.dumps(self.body).encode()


class Wire:
    """A threading HTTP server on a free port of loopback, with faults and a log.

    `answer` gets every request that no fault took; cuts_ranges: it gives whole files, whatever range was asked for.
    """

    cuts_ranges = True

    def __init__(self) -> None:
        self.faults: list[Fault] = []
        self.log: list[Request] = []
        self._lock = threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"wire": self}))
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def answer(self, method: str, path: str, query: str, headers: Any, body: bytes) -> Answer:
        raise NotImplementedError

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def take_fault(self, line: str) -> Fault:
        with self._lock:
            for fault in self.faults:
                if fault.times > 0 and re.search(fault.match, line):
                    fault.times -= 1
                    return fault
        return Fault("")

    def requests(self, match: str) -> list[Request]:
        """The logged requests whose `METHOD /path` matches."""
        return [one for one in self.log if re.search(match, f"{one.method} {one.path}")]

    def received(self) -> int:
        """Bytes of files that came in: of LFS objects and of commits."""
        return sum(one.received for one in self.requests(r"^PUT |^POST .*/commit/"))


class _Cut(Exception):
    """The connection is to be closed now."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else headers and body, two writes, are 40 ms apart
    wire: Wire

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def _handle(self) -> None:
        url = urlsplit(self.path)
        path, self._received, self._sent = unquote(url.path), 0, 0
        self._fault = self.wire.take_fault(f"{self.command} {path}?{url.query}")
        try:
            body = self._read_body()
            if self._fault.status is not None:
                answer = Answer(self._fault.status, self._fault.body, self._fault.headers)
            else:
                answer = self.wire.answer(self.command, path, url.query, self.headers, body)
            if self._fault.lost:
                raise _Cut
            self._send(answer)
        except (_Cut, BrokenPipeError, ConnectionResetError):
            self.close_connection = True
            with contextlib.suppress(OSError):
                self.connection.shutdown(socket.SHUT_RDWR)  # else the client waits for more
        finally:
            self.wire.log.append(Request(self.command, path, url.query, self._received, self._sent))

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = _handle  # noqa: N815 - http.server's names

    def _read_body(self) -> bytes:
        pieces: list[bytes] = []
        for piece in self._pieces_in():
            self._received += len(piece)
            pieces.append(piece)
            if self.command != "GET":
                time.sleep(self._fault.pause)
                if self._fault.cut is not None and self._received >= self._fault.cut:
                    raise _Cut
        return self._corrupted(b"".join(pieces), self.command != "GET")

    def _corrupted(self, data: bytes, is_meant: bool) -> bytes:
        return bytes([data[0] ^ 1]) + data[1:] if data and is_meant and self._fault.corrupt else data

    def _pieces_in(self) -> Iterator[bytes]:
        if "chunked" in self.headers.get("Transfer-Encoding", ""):
            while size := int(self.rfile.readline(), 16):
                yield self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return
        left = int(self.headers.get("Content-Length") or 0)
        while left:
            piece = self.rfile.read(min(left, _CHUNK))
            if not piece:
                raise _Cut  # the client died
            left -= len(piece)
            yield piece

    def _send(self, answer: Answer) -> None:
        content, status = self._corrupted(answer.content(), self.command == "GET"), answer.status
        headers = {"Content-Type": "application/json", **answer.headers}
        if (span := self.headers.get("Range")) and status == 200 and self.command == "GET" and self.wire.cuts_ranges:
            start = int(re.fullmatch(r"bytes=(\d+)-\d*", span)[1])
            headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
            status = 206 if start < len(content) else 416
            content = content[start:]
        headers.setdefault("Content-Length", str(len(content)))
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self._write(content)

    def _write(self, content: bytes) -> None:
        end = len(content) if self._fault.cut is None else self._fault.cut
        for start in range(0, min(end, len(content)), _CHUNK):
            time.sleep(self._fault.pause)
            piece = content[start : min(start + _CHUNK, end)]
            self.wfile.write(piece)
            self._sent += len(piece)
        if end < len(content):
            self.wfile.flush()
            raise _Cut
