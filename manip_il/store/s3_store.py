"""A bucket of any store that speaks S3: `s3://bucket/demos`. Endpoint and keys are those of every other S3 program."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import re
import secrets
from collections.abc import Awaitable, Callable, Generator, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from fsspec.asyn import sync
from s3fs import S3FileSystem

from manip_il.errors import UsageError
from manip_il.store import s3_session
from manip_il.store.blobs import OBJECTS, STALE, Stored
from manip_il.store.errors import AuthError, NotFoundError, RemoteError, TransientError
from manip_il.store.manifest import LONGEST_TEXT
from manip_il.store.object_store import ObjectRemote, in_threads, wrong_when_read
from manip_il.store.pace import Pace
from manip_il.store.remote import MANIFEST_FILE, Advance
from manip_il.store.s3_errors import code_of, explained, status_of
from manip_il.store.s3_session import read_paced
from manip_il.store.s3_upload import Part, abort_old, is_as_sent, send_parts
from manip_il.store.url import RemoteUrl

CHUNK = 2**20  # of what is read at a time, at most [bytes]
MULTIPART = 2**26  # from this size on a file goes in parts [bytes]
TIMEOUTS = {"connect_timeout": 15, "read_timeout": 60}  # [s]
_KEY = re.compile(r"[0-9a-f]{64}")
_IGNORED = "ignores conditional writes: two pushes at once can overwrite each other"

Call = Callable[..., Awaitable[Any]]


def open_s3(url: RemoteUrl) -> ObjectRemote:
    """Return the remote of an `s3://` URL."""
    return ObjectRemote(S3Blobs(url))


class S3Blobs:
    """`Blobs` in a bucket. Two pushes are kept apart by If-Match and If-None-Match, where the store knows them."""

    threads = 8

    def __init__(self, url: RemoteUrl):
        self._name = str(url)
        self._bucket, _, self._prefix = url.place.partition("/")
        self.warnings: tuple[str, ...] = ()
        self._honours: bool | None = None  # conditions; None until it was tried
        self._left: list[str] = []  # what killed pushes left
        # Botocore's and s3fs' own tries are switched off: `Retry` knows what the server asked for.
        config: dict[str, Any] = {**TIMEOUTS, "retries": {"total_max_attempts": 1}, "max_pool_connections": 32}
        config["http_session_cls"] = s3_session.BoundedSession
        config |= {"request_checksum_calculation": "when_required", "response_checksum_validation": "when_required"}
        self._fs = S3FileSystem(config_kwargs=config, skip_instance_cache=True, use_listings_cache=False)

    def describe(self) -> str:
        """Return the URL."""
        return self._name

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and ETag."""
        try:
            return self._run(self._get_manifest, f"read {self._name}")
        except NotFoundError as error:
            if "no bucket" in str(error):
                raise
            return None

    def prepare(self, size: int) -> None:
        """Refuse a place that holds something else; find out whether conditions are honoured."""
        names = self._names()
        if names and not names & {MANIFEST_FILE, f"{OBJECTS}/"}:
            raise UsageError(f"{self._name} holds other files; name an empty folder of the bucket to push to")
        if self._honours is None:
            self._honours = self._try_conditions()
            if not self._honours:
                self.warnings = (*self.warnings, f"the store of {self._name} {_IGNORED}")

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest where it still has the ETag `before`; None where it has not."""
        condition = {"IfMatch": before} if before else {"IfNoneMatch": "*"}
        if not self._honours:
            found = self.manifest()
            if (found[1] if found else None) != before:
                return None
            condition = {}

        async def put(client: Any) -> str | None:
            try:
                place = self._at(MANIFEST_FILE)
                answer = await client.put_object(**place, Body=data, ContentType="application/json", **condition)
            except Exception as error:
                if _is_refused(error) or (before and code_of(error) == "NoSuchKey"):
                    return None
                raise
            if "ETag" not in answer:
                raise RemoteError(f"{self._name}: the store's answer has no ETag; what it stored cannot be told")
            return str(answer["ETag"])

        return self._run(put, f"write to {self._name}")

    def fetch(self, key: str, target: BinaryIO, offset: int) -> None:
        """One GET, from `offset` on."""
        span = {"Range": f"bytes={offset}-"} if offset else {}

        async def copy(client: Any) -> None:
            answer = await client.get_object(**self._at_key(key), **span)
            body = answer["Body"]
            try:
                if offset and answer["ResponseMetadata"]["HTTPStatusCode"] != 206:
                    text = f"{self._name}: the store supports no byte ranges; remove the .pulling folder and pull again"
                    raise RemoteError(text)
                pace = Pace(self._name)
                while chunk := await read_paced(body, CHUNK, pace):
                    target.write(chunk)
            finally:
                body.close()

        self._run(copy, f"read {self._name}")

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Send, and compare what the store says it got; False where it says nothing that can be compared."""
        what = f"write to {self._name}"
        if size >= MULTIPART:
            verified, digest = self._run(lambda client: send_parts(client, self._at_key(key), source, advance), what)
        else:
            data = source.read_bytes()
            part, digest = Part.of(data), hashlib.sha256(data).hexdigest()
            if digest == key:
                checksum = base64.b64encode(bytes.fromhex(key)).decode()
                answer = self._run(
                    lambda client: client.put_object(**self._at_key(key), Body=data, ChecksumSHA256=checksum), what
                )
                verified = is_as_sent(answer, part, checksum)
                advance(size)
            else:
                verified = False
        if digest != key:
            raise RemoteError(f"{source} changed while it was being pushed; push again when nobody writes to it")
        if verified is False:
            raise TransientError(f"{self._name} did not receive the bytes that were sent")
        return verified is True

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Those of `keys` that are there."""

        def one(key: str) -> Stored | None:
            try:
                answer = self._run(lambda client: client.head_object(**self._at_key(key)), f"read {self._name}")
            except NotFoundError:
                return None
            with self._speaking_s3():
                return Stored(int(answer["ContentLength"]), _age(answer["LastModified"], answer))

        return {key: stored for key, stored in in_threads(self.threads, one, keys).items() if stored}

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        found: dict[str, Stored] = {}
        self._left = []
        with self._speaking_s3():
            for answer in self._pages(f"{self._prefix}/{OBJECTS}/"):
                for item in answer.get("Contents", ()):
                    key, age = item["Key"].rpartition("/")[2], _age(item["LastModified"], answer)
                    if _KEY.fullmatch(key):
                        found[key] = Stored(int(item["Size"]), age)
                    elif age > STALE:
                        self._left.append(item["Key"])
        return found

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Those that are not what their name says: read back, as no store tells a sha256 that can be relied on."""
        return wrong_when_read(self, sizes)

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects unless another push has been."""
        found = self.manifest()
        if found is None or found[1] != token:
            return
        doomed, what = [self._at_key(key)["Key"] for key in keys] + self._left, f"remove old files from {self._name}"

        def one(key: str) -> None:
            self._run(lambda client: client.delete_object(Bucket=self._bucket, Key=key), what)

        in_threads(self.threads, one, doomed)
        place = f"{self._prefix}/{OBJECTS}/"
        self._run(lambda client: abort_old(client, self._bucket, place, _is_stale), what)

    def _names(self) -> set[str]:
        try:
            answer = next(iter(self._pages(f"{self._prefix}/", Delimiter="/", MaxKeys=20)))
        except AuthError:
            return set()  # a key may write without seeing what is there
        with self._speaking_s3():
            names = [item["Key"] for item in answer.get("Contents", ())]
            names += [item["Prefix"] for item in answer.get("CommonPrefixes", ())]
            return {name.removeprefix(f"{self._prefix}/") for name in names}

    @contextlib.contextmanager
    def _speaking_s3(self) -> Generator[None]:
        """What an answer lacks, or has of the wrong type, is the store's fault."""
        try:
            yield
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            text = f"{self._name}: the store answered something that S3 does not ({type(error).__name__})"
            raise RemoteError(f"{text}; check AWS_ENDPOINT_URL") from error

    def _pages(self, prefix: str, **more: Any) -> Iterable[Mapping[str, Any]]:
        token: dict[str, str] = {}
        for _ in range(s3_session.MOST_PAGES):
            answer = self._run(
                lambda client, token=token: client.list_objects_v2(Bucket=self._bucket, Prefix=prefix, **more, **token),
                f"list {self._name}",
            )
            yield answer
            if not answer.get("IsTruncated"):
                return
            before, token = token, {"ContinuationToken": answer["NextContinuationToken"]}
            if token == before:
                raise RemoteError(f"cannot list {self._name}: the store goes on from where it was; does it speak S3?")
        raise RemoteError(f"cannot list {self._name}: it has more than {s3_session.MOST_PAGES:,} pages")

    def _try_conditions(self) -> bool:
        """Whether writes that must be refused are: on an object that nobody else knows."""
        place = self._at(f"{OBJECTS}/probe-{secrets.token_hex(8)}")

        async def refused(client: Any, condition: Mapping[str, str]) -> bool:
            try:
                await client.put_object(**place, Body=b"probe", **condition)
            except Exception as error:
                if _is_refused(error):
                    return True
                if code_of(error) in ("NotImplemented", "InvalidArgument", "InvalidRequest") or status_of(error) == 501:
                    return False
                raise
            return False

        async def probe(client: Any) -> bool:
            await client.put_object(**place, Body=b"probe")
            try:
                is_new = await refused(client, {"IfNoneMatch": "*"})
                return is_new and await refused(client, {"IfMatch": f'"{"0" * 32}"'})
            finally:
                await client.delete_object(**place)

        return self._run(probe, f"write to {self._name}")

    async def _get_manifest(self, client: Any) -> tuple[bytes, str]:
        answer = await client.get_object(**self._at(MANIFEST_FILE))
        data = bytearray()
        pace = Pace(self._name)
        while len(data) <= LONGEST_TEXT and (piece := await read_paced(answer["Body"], CHUNK, pace)):
            data += piece
        return bytes(data), str(answer["ETag"])

    def _at(self, name: str) -> dict[str, str]:
        return {"Bucket": self._bucket, "Key": f"{self._prefix}/{name}"}

    def _at_key(self, key: str) -> dict[str, str]:
        return self._at(f"{OBJECTS}/{key[:2]}/{key}")

    def _run(self, work: Call, what: str) -> Any:
        """The result of a coroutine that is given the client; its errors explained."""

        async def run() -> Any:
            await self._fs.set_session()
            return await work(await self._fs.get_s3(self._bucket))

        try:
            return sync(self._fs.loop, run)
        except RemoteError:
            raise
        except Exception as error:
            raise explained(error, what, self._bucket) from None


def _is_refused(error: Exception) -> bool:
    return status_of(error) == 412 or code_of(error) == "PreconditionFailed"


def _is_stale(began: datetime, answer: Mapping[str, Any]) -> bool:
    return _age(began, answer) > STALE


def _age(modified: datetime, answer: Mapping[str, Any]) -> float:
    """Seconds since, by the store's own clock where it tells it."""
    from email.utils import parsedate_to_datetime

    try:
        now = parsedate_to_datetime(answer["ResponseMetadata"]["HTTPHeaders"]["date"])
    except (KeyError, ValueError):
        now = datetime.now(UTC)
    return (now - modified).total_seconds()
