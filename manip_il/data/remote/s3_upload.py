"""A large file in parts, several at a time; each is compared with what the store says it got."""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from manip_il.data.remote.errors import TransientError
from manip_il.data.remote.remote import Advance

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
    """Whether the store has what was sent; None where its answer cannot tell.

    checksum: base64 of the sha256 that was sent along; a store that encrypts has an ETag of its own, but names it.
    """
    etag = str(answer.get("ETag", "")).strip('"')
    encrypted = answer.get("ServerSideEncryption", "AES256") != "AES256" or "SSECustomerAlgorithm" in answer
    if _MD5.fullmatch(etag) and not encrypted:
        return etag == part.md5
    return True if checksum and answer.get("ChecksumSHA256") == checksum else None


async def send_parts(client: Any, place: Mapping[str, str], source: Path, advance: Advance) -> tuple[bool | None, str]:
    """Upload `source`. Returns as `is_as_sent`, and the sha256 of what was sent: another one than it had is aborted."""
    size = source.stat().st_size
    length = max(PART, -(-size // MOST_PARTS))
    upload = (await client.create_multipart_upload(**place))["UploadId"]
    place = {**place, "UploadId": upload}
    digest, answers, running = hashlib.sha256(), dict[int, bool | None](), set[asyncio.Task[None]]()
    etags: dict[int, str] = {}

    async def send(number: int, data: bytes) -> None:
        answers[number], etags[number] = await _send(client, place, number, data)
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
        if digest.hexdigest() != place["Key"].rpartition("/")[2]:
            raise _Changed
        parts = [{"PartNumber": number, "ETag": etags[number]} for number in sorted(etags)]
        await client.complete_multipart_upload(**place, MultipartUpload={"Parts": parts})
    except BaseException as error:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await client.abort_multipart_upload(**place)
        if isinstance(error, _Changed):
            return None, digest.hexdigest()
        raise
    verified = None if None in answers.values() else all(answers.values())
    return verified, digest.hexdigest()


class _Changed(Exception):
    """The file is not what it was when it was listed."""


async def _send(client: Any, place: Mapping[str, str], number: int, data: bytes) -> tuple[bool | None, str]:
    expected = await asyncio.to_thread(Part.of, data)
    for left in reversed(range(TRIES)):
        try:
            answer = await client.upload_part(**place, PartNumber=number, Body=data)
            if (verified := is_as_sent(answer, expected)) is False:
                raise TransientError("the store has received other bytes than were sent")
            return verified, answer["ETag"]
        except Exception:
            if not left:
                raise
            await asyncio.sleep(0.5 * (TRIES - left))
    raise TransientError("no try was allowed; expected at least one")


def _read(file: BinaryIO, length: int, digest: Any) -> bytes:
    data = file.read(length)
    digest.update(data)
    return data
