"""A large file in parts, several at a time; each is compared with what the store says it got.

An upload that was cut stays on the store, and the next try goes on with it.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from manip_il.store.errors import TransientError
from manip_il.store.remote import Advance
from manip_il.store.s3_errors import GONE, code_of, status_of
from manip_il.store.s3_session import MOST_PAGES

PART = 2**25  # [bytes]
MOST_PARTS = 9_000  # S3 takes 10,000
AT_ONCE = 4
TRIES = 3  # of one part; the whole file is tried again after that
_MD5 = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Part:
    """What S3 answers with for bytes that it got whole and did not encrypt: their MD5 as ETag."""

    md5: str

    @classmethod
    def of(cls, data: bytes) -> Part:
        """Of some bytes."""
        return cls(hashlib.md5(data, usedforsecurity=False).hexdigest())


def is_as_sent(answer: Mapping[str, Any], part: Part, checksum: str = "") -> bool | None:
    """Return whether the store has what was sent; None where its answer cannot tell.

    checksum: base64 of the sha256 that was sent along; a store that encrypts has an ETag of its own, but names it.
    """
    etag = str(answer.get("ETag", "")).strip('"')
    encrypted = answer.get("ServerSideEncryption", "AES256") != "AES256" or "SSECustomerAlgorithm" in answer
    if _MD5.fullmatch(etag) and not encrypted:
        return etag == part.md5
    return True if checksum and answer.get("ChecksumSHA256") == checksum else None


async def send_parts(client: Any, place: Mapping[str, str], source: Path, advance: Advance) -> tuple[bool | None, str]:
    """Upload `source`. Returns as `is_as_sent`, and the sha256 of what was sent: another one than it had is aborted.

    What a cut or a kill has ended is gone on with: parts that the store has already are not sent again.
    """
    size = source.stat().st_size
    length = max(PART, -(-size // MOST_PARTS))
    upload = await _under_way(client, place)
    is_ours = upload is None
    there = {} if upload is None else await _parts(client, {**place, "UploadId": upload})
    if upload is None:
        upload = str((await client.create_multipart_upload(**place))["UploadId"])
    place = {**place, "UploadId": upload}
    digest, answers, running = hashlib.sha256(), dict[int, bool | None](), set[asyncio.Task[None]]()
    etags: dict[int, str] = {}

    async def send(number: int, data: bytes) -> None:
        part = await asyncio.to_thread(Part.of, data)
        if there.get(number) == (part.md5, len(data)):
            answers[number], etags[number] = True, f'"{part.md5}"'
        else:
            answers[number], etags[number] = await _send(client, place, number, data, part)
        advance(len(data))

    try:
        with source.open("rb") as file:
            for number in range(1, -(-size // length) + 1):
                data = await asyncio.to_thread(_read, file, length, digest)
                if len(running) >= AT_ONCE:
                    done, running = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                    for task in done:
                        task.result()
                running.add(asyncio.create_task(send(number, data)))
        await asyncio.gather(*running)
    except BaseException:  # what has arrived stays, for the next try
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        raise
    if digest.hexdigest() != place["Key"].rpartition("/")[2]:
        if is_ours:  # else it may be the upload of somebody whose file has not changed
            await _abort(client, place)
        return None, digest.hexdigest()
    is_theirs = not await _complete(client, place, etags, size)
    return None if is_theirs or None in answers.values() else all(answers.values()), digest.hexdigest()


async def abort_old(
    client: Any, bucket: str, prefix: str, is_old: Callable[[datetime, Mapping[str, Any]], bool]
) -> None:
    """Abort uploads that nobody will go on with. is_old: of when one began, and the answer that told it."""
    async for item, answer in _uploads(client, bucket, prefix):
        if is_old(item["Initiated"], answer):
            await _abort(client, {"Bucket": bucket, "Key": item["Key"], "UploadId": item["UploadId"]})


async def _uploads(client: Any, bucket: str, prefix: str) -> AsyncIterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Uploads that were begun and not ended, each with the answer that named it."""
    more: dict[str, str] = {}
    for _ in range(MOST_PAGES):
        answer = await _asked(client.list_multipart_uploads, Bucket=bucket, Prefix=prefix, **more)
        for item in answer.get("Uploads", ()):
            if item["Key"].startswith(prefix):  # some stores do not know of prefixes here
                yield item, answer
        more = {name: answer[f"Next{name}"] for name in ("KeyMarker", "UploadIdMarker") if answer.get(f"Next{name}")}
        if not answer.get("IsTruncated") or not more:
            return


