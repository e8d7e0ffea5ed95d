"""moto's S3 on loopback, and a proxy before it that misbehaves as it is told."""

from __future__ import annotations

import contextlib
import http.client
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from moto.server import ThreadedMotoServer

KEY, SECRET = "AKIATESTTESTTESTTEST", "a/secret/that+nobody/must/see"
_HOP = ("connection", "transfer-encoding", "content-length", "date", "server")


@contextlib.contextmanager
def running_moto() -> Iterator[str]:
    """The endpoint."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        yield f"http://{host}:{port}"
    finally:
        server.stop()


def variables(endpoint: str) -> dict[str, str]:
    """What every S3 program reads."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": "/dev/null",
        "AWS_SHARED_CREDENTIALS_FILE": "/dev/null",
        "AWS_EC2_METADATA_DISABLED": "true",
    }


Change = Callable[[int, dict[str, str], bytes], tuple[int, dict[str, str], bytes]]


@dataclass
class Fault:
    """What happens to requests that match, so many times.

    what: a status to refuse with (500, 429, 403), cut, flip (what is sent), flip_answer, slow, unconditional.
    """

    what: str
    method: str
    path: str = ""
    times: int = 1
    code: str = ""

    def fits(self, method: str, path: str) -> bool:
        if self.times <= 0 or method != self.method or not re.search(self.path, path):
            return False
        self.times -= 1
        return True


@dataclass
class Proxy:
    """requests: method, path and body size of all that came."""

    endpoint: str
    faults: list[Fault] = field(default_factory=list)
    requests: list[tuple[str, str, int]] = field(default_factory=list)
    url: str = ""
    before: Callable[[str, str], None] = lambda method, path: None
    change: Change = lambda status, headers, data: (status, headers, data)  # what goes out in place of an answer

    def fault(self, method: str, path: str) -> Fault | None:
        return next((fault for fault in self.faults if fault.fits(method, path)), None)


@contextlib.contextmanager
def running_proxy(endpoint: str) -> Iterator[Proxy]:
    proxy = Proxy(endpoint)
    host = endpoint.removeprefix("http://")

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *args: object) -> None:
            pass

        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            proxy.requests.append((self.command, self.path, len(body)))
            proxy.before(self.command, self.path)
            fault = proxy.fault(self.command, self.path)
            what = fault.what if fault else ""
            if what.isdecimal():
                self._refuse(int(what), fault.code)
                return
            headers = dict(self.headers.items())
            if what == "unconditional":
                headers = {name: value for name, value in headers.items() if not name.lower().startswith("if-")}
            if what == "flip" and body:
                body = bytes([body[0] ^ 1]) + body[1:]
            if what == "slow":
                time.sleep(0.5)
            self._forward(headers, body, what)

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = handle_any  # noqa: N815

        def _refuse(self, status: int, code: str) -> None:
            text = f"<Error><Code>{code or 'Busy'}</Code><Message>no</Message></Error>".encode()
            self.send_response(status)
            if status == 429:
                self.send_header("Retry-After", "7")
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def _forward(self, headers: dict[str, str], body: bytes, what: str) -> None:
            connection = http.client.HTTPConnection(host, timeout=120)
            try:
                connection.request(self.command, self.path, body, headers)
                answer = connection.getresponse()
                data = answer.read()
            finally:
                connection.close()
            status, headers, data = proxy.change(answer.status, dict(answer.getheaders()), data)
            self.send_response(status)
            for name, value in headers.items():
                if name.lower() not in _HOP:
                    self.send_header(name, value)
            length = answer.getheader("Content-Length") if self.command == "HEAD" else str(len(data))
            self.send_header("Content-Length", length or "0")
            self.end_headers()
            if what == "flip_answer" and data:
                data = bytes([data[0] ^ 1]) + data[1:]
            self.wfile.write(data[: len(data) // 2] if what == "cut" else data)
            if what == "cut":
                self.close_connection = True

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    proxy.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield proxy
    finally:
        server.shutdown()
        server.server_close()
