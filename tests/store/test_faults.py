"""What networks, servers and disks do: another try, or one clear line; nothing half-done is ever seen."""

from __future__ import annotations

import contextlib
import errno
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from manip_il.store import file_store, sftp_store
from manip_il.store.errors import (
    AuthError,
    HashError,
    NoSpaceError,
    NotFoundError,
    RemoteError,
    Retry,
    TransientError,
    redact,
    retry_after,
)
from manip_il.store.pull import pull
from manip_il.store.push import push
from manip_il.store.sftp_store import SftpBlobs

from .s3 import KEY, SECRET, Fault, Proxy
from .sshd import Sshd
from .trees import content, impatient, make_run, no_wait, unwatched

OBJECT, MANIFEST = "/objects/[0-9a-f]{2}/", "manip_il_manifest"


@pytest.mark.parametrize(
    "fault",
    [
        Fault("500", "PUT", OBJECT, 3, "InternalError"),
        Fault("500", "PUT", MANIFEST, 2),
        Fault("429", "PUT", OBJECT, 2),
        Fault("flip", "PUT", OBJECT, 1),
        Fault("slow", "PUT", OBJECT, 1),
        Fault("500", "GET", MANIFEST, 1),
        Fault("cut", "PUT", MANIFEST, 1),
    ],
    ids=lambda fault: f"{fault.what}-{fault.method}-{fault.path[:4]}",
)
def test_a_push_outlives_it(fault: Fault, proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    run, waits = make_run(tmp_path / "run", 1), list[float]()
    proxy.faults = [fault]
    url, remote = impatient(f"s3://{bucket}/demos", waits)
    push(run, url, remote, unwatched)
    assert proxy.faults[0].times == 0
    pull(url, remote, tmp_path / "got", unwatched, retry=no_wait())
    assert content(tmp_path / "got") == content(run)
    if fault.what == "429":
        assert max(waits) >= 7  # as Retry-After asked


@pytest.mark.parametrize("what", ["500", "429", "cut", "flip_answer", "slow"])
def test_a_pull_outlives_it(what: str, proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    run, waits = make_run(tmp_path / "run", 1), list[float]()
    url, remote = impatient(f"s3://{bucket}/demos")
    push(run, url, remote, unwatched)
    proxy.faults = [Fault(what, "GET", OBJECT, 1)]
    pull(url, remote, tmp_path / "got", unwatched, retry=no_wait(waits))
    assert proxy.faults[0].times == 0
    assert content(tmp_path / "got") == content(run)
    if what == "429":
        assert max(waits) >= 7


def test_a_store_that_keeps_other_bytes_is_named(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    proxy.faults = [Fault("flip", "PUT", OBJECT, 10**6)]
    url, remote = impatient(f"s3://{bucket}/demos")
    with pytest.raises(RemoteError, match="the bytes that were sent"):
        push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert remote.read() is None


def test_a_remote_with_wrong_bytes_is_named(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    proxy.faults = [Fault("flip_answer", "GET", OBJECT, 10**6)]
    with pytest.raises(HashError, match="does not match the manifest: its hash differs, twice"):
        pull(url, remote, tmp_path / "got", unwatched, retry=no_wait())
    assert not (tmp_path / "got").exists()


def test_a_store_that_ignores_conditions_is_said_to(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    proxy.faults = [Fault("unconditional", "PUT", "", 10**6)]
    url, remote = impatient(f"s3://{bucket}/demos")
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert remote.warnings == (
        f"the store of s3://{bucket}/demos ignores conditional writes: two pushes at once can overwrite each other",
    )
    push(make_run(tmp_path / "run2", 2), url, remote, unwatched)


@pytest.mark.parametrize(
    ("fault", "kind", "words"),
    [
        (Fault("403", "PUT", "", 10**6, "AccessDenied"), AuthError, "has no permission for it; ask the bucket's owner"),
        (Fault("403", "GET", "", 10**6, "InvalidAccessKeyId"), AuthError, "set AWS_ACCESS_KEY_ID and"),
        (Fault("507", "PUT", OBJECT, 10**6, "XMinioStorageFull"), NoSpaceError, "the store is full"),
        (Fault("500", "PUT", OBJECT, 10**6), RemoteError, "tried 6 times, try again later"),
    ],
    ids=["no right", "wrong key", "full", "broken"],
)
def test_what_s3_refuses_is_one_clear_line(
    fault: Fault, kind: type[RemoteError], words: str, proxy: Proxy, bucket: str, tmp_path: Path
) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    proxy.faults = [fault]
    with pytest.raises(kind, match=words) as caught:
        push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert "\n" not in str(caught.value)
    assert KEY not in str(caught.value)
    assert SECRET not in str(caught.value)


def test_no_such_bucket(bucket: str, tmp_path: Path) -> None:
    url, remote = impatient("s3://no-such-bucket/demos")
    for work in (lambda: push(make_run(tmp_path / "run", 1), url, remote, unwatched), remote.read):
        with pytest.raises(NotFoundError, match="there is no bucket no-such-bucket; make it, or check the name"):
            work()


def test_nobody_is_logged_in(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(AuthError, match="not logged in; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"):
        impatient(f"s3://{bucket}/demos")[1].read()


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch, bucket: str) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(RemoteError, match=r"no answer from http://127\.0\.0\.1:9"):
        impatient(f"s3://{bucket}/demos")[1].read()


def test_nothing_there(place: str, tmp_path: Path) -> None:
    url, remote = impatient(place)
    with pytest.raises(NotFoundError, match=r"holds nothing that can be pulled.*check the name"):
        pull(url, remote, tmp_path / "got", unwatched)


def test_a_full_disk_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url, remote = impatient(f"file://{tmp_path}/store")
    run = make_run(tmp_path / "run", 1)
    free = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free._replace(free=1000))
    with pytest.raises(NoSpaceError, match=r"1,000 bytes left, 840,\d+ are to be uploaded; make room"):
        push(run, url, remote, unwatched)
    monkeypatch.undo()
    push(run, url, remote, unwatched)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free._replace(free=1000))
    with pytest.raises(NoSpaceError, match=r"1,000 bytes left, 840,\d+ are to be pulled; make room"):
        pull(url, remote, tmp_path / "got", unwatched)
    assert not (tmp_path / "got").exists()


def test_a_disk_that_fills_up_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url, remote = impatient(f"file://{tmp_path}/store")
    run = make_run(tmp_path / "run", 1)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(file_store, "copy_file", full)
    with pytest.raises(NoSpaceError, match="the disk is full; make room there and push again"):
        push(run, url, remote, unwatched)
    monkeypatch.undo()
    assert remote.read() is None
    push(run, url, remote, unwatched)
    pull(url, remote, tmp_path / "got", unwatched)
    assert content(tmp_path / "got") == content(run)


def test_an_object_that_is_gone_is_named(tmp_path: Path) -> None:
    url, remote = impatient(f"file://{tmp_path}/store")
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    keys = sorted(remote.read().manifest.keys)
    (tmp_path / "store" / "objects" / keys[0][:2] / keys[0]).unlink()
    assert remote.blobs.wrong(dict.fromkeys(keys, 0)) == {keys[0]}


def test_a_file_that_changes_while_it_is_pushed(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from manip_il.store.push import scan

    run = make_run(tmp_path / "run", 1)
    _, remote = impatient(place)
    scanned = scan(run, "policy")
    (run / "config.yaml").write_text("# another text")
    with pytest.raises(RemoteError, match="changed while it was being pushed"):
        remote.publish(scanned.local, scanned.manifest, None, lambda _: None)
    assert remote.read() is None


def test_a_pull_goes_on_from_where_it_was_cut(tmp_path: Path) -> None:
    url, remote = impatient(f"file://{tmp_path}/store")
    run = make_run(tmp_path / "run", 1)
    push(run, url, remote, unwatched)
    largest = max(remote.read().manifest.files, key=lambda entry: entry.size).sha256
    whole, offsets = remote.blobs.fetch, list[int]()

    def cut(key, target, offset):
        if key != largest:  # which of the others comes before it depends on the threads
            return whole(key, target, offset)
        offsets.append(offset)
        if len(offsets) > 1:
            return whole(key, target, offset)
        whole(key, _Short(target, 300_000), offset)
        raise TransientError("cut")

    remote.blobs.fetch = cut
    pull(url, remote, tmp_path / "got", unwatched, retry=no_wait())
    assert offsets == [0, 300_000]
    assert content(tmp_path / "got") == content(run)


class _Short:
    """Takes so many bytes and drops the rest."""

    def __init__(self, target, count: int):
        self.target, self.left = target, count

    def write(self, data: bytes) -> None:
        self.target.write(data[: self.left])
        self.left -= min(self.left, len(data))


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
def test_sftp_without_a_shell_reads_back(sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(sshd.home))
    url, remote = impatient(sshd.url(tmp_path / "store"))
    monkeypatch.setattr(remote.blobs, "_hashed_there", lambda keys: set())
    run = make_run(tmp_path / "run", 1)
    push(run, url, remote, unwatched)
    path = max((tmp_path / "store" / "objects").glob("*/*"), key=lambda path: path.stat().st_size)
    path.write_bytes(b"x" * path.stat().st_size)
    assert remote.blobs.wrong({path.name: 0}) == {path.name}


@pytest.mark.slow
def test_an_sftp_store_that_a_dead_push_left_is_broken(
    sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(sshd.home))
    monkeypatch.setattr(sftp_store, "LOCK_STALE", 0.3)
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / sftp_store.LOCK).write_text("dead")
    url, remote = impatient(sshd.url(tmp_path / "store"))
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert not (tmp_path / "store" / sftp_store.LOCK).exists()


@pytest.mark.slow
def test_an_sftp_store_of_a_living_push_is_respected(
    sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(sshd.home))
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


def test_no_such_host() -> None:
    with pytest.raises(NotFoundError, match=r"there is no host no-such-host\.invalid; check the name"):
        impatient("sftp://no-such-host.invalid/x")[1].read()


def test_waits_grow_and_are_drawn_and_end() -> None:
    waits: list[float] = []

    def broken() -> None:
        raise TransientError("cut")

    with pytest.raises(RemoteError, match="cut; tried 6 times, try again later"):
        no_wait(waits)(broken)
    assert len(waits) == 5
    assert all(wait <= 0.5 * 2**number for number, wait in enumerate(waits))


def test_a_server_that_asks_for_too_much_is_not_waited_for() -> None:
    def busy() -> None:
        raise TransientError("busy", after=3600)

    with pytest.raises(RemoteError, match="the server asks to wait 3600 s: try again then"):
        Retry(sleep=lambda _: pytest.fail("waited"))(busy)


def test_what_is_not_worth_a_try_is_not_tried_again() -> None:
    tries: list[int] = []

    def refused() -> None:
        tries.append(1)
        raise AuthError("no")

    with pytest.raises(AuthError):
        no_wait()(refused)
    assert len(tries) == 1


def test_retry_after_is_read_as_seconds_or_date() -> None:
    assert retry_after("12") == 12
    assert retry_after("Mon, 01 Jan 2001 00:00:00 GMT") == 0
    assert retry_after("soon") is None
    assert retry_after(None) is None


@pytest.mark.parametrize(
    "text",
    [
        "https://h/x?X-Amz-Signature=abcdef0123&y=1",
        "Authorization: Bearer abcdef0123",
        "sftp://me:abcdef0123@h/x",
        "token hf_abcdef0123 is bad",
    ],
)
def test_secrets_are_taken_out_of_any_text(text: str) -> None:
    assert "abcdef0123" not in redact(text)
    assert "abcdef0123" not in str(RemoteError(text))


def test_keys_of_the_environment_are_taken_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    assert SECRET not in str(RemoteError(f"the key {SECRET} is not taken"))
