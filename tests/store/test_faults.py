"""What networks, servers and disks do: another try, or one clear line; nothing half-done is ever seen."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from manip_il.store import file_store
from manip_il.store.errors import (
    AuthError,
    HashError,
    NoSpaceError,
    NotFoundError,
    RemoteError,
    TransientError,
    redact,
    retry_after,
)
from manip_il.store.pull import pull
from manip_il.store.push import push

from .s3 import KEY, SECRET, Fault, Proxy
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


LOGIN = {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": ""}


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        (LOGIN, "not logged in; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"),
        ({"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, r"no answer from http://127\.0\.0\.1:9"),
    ],
    ids=["nobody is logged in", "nobody answers"],
)
def test_an_environment_that_leads_nowhere(
    variables: dict[str, str], words: str, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
        if not value:
            monkeypatch.delenv(name)
    with pytest.raises(AuthError if variables is LOGIN else RemoteError, match=words):
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
    from manip_il.store.folder import scan

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


def test_no_such_host() -> None:
    with pytest.raises(NotFoundError, match=r"there is no host no-such-host\.invalid; check the name"):
        impatient("sftp://no-such-host.invalid/x")[1].read()


def attempts(error: RemoteError, waits: list[float]) -> tuple[str, int]:
    """What work that always fails ends in, and how often it was tried."""
    tries: list[int] = []

    def fail() -> None:
        tries.append(1)
        raise error

    with pytest.raises(RemoteError) as caught:
        no_wait(waits)(fail)
    return str(caught.value), len(tries)


def test_only_what_may_pass_is_tried_again_after_growing_waits_that_end() -> None:
    waits: list[float] = []
    assert attempts(AuthError("no"), waits) == ("no", 1)
    text, tries = attempts(TransientError("busy", after=3600), waits)
    assert (text, tries, waits) == ("busy; the server asks to wait 3600 s: try again then", 1, [])
    text, tries = attempts(TransientError("cut"), waits)
    assert text.startswith("cut; tried 6 times, try again later")
    assert (tries, len(waits)) == (6, 5)
    assert all(wait <= 0.5 * 2**number for number, wait in enumerate(waits))


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
