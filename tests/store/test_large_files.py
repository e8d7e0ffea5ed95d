"""Files that go to S3 in parts: a cut upload is gone on with, and nobody's upload disturbs another's."""

from __future__ import annotations

import asyncio
import re
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from manip_il.store import s3_store, s3_upload
from manip_il.store.errors import AuthError, RemoteError
from manip_il.store.pull import pull
from manip_il.store.push import push, scan

from .s3 import Proxy, client_of, refusal
from .trees import content, impatient, make_run, unwatched

PART = 5 * 2**20  # the smallest that S3 takes [bytes]
PARTS = 4
PUT = re.compile(r"partNumber=(\d+)")


@pytest.fixture(autouse=True)
def _in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3_store, "MULTIPART", PART)
    monkeypatch.setattr(s3_upload, "PART", PART)
    monkeypatch.setattr(s3_upload, "AT_ONCE", 1)
    monkeypatch.setattr(s3_upload, "TRIES", 1)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """One file of four parts, and small ones."""
    folder = make_run(tmp_path / "run", 1, files=1, size=100)
    data = bytes(range(256)) * (PART // 256)
    (folder / "large.safetensors").write_bytes(b"".join(bytes([n]) + data[1:] for n in range(PARTS - 1)) + b"the last")
    return folder


@pytest.fixture
def client(bucket: str, moto: str) -> Any:
    """Past the proxy."""
    return client_of(moto)


def test_a_cut_upload_is_gone_on_with(proxy: Proxy, bucket: str, client: Any, run: Path, tmp_path: Path) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    proxy.faults = [refusal("^PUT .*partNumber=3", 403, "AccessDenied")]
    with pytest.raises(AuthError):
        push(run, url, remote, unwatched)
    assert _sent(proxy) == [1, 2, 3]
    assert len(client.list_multipart_uploads(Bucket=bucket)["Uploads"]) == 1
    proxy.faults, proxy.log = [], []
    _, published = push(run, url, impatient(str(url))[1], unwatched)
    assert published is not None
    assert _sent(proxy) == [3, 4]
    pull(url, remote, tmp_path / "got", unwatched)
    assert content(tmp_path / "got") == content(run)
    assert "Uploads" not in client.list_multipart_uploads(Bucket=bucket)


def test_parts_with_other_bytes_are_sent_again(proxy: Proxy, bucket: str, client: Any, run: Path) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    key = _key_of(run)
    upload = client.create_multipart_upload(Bucket=bucket, Key=key)["UploadId"]
    whole = (run / "large.safetensors").read_bytes()
    for number, data in [(1, whole[:PART]), (2, b"x" * PART), (7, b"too many")]:
        client.upload_part(Bucket=bucket, Key=key, UploadId=upload, PartNumber=number, Body=data)
    push(run, url, remote, unwatched)
    assert _sent(proxy) == [2, 3, 4]
    assert client.get_object(Bucket=bucket, Key=key)["Body"].read() == whole


@pytest.mark.parametrize("is_told", [True, False])  # moto forgives who completes twice, other stores do not
@pytest.mark.parametrize("theirs", ["whole", "a part", "aborted"])
def test_somebody_else_ends_the_same_upload(
    theirs: str, is_told: bool, proxy: Proxy, bucket: str, client: Any, run: Path
) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    key, done = _key_of(run), list[str]()

    def before(line: str) -> None:
        if not line.startswith("POST") or "uploadId=" not in line or done:
            return
        done.append(line)
        place = {"Bucket": bucket, "Key": key, "UploadId": line.rpartition("uploadId=")[2].split("&")[0]}
        if theirs == "aborted":
            client.abort_multipart_upload(**place)
            return
        parts = client.list_parts(**place)["Parts"][: None if theirs == "whole" else -1]
        named = [{"PartNumber": part["PartNumber"], "ETag": part["ETag"]} for part in parts]
        client.complete_multipart_upload(**place, MultipartUpload={"Parts": named})

    proxy.before = before
    proxy.faults = [refusal("^POST .*uploadId=", 404, "NoSuchUpload", 1)] if is_told else []
    push(run, url, remote, unwatched)
    assert done
    # What they made is taken where it is whole, and replaced where it is not.
    assert sorted(_sent(proxy)) == sorted([1, 2, 3, 4] * (1 if theirs == "whole" else 2))
    assert client.get_object(Bucket=bucket, Key=key)["Body"].read() == (run / "large.safetensors").read_bytes()


@pytest.mark.parametrize(("status", "code"), [(501, "NotImplemented"), (403, "AccessDenied")])
def test_a_store_that_lists_no_uploads_is_sent_all(
    status: int, code: str, proxy: Proxy, bucket: str, run: Path
) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    proxy.faults = [refusal(r"^GET .*\?.*\buploads\b", status, code)]
    push(run, url, remote, unwatched)
    assert proxy.faults[0].times < 10**6
    assert _sent(proxy) == [1, 2, 3, 4]


def test_the_upload_of_a_file_that_changed_is_aborted(bucket: str, client: Any, run: Path) -> None:
    _, remote = impatient(f"s3://{bucket}/demos")
    scanned = scan(run, "policy")
    with (run / "large.safetensors").open("r+b") as file:
        file.write(b"changed")
    with pytest.raises(RemoteError, match="changed while it was being pushed"):
        remote.publish(scanned.local, scanned.manifest, None, lambda _: None)
    assert "Uploads" not in client.list_multipart_uploads(Bucket=bucket)


@pytest.mark.parametrize("is_old", [True, False])
def test_only_uploads_that_were_given_up_are_cleared_away(
    is_old: bool, bucket: str, client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(s3_store, "_age", lambda began, answer: s3_store.STALE + (1 if is_old else -1))
    for key in ("demos/objects/ab/abc", "other/objects/ab/abc"):
        client.create_multipart_upload(Bucket=bucket, Key=key)
    url, remote = impatient(f"s3://{bucket}/demos")
    for seed in (1, 2, 3):  # the third one clears away what the first alone had
        push(make_run(tmp_path / f"run{seed}", seed, files=1, size=10), url, remote, unwatched)
    left = {item["Key"] for item in client.list_multipart_uploads(Bucket=bucket)["Uploads"]}
    assert left == {"other/objects/ab/abc"} | (set() if is_old else {"demos/objects/ab/abc"})
    assert remote.warnings == ()


@pytest.mark.parametrize("names_uploads", [True, False])
def test_uploads_on_every_page_are_cleared_away(names_uploads: bool) -> None:
    aborted: list[str] = []
    uploads: list[dict[str, Any]] = [
        {"Key": f"demos/{n}", "UploadId": f"u{n}", "Initiated": datetime(2000, 1, 1 + n)} for n in range(5)
    ]

    class Paged:
        """Two a page, as stores with thousands do."""

        async def list_multipart_uploads(self, Bucket: str, Prefix: str, KeyMarker: str = "", **_: str):
            rest = [item for item in uploads if item["Key"] > KeyMarker]
            marker = {"NextUploadIdMarker": rest[1]["UploadId"]} if names_uploads and rest[1:] else {}
            more = {"IsTruncated": True, "NextKeyMarker": rest[1]["Key"], **marker} if rest[2:] else {}
            return {"Uploads": rest[:2], **more}

        async def abort_multipart_upload(self, **place: str) -> None:
            aborted.append(place["UploadId"])

    asyncio.run(s3_upload.abort_old(Paged(), "bucket", "demos/", lambda began, answer: began.day != 4))
    assert aborted == ["u0", "u1", "u2", "u4"]


def _sent(proxy: Proxy) -> list[int]:
    """Numbers of the parts that went through the proxy."""
    return [int(found[1]) for one in proxy.requests("^PUT ") if (found := PUT.search(one.query))]


def _key_of(run: Path) -> str:
    sha256 = scan(run, "policy").manifest.by_path["large.safetensors"].sha256
    return f"demos/objects/{sha256[:2]}/{sha256}"
