"""What networks, servers and disks do: another try, or one clear line; nothing half-done is ever seen."""

from __future__ import annotations

import errno
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest

from manip_il.store import disk, file_store
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
from manip_il.store.push import push, scan

from .s3 import KEY, SECRET, Proxy, refusal
from .trees import content, impatient, make_run, no_wait, unwatched
from .wire import Fault

PUT_OBJECT, GET_OBJECT = ("^PUT .*/objects/[0-9a-f]{2}/", "^GET .*/objects/[0-9a-f]{2}/")
OUTLIVED = {
    "500 for objects": refusal(PUT_OBJECT, 500, "InternalError", 3),
    "500 for a manifest": refusal("^PUT .*manip_il_manifest", 500, times=2),
    "429 for objects": refusal(PUT_OBJECT, 429, times=2),
    "other bytes arrive": Fault(PUT_OBJECT, corrupt=True),
    "a slow upload": Fault(PUT_OBJECT, pause=0.02),
    "a manifest whose answer is lost": Fault("^PUT .*manip_il_manifest", lost=True),
    "500 for reading a manifest": refusal("^GET .*manip_il_manifest", 500, times=1),
    "500 for an object": refusal(GET_OBJECT, 500, times=1),
    "429 for an object": refusal(GET_OBJECT, 429, times=1),
    "an object that is cut": Fault(GET_OBJECT, cut=300_000),
    "other bytes come": Fault(GET_OBJECT, corrupt=True),
    "a slow download": Fault(GET_OBJECT, pause=0.02),
}


@pytest.mark.parametrize("fault", OUTLIVED.values(), ids=OUTLIVED)
def test_a_push_and_a_pull_outlive(fault: Fault, proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    run, waits = make_run(tmp_path / "run", 1), list[float]()
    proxy.faults = [replace(fault)]
    url, remote = impatient(f"s3://{bucket}/demos", waits)
    push(run, url, remote, unwatched)
    pull(url, remote, tmp_path / "got", unwatched, retry=no_wait(waits))
    assert proxy.faults[0].times == 0
    assert content(tmp_path / "got") == content(run)
    if fault.status == 429:
        assert max(waits) >= 7  # as Retry-After asked


def test_a_store_that_keeps_other_bytes_is_named(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    proxy.faults = [Fault(PUT_OBJECT, 10**6, corrupt=True)]
    url, remote = impatient(f"s3://{bucket}/demos")
    with pytest.raises(RemoteError, match="the bytes that were sent"):
        push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert remote.read() is None


def test_a_remote_with_wrong_bytes_is_named(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    proxy.faults = [Fault(GET_OBJECT, 10**6, corrupt=True)]
    with pytest.raises(HashError, match="does not match the manifest: its hash differs, twice"):
        pull(url, remote, tmp_path / "got", unwatched, retry=no_wait())
    assert not (tmp_path / "got").exists()


def test_a_store_that_ignores_conditions_is_said_to(proxy: Proxy, bucket: str, tmp_path: Path) -> None:
    proxy.drops_conditions = True
    url, remote = impatient(f"s3://{bucket}/demos")
    push(make_run(tmp_path / "run", 1), url, remote, unwatched)
    assert remote.warnings == (
        f"the store of s3://{bucket}/demos ignores conditional writes: two pushes at once can overwrite each other",
    )
    push(make_run(tmp_path / "run2", 2), url, remote, unwatched)


REFUSED = {
    "no right": (refusal("^PUT", 403, "AccessDenied"), AuthError, "has no permission for it; ask the bucket's owner"),
    "wrong key": (refusal("^GET", 403, "InvalidAccessKeyId"), AuthError, "set AWS_ACCESS_KEY_ID and"),
    "full": (refusal(PUT_OBJECT, 507, "XMinioStorageFull"), NoSpaceError, "the store is full"),
    "broken": (refusal(PUT_OBJECT, 500), RemoteError, "tried 6 times, try again later"),
}


@pytest.mark.parametrize(("fault", "kind", "words"), REFUSED.values(), ids=REFUSED)
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


NOWHERE = {
    "no bucket": ("s3://nowhere/x", {}, NotFoundError, "there is no bucket nowhere; make it, or check the name"),
    "no host": ("sftp://no-such.invalid/x", {}, NotFoundError, r"there is no host no-such\.invalid; check the name"),
    "no answer": (
        "s3://bucket/x",
        {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"},
        RemoteError,
        r"from http://127\.0\.0\.1:9",
    ),
    "no login": (
        "s3://bucket/x",
        {"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None},
        AuthError,
        "not logged in; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    ),
}


@pytest.mark.parametrize(("url", "variables", "kind", "words"), NOWHERE.values(), ids=NOWHERE)
def test_what_leads_nowhere_is_named(url, variables, kind, words, bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in variables.items():
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    with pytest.raises(kind, match=words):
        impatient(url)[1].read()


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
    run = make_run(tmp_path / "run", 1)
    _, remote = impatient(place)
    scanned = scan(run, "policy")
    (run / "config.yaml").write_text("# another text")
    with pytest.raises(RemoteError, match="changed while it was being pushed"):
        remote.publish(scanned.local, scanned.manifest, None, lambda _: None)
    assert remote.read() is None


def test_a_file_that_changes_while_a_first_push_copies_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, whole = make_run(tmp_path / "run", 1), file_store.copy_file
    url, remote = impatient(f"file://{tmp_path}/store")

    def copy(source: Path, target: str) -> str:
        key = whole(source, target)
        if source.name == "config.yaml":
            source.write_text(f"# another text, {time.time_ns()}")
        return key

    monkeypatch.setattr(file_store, "copy_file", copy)
    with pytest.raises(RemoteError, match="changed while it was being pushed"):
        push(run, url, remote, unwatched)
    assert remote.read() is None


def test_a_first_push_to_a_folder_reads_every_file_once_and_a_later_one_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, whole, copied = make_run(tmp_path / "run", 1), file_store.copy_file, list[str]()
    count = sum(1 for path in run.rglob("*") if path.is_file() and not path.is_symlink() and "last" not in path.parts)

    def copy(source: Path, target: str) -> str:
        if 0 <= fails_at <= len(copied):
            raise KeyboardInterrupt
        copied.append(source.name)
        return whole(source, target)

    monkeypatch.setattr(file_store, "copy_file", copy)
    monkeypatch.setattr(disk, "hash_file", None)  # which would read it once more
    fails_at = -1
    _, published = push(run, *impatient(f"file://{tmp_path}/store"), unwatched)
    assert published is not None
    assert (len(copied), published.uploaded, published.kept) == (count, count, 0)

    monkeypatch.undo()
    monkeypatch.setattr(file_store, "copy_file", copy)
    copied, fails_at = [], 2
    with pytest.raises(KeyboardInterrupt):
        push(run, *impatient(f"file://{tmp_path}/cut"), unwatched)
    assert impatient(f"file://{tmp_path}/cut")[1].read() is None
    before, fails_at = len(copied), -1
    _, published = push(run, *impatient(f"file://{tmp_path}/cut"), unwatched)
    assert published is not None
    assert published.uploaded + published.kept == count
    assert before >= 2
    assert not set(copied[:before]) & set(copied[before:])


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
        f"the key {SECRET} is not taken",
    ],
)
def test_secrets_are_taken_out_of_any_text(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    for shown in (redact(text), str(RemoteError(text))):
        assert "abcdef0123" not in shown
        assert SECRET not in shown
