"""Reads under way: each byte is asked for once, whatever a server sends at once and in whatever order."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paramiko.sftp import CMD_DATA, CMD_STATUS

from manip_il.store import sftp_connection
from manip_il.store.remote import RemoteUrl
from manip_il.store.sftp_connection import PENDING, REQUEST, Connection, read_ahead

from .sshd import Sshd


@dataclass
class Server:
    """What read_ahead uses of an SFTPClient, and a server behind it that answers in an order of its own."""

    content: bytes
    most: int = 2**18
    order: random.Random = field(default_factory=lambda: random.Random(0))
    asked: list[tuple[int, int]] = field(default_factory=list)
    under_way: list[tuple[int, Any]] = field(default_factory=list)
    most_under_way: int = 0
    broken_at: int = -1

    def _async_request(self, who: Any, kind: int, handle: bytes, offset: int, length: int) -> int:
        self.asked.append((int(offset), length))
        self.under_way.append((len(self.asked) - 1, who))
        self.most_under_way = max(self.most_under_way, sum(self.asked[number][1] for number, _ in self.under_way))
        return len(self.asked) - 1

    def _read_response(self) -> None:
        number, who = self.under_way.pop(self.order.randrange(len(self.under_way)))
        offset, length = self.asked[number]
        if offset == self.broken_at:
            who._async_response(CMD_STATUS, PermissionError("no"), number)
            return
        data = self.content[offset : offset + min(length, self.most)]
        kind, message = (CMD_DATA, SimpleNamespace(get_string=lambda: data)) if data else (CMD_STATUS, EOFError())
        who._async_response(kind, message, number)

    def _convert_status(self, message: Exception) -> None:
        raise message


def read(server: Server, offset: int, size: int) -> bytes:
    return b"".join(read_ahead(server, SimpleNamespace(handle=b"h"), offset, size))  # pyright: ignore[reportArgumentType]


@given(data=st.data(), order=st.randoms(use_true_random=False))
def test_any_part_of_any_file_comes_whole(data: st.DataObject, order: random.Random) -> None:
    content = order.randbytes(data.draw(st.integers(0, 3000)))
    offset, size = data.draw(st.integers(0, len(content))), data.draw(st.integers(0, 3500))
    server = Server(content, data.draw(st.integers(1, 200)), order)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sftp_connection, "REQUEST", 100)
        patch.setattr(sftp_connection, "SMALLEST", 25)
        patch.setattr(sftp_connection, "PENDING", 700)
        assert read(server, offset, size) == content[offset:size]
    assert server.most_under_way <= 700 + 100


def test_each_byte_is_asked_for_once() -> None:
    server = Server(bytes(3 * PENDING + 5))
    assert len(read(server, 0, len(server.content))) == len(server.content)
    assert sum(length for _, length in server.asked) == len(server.content)
    assert PENDING <= server.most_under_way <= PENDING + REQUEST


def test_a_server_that_sends_less_is_asked_for_less() -> None:
    server = Server(bytes(2**20), most=2**15)
    assert read(server, 0, 2**20) == server.content
    assert {length for _, length in server.asked[1:]} == {2**15}


def test_a_server_that_trickles_is_not_asked_for_crumbs() -> None:
    server = Server(bytes(2**19), most=1000)
    assert read(server, 0, 2**19) == server.content
    assert server.most_under_way <= PENDING + REQUEST
    assert len(server.asked) < 2 * 2**19 / 1000


def test_what_the_server_refuses_is_raised() -> None:
    server = Server(bytes(2**20), broken_at=2 * REQUEST)
    with pytest.raises(PermissionError, match="no"):
        read(server, 0, 2**20)


@pytest.mark.slow
def test_a_channel_is_of_use_after_reads_that_were_given_up(
    sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(sshd.home))
    content = random.Random(0).randbytes(3 * PENDING)
    (tmp_path / "file").write_bytes(content)
    connection = Connection(RemoteUrl.parse(sshd.url(tmp_path)))
    with connection.sftp("read it") as sftp:
        with sftp.open(str(tmp_path / "file"), "rb") as file:
            assert content.startswith(next(read_ahead(sftp, file, 0, len(content))))
        with sftp.open(str(tmp_path / "file"), "rb") as file:
            assert b"".join(read_ahead(sftp, file, 1000, len(content))) == content[1000:]
