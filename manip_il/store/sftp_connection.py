"""One ssh connection with an sftp channel for each thread, made again when it is cut, and pipelined reads.

It uses paramiko itself: fsspec's wrapper trusts any host key and cannot make a file only where there is none. Reads are
our own, as paramiko's `prefetch` (and `getfo`) sends its requests from a second thread: when the reader overtakes that
one, the rest of the file is read one request at a time and sent twice (3 of 10 reads of 256 MB over loopback), and the
median speed is 0.5 to 0.7 of ours. With requests of 128 kB in place of 32 kB it is as quick; but at the first
answer of a server that sends less, it takes all the others into memory, and reads the file one request at a time.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import socket
import threading
from collections import deque
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, cast

import paramiko
from paramiko.sftp import CMD_DATA, CMD_READ, CMD_STATUS, SFTPError, int64
from paramiko.ssh_exception import NoValidConnectionsError

from manip_il.store.errors import AuthError, NoSpaceError, NotFoundError, RemoteError, TransientError, redact
from manip_il.store.remote import RemoteUrl

Sftp = paramiko.SFTPClient
TIMEOUT = 30.0  # of connecting, and of any one answer [s]
PACKET = 2**16  # largest that is accepted; the default splits an answer of 32 kB [bytes]
_LOGIN = "ssh-add your key, name it in ~/.ssh/config, or put the user name into the URL"
_CUT = (errno.ECONNRESET, errno.EPIPE, errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ECONNABORTED)
REQUEST = 2**17  # of one read, if the server sends as much [bytes]
SMALLEST = 2**15  # of one read, which every server must send [bytes]
PENDING = 2**22  # of all reads without an answer: twice the window of ssh [bytes]


class Connection:
    """Connection to one host, made when it is first needed."""

    def __init__(self, url: RemoteUrl):
        self._url = url
        self._client: paramiko.SSHClient | None = None
        self._idle: list[Sftp] = []
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def sftp(self, what: str) -> Generator[Sftp]:
        """Give a channel to one thread; translate errors inside, and forget a cut connection."""
        channel: Sftp | None = None
        client: paramiko.SSHClient | None = None
        try:
            client, channel = self._take()
            yield channel
        except (RemoteError, OSError, EOFError, paramiko.SSHException) as error:
            ours = error if isinstance(error, RemoteError) else self._translate(error, what)
            if isinstance(ours, TransientError):
                self._forget(client)
            else:
                self._give_back(client, channel)
            raise ours from None
        else:
            self._give_back(client, channel)

    def run(self, command: str, data: bytes, seconds: float) -> str:
        """Return what a command prints that reads `data`; nothing if the other side runs no commands."""
        try:
            with self._lock:
                client = self._connected()
            stdin, stdout, _ = client.exec_command(command, timeout=seconds)
            sender = threading.Thread(target=_feed, args=(stdin, data), daemon=True)
            sender.start()  # else both sides could wait for each other
            return stdout.read().decode(errors="replace")
        except (OSError, EOFError, paramiko.SSHException):
            return ""

    def _take(self) -> tuple[paramiko.SSHClient, Sftp]:
        with self._lock:
            client = self._connected()
            if self._idle:
                return client, self._idle.pop()
            channel = client.open_sftp()
        channel.get_channel().settimeout(TIMEOUT)  # pyright: ignore[reportOptionalMemberAccess]
        return client, channel

    def _give_back(self, client: paramiko.SSHClient | None, channel: Sftp | None) -> None:
        with self._lock:
            if channel is not None and client is self._client:
                self._idle.append(channel)

    def _forget(self, client: paramiko.SSHClient | None) -> None:
        """Close the connection that failed, but not a new one that another thread has made meanwhile."""
        with self._lock:
            transport = self._client.get_transport() if self._client else None
            if client is not self._client and transport is not None and transport.is_active():
                return
            dead, self._client = self._client, None
            self._idle.clear()
        if dead is not None:
            dead.close()

    def _connected(self) -> paramiko.SSHClient:
        if self._client is not None:
            return self._client
        logging.getLogger("paramiko").setLevel(logging.CRITICAL)  # its errors come back to us, in one line
        client = paramiko.SSHClient()
        client.load_system_host_keys()
        client.set_missing_host_key_policy(paramiko.RejectPolicy())
        known = _from_ssh_config(self._url.host)
        port = self._url.port or int(known.get("port", 22))
        client.connect(
            str(known.get("hostname", self._url.host)),
            port,
            self._url.user or known.get("user"),
            self._url.password,
            key_filename=known.get("identityfile"),
            timeout=TIMEOUT,
            banner_timeout=TIMEOUT,
            auth_timeout=TIMEOUT,
            transport_factory=quick_transport,
        )
        if (transport := client.get_transport()) is not None:  # small questions must not wait for each other's answers
            cast("socket.socket", transport.sock).setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        return client

    def _translate(self, error: Exception, what: str) -> RemoteError:
        host, what = self._url.host, f"cannot {what}"
        if isinstance(error, paramiko.BadHostKeyException):
            return AuthError(
                f"{what}: {host} has a different key than in ~/.ssh/known_hosts; make sure that it is {host}"
            )
        if isinstance(error, paramiko.AuthenticationException) or "No authentication methods" in str(error):
            return AuthError(f"{what}: {host} rejected this user's login; {_LOGIN}")
        if "not found in known_hosts" in str(error):
            return AuthError(f"{what}: {host} is not in ~/.ssh/known_hosts; run ssh {host} once, and check its key")
        if isinstance(error, socket.gaierror):
            return NotFoundError(f"{what}: there is no host {host}; check the name")
        if isinstance(error, PermissionError):
            return AuthError(f"{what}: this user has no permission for it; ask its owner, or choose another folder")
        if isinstance(error, FileNotFoundError):
            return NotFoundError(f"{what}: the folder is not there; check the name")
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return NoSpaceError(f"{what}: the disk is full; make room and try again")
        if isinstance(error, NoValidConnectionsError):
            return TransientError(f"{what}: no answer from {host}, port {self._url.port or 22}")
        if isinstance(error, ConnectionError | TimeoutError | EOFError | paramiko.SSHException) or (
            isinstance(error, OSError) and (error.errno in _CUT or "closed" in str(error).lower())
        ):
            return TransientError(f"{what}: the connection was lost")
        text = redact(" ".join(str(error).split())[:200], self._url.password or "")
        if text == "Failure":  # all that SFTP says of a full disk, a quota, a name that is taken
            return NoSpaceError(f"{what}: the server only says 'Failure'; usually its disk or quota is full")
        return RemoteError(f"{what}: {text or type(error).__name__}")


def quick_transport(sock: Any, /, **more: Any) -> paramiko.Transport:
    """Return a transport with the quickest ciphers first, and with one packet for each answer to a read."""
    transport = paramiko.Transport(sock, default_max_packet_size=PACKET, **more)
    options = transport.get_security_options()
    options.ciphers = sorted(options.ciphers, key=lambda name: "gcm" not in name)
    return transport


def _from_ssh_config(host: str) -> paramiko.SSHConfigDict:
    path = Path("~/.ssh/config").expanduser()
    config = paramiko.SSHConfig.from_path(str(path)) if path.is_file() else paramiko.SSHConfig()
    return config.lookup(host)


def _feed(stdin: paramiko.ChannelFile, data: bytes) -> None:
    with contextlib.suppress(OSError, EOFError):
        stdin.write(data)
        stdin.channel.shutdown_write()


def read_ahead(sftp: Sftp, file: paramiko.SFTPFile, offset: int, size: int) -> Iterator[bytes]:
    """Yield the bytes of an open file from `offset` up to `size`, in order; fewer if it ends before.

    One thread sends all requests and takes all answers. Raises what paramiko does.
    """
    reads = _Reads(sftp, file)
    first = reads.wait(reads.request(offset, min(REQUEST, size - offset))) if offset < size else b""
    if not first:
        return
    yield first
    requested, most = offset + len(first), max(len(first), SMALLEST)  # a server that sent less always will
    pending = deque[tuple[int, int, int]]()
    while requested < size or pending:
        while requested < size and len(pending) * most < PENDING:
            length = min(most, size - requested)
            pending.append((reads.request(requested, length), requested, length))
            requested += length
        number, start, length = pending.popleft()
        data = reads.wait(number)
        while len(data) < length:
            rest = reads.wait(reads.request(start + len(data), length - len(data)))
            if not rest:
                yield data
                return
            data += rest
        yield data


class _Reads:
    """Read requests on one file: paramiko calls `_async_response` with each answer that it reads off the channel."""

    def __init__(self, sftp: Sftp, file: paramiko.SFTPFile):
        self._sftp: Any = sftp
        self._handle = file.handle
        self._found: dict[int, bytes | Exception] = {}

    def request(self, offset: int, length: int) -> int:
        """Send one request; return its number."""
        return self._sftp._async_request(self, CMD_READ, self._handle, int64(offset), length)

    def wait(self, number: int) -> bytes:
        """Return the answer to a request; nothing at the end of the file."""
        while number not in self._found:
            self._sftp._read_response()
        found = self._found.pop(number)
        if isinstance(found, EOFError):
            return b""
        if isinstance(found, Exception):
            raise found
        return found

    def _async_response(self, kind: int, message: Any, number: int) -> None:
        if kind == CMD_DATA:
            self._found[number] = message.get_string()
            return
        try:
            if kind == CMD_STATUS:
                self._sftp._convert_status(message)
            raise SFTPError(f"expected data, found a message of kind {kind}")
        except (OSError, EOFError, SFTPError) as error:
            self._found[number] = error
