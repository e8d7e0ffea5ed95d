"""One ssh connection with as many sftp channels as threads; cut ones are made again.

paramiko itself and not fsspec's wrapper, which takes any host key for the right one and cannot make a file only where
there is none.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import socket
import threading
from collections.abc import Generator
from pathlib import Path
from typing import Any, cast

import paramiko
from paramiko.ssh_exception import NoValidConnectionsError

from manip_il.store.errors import AuthError, NoSpaceError, NotFoundError, RemoteError, TransientError, redact
from manip_il.store.url import RemoteUrl

Sftp = paramiko.SFTPClient
TIMEOUT = 30.0  # of connecting, and of any one answer [s]
PACKET = 2**16  # that is taken; the default splits an answer of 32 kB [bytes]
_ASK = "ssh-add your key, name it in ~/.ssh/config, or put the user name into the URL"


class Connection:
    """Made when it is first needed."""

    def __init__(self, url: RemoteUrl):
        self._url = url
        self._client: paramiko.SSHClient | None = None
        self._idle: list[Sftp] = []
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def sftp(self, what: str) -> Generator[Sftp]:
        """A channel for one thread; errors inside are explained, and a cut connection is forgotten."""
        channel: Sftp | None = None
        client: paramiko.SSHClient | None = None
        try:
            client, channel = self._take()
            yield channel
        except (RemoteError, OSError, EOFError, paramiko.SSHException) as error:
            explained = error if isinstance(error, RemoteError) else self._explained(error, what)
            if isinstance(explained, TransientError):
                self._forget(client)
            else:
                self._give(client, channel)
            raise explained from None
        else:
            self._give(client, channel)

    def answer(self, command: str, data: bytes, seconds: float) -> str:
        """What a command prints that is given `data`; nothing where the other side runs no commands."""
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

    def _give(self, client: paramiko.SSHClient | None, channel: Sftp | None) -> None:
        with self._lock:
            if channel is not None and client is self._client:
                self._idle.append(channel)

    def _forget(self, client: paramiko.SSHClient | None) -> None:
        """Close the connection that failed; not the new one that another thread may have made meanwhile."""
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

    def _explained(self, error: Exception, what: str) -> RemoteError:
        host, what = self._url.host, f"cannot {what}"
        if isinstance(error, paramiko.BadHostKeyException):
            return AuthError(
                f"{what}: {host} has a different key than in ~/.ssh/known_hosts; make sure that it is {host}"
            )
        if isinstance(error, paramiko.AuthenticationException) or "No authentication methods" in str(error):
            return AuthError(f"{what}: {host} rejected this user's login; {_ASK}")
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
        refused = isinstance(error, NoValidConnectionsError)
        if refused:
            return TransientError(f"{what}: no answer from {host}, port {self._url.port or 22}")
        if isinstance(error, ConnectionError | TimeoutError | EOFError | paramiko.SSHException) or (
            isinstance(error, OSError) and (error.errno in _CUT or "closed" in str(error).lower())
        ):
            return TransientError(f"{what}: the connection was lost")
        text = redact(" ".join(str(error).split())[:200], self._url.password or "")
        if text == "Failure":  # all that SFTP says of a full disk, a quota, a name that is taken
            return NoSpaceError(f"{what}: the server only says 'Failure'; usually its disk or quota is full")
        return RemoteError(f"{what}: {text or type(error).__name__}")


_CUT = (errno.ECONNRESET, errno.EPIPE, errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ECONNABORTED)


def quick_transport(sock: Any, /, **more: Any) -> paramiko.Transport:
    """Return the quickest ciphers first, and answers to a read in one packet each."""
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
