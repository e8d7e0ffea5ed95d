"""A file over SFTP from one end to the other, with many reads under way, all asked and answered by one thread.

paramiko's own `prefetch` asks from a second thread. Where the reader catches up with that one, it takes the file for
read, asks for the rest part by part and is sent everything twice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from paramiko import SFTPClient, SFTPFile
from paramiko.sftp import CMD_DATA, CMD_READ, CMD_STATUS, SFTPError, int64

REQUEST = 2**17  # that is asked for at once, where the server sends as much [bytes]
SMALLEST = 2**15  # that every server is to send at once [bytes]
UNDER_WAY = 2**22  # twice what ssh lets be on its way [bytes]


def read_ahead(sftp: SFTPClient, file: SFTPFile, offset: int, size: int) -> Iterator[bytes]:
    """Yield the bytes of an open file from `offset` up to `size`, in order; fewer where it has ended before.

    Raises what paramiko does.
    """
    answers = _Answers(sftp, file)
    first = answers.of(answers.ask(offset, min(REQUEST, size - offset))) if offset < size else b""
    if not first:
        return
    yield first
    asked, most = offset + len(first), max(len(first), SMALLEST)  # a server that sent less always will
    under_way = deque[tuple[int, int, int]]()
    while asked < size or under_way:
        while asked < size and len(under_way) * most < UNDER_WAY:
            length = min(most, size - asked)
            under_way.append((answers.ask(asked, length), asked, length))
            asked += length
        number, start, length = under_way.popleft()
        data = answers.of(number)
        while len(data) < length:
            rest = answers.of(answers.ask(start + len(data), length - len(data)))
            if not rest:
                yield data
                return
            data += rest
        yield data


class _Answers:
    """Takes what paramiko reads off one channel: it calls `_async_response` of whom a question was asked for."""

    def __init__(self, sftp: SFTPClient, file: SFTPFile):
        self._sftp: Any = sftp
        self._handle = file.handle
        self._found: dict[int, bytes | Exception] = {}

    def ask(self, offset: int, length: int) -> int:
        """Send one question; return its number."""
        return self._sftp._async_request(self, CMD_READ, self._handle, int64(offset), length)

    def of(self, number: int) -> bytes:
        """Wait for an answer; nothing at the end of the file."""
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
