"""moto's S3 on loopback, and a proxy before it that misbehaves as it is told."""

from __future__ import annotations

import contextlib
import http.client
import logging
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import quote

import boto3
from moto.server import ThreadedMotoServer

from .wire import Answer, Fault, Wire

KEY, SECRET = "AKIATESTTESTTESTTEST", "a/secret/that+nobody/must/see"
_HOP = ("connection", "transfer-encoding", "content-length", "date", "server")

Change = Callable[[int, dict[str, str], bytes], tuple[int, dict[str, str], bytes]]


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


def client_of(endpoint: str) -> Any:
    """boto3's client."""
    return boto3.client("s3", endpoint_url=endpoint, aws_access_key_id=KEY, aws_secret_access_key=SECRET)


def refusal(match: str, status: int, code: str = "Busy", times: int = 10**6) -> Fault:
    """A fault that is an error in S3's words."""
    body = f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode()
    return Fault(match, times, status, {"Retry-After": "7"} if status == 429 else {}, body)


class Proxy(Wire):
    """Passes requests on to a store. change: what goes out in place of an answer."""

    cuts_ranges = False  # the store does

    def __init__(self, endpoint: str):
        self._host = endpoint.removeprefix("http://")
        self.drops_conditions = False
        self.before: Callable[[str], object] = lambda line: None  # gets every request's `METHOD /path?query`
        self.change: Change = lambda status, headers, data: (status, headers, data)
        super().__init__()

    def take_fault(self, line: str) -> Fault:
        self.before(line)
        return super().take_fault(line)

    def answer(self, method: str, path: str, query: str, headers: Any, body: bytes) -> Answer:
        line = f"{quote(path)}?{query}" if query else quote(path)
        dropped = "if-" if self.drops_conditions else "connection"
        kept = {name: value for name, value in headers.items() if not name.lower().startswith(dropped)}
        with contextlib.closing(http.client.HTTPConnection(self._host, timeout=120)) as connection:
            connection.request(method, line, body, kept)
            found = connection.getresponse()
            status, changed, data = self.change(found.status, dict(found.getheaders()), found.read())
        given = {key: value for key, value in changed.items() if key.lower() not in _HOP}
        if method == "HEAD":
            given["Content-Length"] = found.getheader("Content-Length") or "0"
        return Answer(status, data, given)


@contextlib.contextmanager
def running_proxy(endpoint: str) -> Iterator[Proxy]:
    with contextlib.closing(Proxy(endpoint)) as proxy:
        yield proxy