async def _under_way(client: Any, place: Mapping[str, str]) -> str | None:
    """The newest upload of this object that was begun and not ended."""
    found = _uploads(client, place["Bucket"], place["Key"])
    uploads = [item async for item, _ in found if item["Key"] == place["Key"]]
    return str(max(uploads, key=lambda item: item["Initiated"])["UploadId"]) if uploads else None


async def _parts(client: Any, place: Mapping[str, str]) -> dict[int, tuple[str, int]]:
    """ETag and size [bytes] of the parts that have arrived, by number."""
    found, more = dict[int, tuple[str, int]](), dict[str, int]()
    for _ in range(MOST_PAGES):
        answer = await _asked(client.list_parts, **place, **more)
        for part in answer.get("Parts", ()):
            found[int(part["PartNumber"])] = str(part["ETag"]).strip('"'), int(part["Size"])
        if not answer.get("IsTruncated"):
            return found
        more = {"PartNumberMarker": int(answer["NextPartNumberMarker"])}
    return found


async def _asked(question: Callable[..., Awaitable[Mapping[str, Any]]], **about: Any) -> Mapping[str, Any]:
    """The answer; an empty one of a store that does not know the question, or does not let this key ask it."""
    try:
        return await question(**about)
    except Exception as error:
        if code_of(error) != "NoSuchBucket" and status_of(error) in (400, 403, 404, 405, 501):
            return {}
        raise


async def _complete(client: Any, place: Mapping[str, str], etags: Mapping[int, str], size: int) -> bool:
    """Make the parts an object. False where it may be of others, who go on with the same upload: it must be read."""
    parts = [{"PartNumber": number, "ETag": etags[number]} for number in sorted(etags)]
    try:
        answer = await client.complete_multipart_upload(**place, MultipartUpload={"Parts": parts})
    except Exception as error:
        if code_of(error) != GONE and status_of(error) < 500:
            raise
        there = await _asked(client.head_object, Bucket=place["Bucket"], Key=place["Key"])
        if there.get("ContentLength") != size:
            raise
        return False
    return str(answer.get("ETag", "")).strip('"') == _etag_of([etags[number] for number in sorted(etags)])


def _etag_of(etags: Sequence[str]) -> str:
    """What S3 calls an object of these parts: the MD5 of their MD5s, and how many they are; empty where encrypted."""
    md5s = [etag.strip('"') for etag in etags]
    if not all(map(_MD5.fullmatch, md5s)):
        return ""
    return f"{Part.of(bytes.fromhex(''.join(md5s))).md5}-{len(md5s)}"


async def _abort(client: Any, place: Mapping[str, str]) -> None:
    try:
        await client.abort_multipart_upload(**place)
    except Exception as error:
        if code_of(error) != GONE:
            raise


async def _send(client: Any, place: Mapping[str, str], number: int, data: bytes, part: Part) -> tuple[bool | None, str]:
    for left in reversed(range(TRIES)):
        try:
            answer = await client.upload_part(**place, PartNumber=number, Body=data)
            if (verified := is_as_sent(answer, part)) is False:
                raise TransientError("the store did not receive the bytes that were sent")
            return verified, answer["ETag"]
        except Exception as error:
            if not left or code_of(error) == GONE:
                raise
            await asyncio.sleep(0.5 * (TRIES - left))
    raise TransientError("no attempts are allowed; expected at least one")


def _read(file: BinaryIO, length: int, digest: Any) -> bytes:
    data = file.read(length)
    digest.update(data)
    return data
