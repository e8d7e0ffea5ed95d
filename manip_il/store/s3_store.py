"""Objects in a bucket of any S3 store: `s3://bucket/demos`, with the endpoint and keys of every other S3 program."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import re
import secrets
from collections.abc import Awaitable, Callable, Generator, Iterable, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

from fsspec.asyn import sync
from s3fs import S3FileSystem

from manip_il.errors import UsageError
from manip_il.store import s3_client
from manip_il.store.errors import AuthError, NotFoundError, RemoteError, TransientError
from manip_il.store.manifest import LONGEST_TEXT
from manip_il.store.object_store import OBJECTS, STALE, Stored, in_threads, wrong_when_read
from manip_il.store.remote import MANIFEST_FILE, Advance, RemoteUrl, Sink
from manip_il.store.s3_client import code_of, read_paced, status_of, translate
from manip_il.store.s3_upload import abort_old, is_as_sent, md5_of, send_parts

CHUNK = 2**20  # of what is read at a time, at most [bytes]
MULTIPART = 2**26  # from this size on a file goes in parts [bytes]
TIMEOUTS = {"connect_timeout": 15, "read_timeout": 60}  # [s]
_KEY = re.compile(r"[0-9a-f]{64}")
_IGNORED = "ignores conditional writes: two pushes at once can overwrite each other"

Call = Callable[..., Awaitable[Any]]


class S3Blobs:
    """`Blobs` in a bucket. Two pushes are kept apart by If-Match and If-None-Match, if the store honours them."""

    threads = 8

    def __init__(self, url: RemoteUrl):
        self.name = str(url)
        self._bucket, _, self._prefix = url.place.partition("/")
        self.warnings: tuple[str, ...] = ()
        self._honours_conditions: bool | None = None  # None until it was tried
        self._left: list[str] = []  # keys that killed pushes left
        # Botocore's and s3fs' own retries are switched off: `Retry` waits as the server asks.
        config: dict[str, Any] = {**TIMEOUTS, "retries": {"total_max_attempts": 1}, "max_pool_connections": 32}
        config["http_session_cls"] = s3_client.BoundedSession
        config |= {"request_checksum_calculation": "when_required", "response_checksum_validation": "when_required"}
        self._fs = S3FileSystem(config_kwargs=config, skip_instance_cache=True, use_listings_cache=False)

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and ETag."""
        try:
            return self._run(self._get_manifest, f"read {self.name}")
        except NotFoundError as error:
            if "no bucket" in str(error):
                raise
            return None

    def prepare(self, size: int) -> None:
        """Refuse a place that holds something else; find out whether conditions are honoured."""
        names = self._names()
        if names and not names & {MANIFEST_FILE, f"{OBJECTS}/"}:
            raise UsageError(f"{self.name} holds other files; name an empty folder of the bucket to push to")
        if self._honours_conditions is None:
            self._honours_conditions = self._try_conditions()
            if not self._honours_conditions:
                self.warnings = (*self.warnings, f"the store of {self.name} {_IGNORED}")

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest if it still has the ETag `before`, and return its own; else None."""
        condition = {"IfMatch": before} if before else {"IfNoneMatch": "*"}
        if not self._honours_conditions:
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
                raise RemoteError(f"{self.name}: the store's answer has no ETag; what it stored cannot be told")
            return str(answer["ETag"])

        return self._run(put, f"write to {self.name}")

    def fetch(self, key: str, target: Sink, offset: int) -> None:
        """Read an object from `offset` on, by one GET."""
        span = {"Range": f"bytes={offset}-"} if offset else {}

        async def copy(client: Any) -> None:
            answer = await client.get_object(**self._object(key), **span)
            body = answer["Body"]
            try:
                if offset and answer["ResponseMetadata"]["HTTPStatusCode"] != 206:
                    text = f"{self.name}: the store supports no byte ranges; remove the .pulling folder and pull again"
                    raise RemoteError(text)
                async for chunk in read_paced(body, self.name, CHUNK):
                    target.write(chunk)
            finally:
                body.close()

        self._run(copy, f"read {self.name}")

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Send a file and compare what the store says it received; return False if it says nothing comparable."""
        what, place = f"write to {self.name}", self._object(key)
        if size >= MULTIPART:
            verified, digest = self._run(lambda client: send_parts(client, place, source, advance), what)
        else:
            data = source.read_bytes()
            verified, digest = False, hashlib.sha256(data).hexdigest()
            if digest == key:
                checksum = base64.b64encode(bytes.fromhex(key)).decode()
                answer = self._run(lambda client: client.put_object(**place, Body=data, ChecksumSHA256=checksum), what)
                verified = is_as_sent(answer, md5_of(data), checksum)
                advance(size)
        if digest != key:
            raise RemoteError(f"{source} changed while it was being pushed; push again when nobody writes to it")
        if verified is False:
            raise TransientError(f"{self.name} did not receive the bytes that were sent")
        return verified is True

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Return those of `keys` that are there."""

        def one(key: str) -> Stored | None:
            try:
                answer = self._run(lambda client: client.head_object(**self._object(key)), f"read {self.name}")
            except NotFoundError:
                return None
            with self._checked():
                return Stored(int(answer["ContentLength"]), _age(answer["LastModified"], answer))

        return {key: stored for key, stored in in_threads(self.threads, one, keys).items() if stored}

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        found: dict[str, Stored] = {}
        self._left = []
        with self._checked():
            for answer in self._pages(f"{self._prefix}/{OBJECTS}/"):
                for item in answer.get("Contents", ()):
                    key, age = item["Key"].rpartition("/")[2], _age(item["LastModified"], answer)
                    if _KEY.fullmatch(key):
                        found[key] = Stored(int(item["Size"]), age)
                    elif age > STALE:
                        self._left.append(item["Key"])
        return found

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Return those that have other bytes: read back, as no store reports a reliable sha256."""
        return wrong_when_read(self, sizes)

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects unless another push has been."""
        found = self.manifest()
        if found is None or found[1] != token:
            return
        doomed, what = [self._object(key)["Key"] for key in keys] + self._left, f"remove old files from {self.name}"

        def one(key: str) -> None:
            self._run(lambda client: client.delete_object(Bucket=self._bucket, Key=key), what)

        in_threads(self.threads, one, doomed)
        place = f"{self._prefix}/{OBJECTS}/"
        self._run(lambda client: abort_old(client, self._bucket, place, lambda *began: _age(*began) > STALE), what)

    def _names(self) -> set[str]:
        try:
            answer = next(iter(self._pages(f"{self._prefix}/", Delimiter="/", MaxKeys=20)))
        except AuthError:
            return set()  # a key may write without seeing what is there
        with self._checked():
            names = [item["Key"] for item in answer.get("Contents", ())]
            names += [item["Prefix"] for item in answer.get("CommonPrefixes", ())]
            return {name.removeprefix(f"{self._prefix}/") for name in names}

    @contextlib.contextmanager
    def _checked(self) -> Generator[None]:
        """Raise `RemoteError` if an answer lacks something or has it of the wrong type."""
        try:
            yield
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            text = f"{self.name}: the store answered something that S3 does not ({type(error).__name__})"
            raise RemoteError(f"{text}; check AWS_ENDPOINT_URL") from error

    def _pages(self, prefix: str, **more: Any) -> Iterable[Mapping[str, Any]]:
        token: dict[str, str] = {}
        for _ in range(s3_client.MOST_PAGES):
            answer = self._run(
                lambda client, token=token: client.list_objects_v2(Bucket=self._bucket, Prefix=prefix, **more, **token),
                f"list {self.name}",
            )
            yield answer
            if not answer.get("IsTruncated"):
                return
            before, token = token, {"ContinuationToken": answer["NextContinuationToken"]}
            if token == before:
                raise RemoteError(f"cannot list {self.name}: the store goes on from where it was; does it speak S3?")
        raise RemoteError(f"cannot list {self.name}: it has more than {s3_client.MOST_PAGES:,} pages")

    def _try_conditions(self) -> bool:
        """Return whether conditional writes are refused when they must be, by trying them on an object of our own."""
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

        return self._run(probe, f"write to {self.name}")

    async def _get_manifest(self, client: Any) -> tuple[bytes, str]:
        answer = await client.get_object(**self._at(MANIFEST_FILE))
        data = bytearray()
        async for piece in read_paced(answer["Body"], self.name, CHUNK):
            data += piece
            if len(data) > LONGEST_TEXT:
                break
        return bytes(data), str(answer["ETag"])

    def _at(self, name: str) -> dict[str, str]:
        return {"Bucket": self._bucket, "Key": f"{self._prefix}/{name}"}

    def _object(self, key: str) -> dict[str, str]:
        return self._at(f"{OBJECTS}/{key[:2]}/{key}")

    def _run(self, work: Call, what: str) -> Any:
        """Return the result of a coroutine that gets the client; raise its errors as ours."""

        async def run() -> Any:
            await self._fs.set_session()
            return await work(await self._fs.get_s3(self._bucket))

        try:
            return sync(self._fs.loop, run)
        except RemoteError:
            raise
        except Exception as error:
            raise translate(error, what, self._bucket) from None


def _is_refused(error: Exception) -> bool:
    return status_of(error) == 412 or code_of(error) == "PreconditionFailed"


def _age(modified: datetime, answer: Mapping[str, Any]) -> float:
    """Return the time since `modified` [s], by the store's own clock if it sends it."""
    try:
        now = parsedate_to_datetime(answer["ResponseMetadata"]["HTTPHeaders"]["date"])
    except (KeyError, ValueError):
        now = datetime.now(UTC)
    return (now - modified).total_seconds()
