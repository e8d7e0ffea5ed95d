"""SFTP: cuts, locks, logins, and reads under way, of which each byte is asked for once."""

from __future__ import annotations

import contextlib
import random
import shutil
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paramiko.sftp import CMD_DATA, CMD_STATUS

from manip_il.store import sftp_connection, sftp_store
from manip_il.store.errors import AuthError, RemoteError
from manip_il.store.pull import pull
from manip_il.store.push import push
from manip_il.store.remote import RemoteUrl
from manip_il.store.sftp_connection import PENDING, REQUEST, Connection, read_ahead
from manip_il.store.sftp_store import SftpBlobs

from .sshd import Sshd
from .trees import content, impatient, make_run, no_wait, unwatched


@pytest.fixture
def at_home(sshd: Sshd, monkeypatch: pytest.MonkeyPatch) -> None:
    """Our key and the server's are known."""
    monkeypatch.setenv("HOME", str(sshd.home))


@contextlib.contextmanager
def relay(port: int, cut_after: list[int]) -> Iterator[int]:
    """A port that leads to another; each connection is cut after so many bytes of the client, the last ones never."""
    server = socket.create_server(("127.0.0.1", 0))

    def pump(source: socket.socket, sink: socket.socket, left: float) -> None:
        with contextlib.suppress(OSError):
            while left > 0 and (data := source.recv(65536)):
                sink.sendall(data)
                left -= len(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = server.accept()
                there = socket.create_connection(("127.0.0.1", port))
                left = cut_after.pop(0) if cut_after else float("inf")
                threading.Thread(target=pump, args=(client, there, left), daemon=True).start()
                threading.Thread(target=pump, args=(there, client, float("inf")), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield server.getsockname()[1]
    finally:
        server.close()


@pytest.mark.slow
def test_sftp_outlives_cuts(sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    shutil.copytree(sshd.home / ".ssh", tmp_path / ".ssh")
    cuts = [200_000, 400_000]
    with relay(sshd.port, cuts) as port:
        known = tmp_path / ".ssh" / "known_hosts"
        known.write_text(known.read_text().replace(f":{sshd.port}", f":{port}"))
        url, remote = impatient(f"sftp://{sshd.user}@127.0.0.1:{port}{tmp_path}/store")
        run = make_run(tmp_path / "run", 1)
        push(run, url, remote, unwatched)
        pull(url, remote, tmp_path / "got", unwatched, retry=no_wait())
    assert cuts == []
    assert content(tmp_path / "got") == content(run)


@pytest.mark.slow
def test_sftp_without_a_shell_reads_back(
    at_home: None, sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, remote = impatient(sshd.url(tmp_path / "store"))
    monkeypatch.setattr(remote.blobs, "_hashed_there", lambda keys: set())
    run = make_run(tmp_path / "run", 1)
    push(run, url, remote, unwatched)
    path = max((tmp_path / "store" / "objects").glob("*/*"), key=lambda path: path.stat().st_size)
    path.write_bytes(b"x" * path.stat().st_size)
    assert remote.blobs.wrong({path.name: 0}) == {path.name}


@pytest.mark.slow
def test_an_sftp_lock_that_a_dead_push_left_is_broken(
    at_home: None, sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sftp_store, "LOCK_STALE", 0.3)
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / sftp_store.LOCK).write_text("dead")
    url, remote = impatient(sshd.url(tmp_path / "store"))
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert not (tmp_path / "store" / sftp_store.LOCK).exists()


@pytest.mark.slow
def test_an_sftp_lock_of_a_living_push_is_respected(
    at_home: None, sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, seconds in {"LOCK_REFRESH": 0.3, "LOCK_STALE": 1.5, "LOCK_WAIT": 2.5}.items():
        monkeypatch.setattr(sftp_store, name, seconds)
    run, (url, remote) = make_run(tmp_path / "run", 1), impatient(sshd.url(tmp_path / "store"))
    blobs = remote.blobs
    assert isinstance(blobs, SftpBlobs)
    blobs.prepare(0)
    with blobs._sftp("x") as sftp, blobs._locked(sftp) as lock:
        with pytest.raises(RemoteError, match=r"another push is updating .*; wait, and push again"):
            push(run, url, impatient(str(url))[1], unwatched)
        assert lock.is_ours()
    push(run, url, remote, unwatched)


@pytest.mark.slow
def test_an_unknown_host_key_is_not_trusted(sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(AuthError, match=r"is not in ~/.ssh/known_hosts; run ssh 127.0.0.1 once"):
        impatient(sshd.url(tmp_path))[1].read()


@pytest.mark.slow
def test_a_wrong_sftp_password_is_never_shown(sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / ".ssh").mkdir()
    shutil.copy(sshd.home / ".ssh" / "known_hosts", tmp_path / ".ssh")
    url, remote = impatient(f"sftp://me:hunter2@127.0.0.1:{sshd.port}/x")
    with pytest.raises(AuthError, match="rejected this user's login") as caught:
        remote.read()
    for text in (str(caught.value), str(url), repr(url), remote.name, repr(remote)):
        assert "hunter2" not in text


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


@pytest.mark.parametrize("most", [2**15, 1000])  # bytes in an answer; SFTP demands 2**15
def test_a_server_that_sends_less_is_asked_for_less_but_not_for_crumbs(most: int) -> None:
    server = Server(bytes(2**19), most=most)
    assert read(server, 0, 2**19) == server.content
    assert server.most_under_way <= PENDING + REQUEST
    assert len(server.asked) < 2 * 2**19 / most
    if most == 2**15:
        assert {length for _, length in server.asked[1:]} == {most}


def test_what_the_server_refuses_is_raised() -> None:
    server = Server(bytes(2**20), broken_at=2 * REQUEST)
    with pytest.raises(PermissionError, match="no"):
        read(server, 0, 2**20)


@pytest.mark.slow
def test_a_channel_is_of_use_after_reads_that_were_given_up(at_home: None, sshd: Sshd, tmp_path: Path) -> None:
    content = random.Random(0).randbytes(3 * PENDING)
    (tmp_path / "file").write_bytes(content)
    connection = Connection(RemoteUrl.parse(sshd.url(tmp_path)))
    with connection.sftp("read it") as sftp:
        with sftp.open(str(tmp_path / "file"), "rb") as file:
            assert content.startswith(next(read_ahead(sftp, file, 0, len(content))))
        with sftp.open(str(tmp_path / "file"), "rb") as file:
            assert b"".join(read_ahead(sftp, file, 1000, len(content))) == content[1000:]
