"""The HTTP session for botocore, and its errors in our words.

Every answer has a largest size and a longest time, and no redirect leads to another origin.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from types import SimpleNamespace
from typing import Any, cast, override

import aiohttp
from aiobotocore.httpsession import AIOHTTPSession
from botocore.exceptions import HTTPClientError
from yarl import URL

from manip_il.store.errors import (
    LEAST_SPEED,
    AuthError,
    NoSpaceError,
    NotFoundError,
    Pace,
    RemoteError,
    TransientError,
    retry_after,
)

LARGEST_ANSWER = 2**26  # of anything but an object [bytes]; a list of a thousand objects has half a million
LONGEST_ANSWER = 600.0  # until its headers are there, beside what sending takes at the least speed [s]
MOST_PAGES = 5_000  # of one list, a thousand objects each
_CHUNK = 2**16
CREDENTIALS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile in ~/.aws"
GONE = "NoSuchUpload"  # another push has completed or aborted it
_FULL = {"XMinioStorageFull", "QuotaExceeded", "InsufficientStorage", "EntityTooLarge", "NotEnoughSpace"}
_BUSY = {
    *("SlowDown", "RequestTimeout", "Throttling", "ThrottlingException", "InternalError", "ServiceUnavailable"),
    *("InvalidPart", "BadDigest", "IncompleteBody", "XAmzContentSHA256Mismatch"),
    *(GONE, "ConditionalRequestConflict", "OperationAborted"),
}
# Botocore, aiohttp and urllib3 have classes of their own for a connection that was cut.
_CUT = {"HTTPClientError", "ConnectionError", "ClientError", "IncompleteReadError", "ClientPayloadError"}
_KEYS = {"InvalidAccessKeyId", "SignatureDoesNotMatch", "ExpiredToken", "InvalidToken", "TokenRefreshRequired"}


class BoundedSession(AIOHTTPSession):
    """Session of aiobotocore with limits on size and time, and without redirects to other origins.

    Those would receive the session's token.
    """

    @override
    async def send(self, request: Any) -> Any:
        """Send a request. Raises `RemoteError` beyond a limit."""
        name = URL(request.url).origin()
        seconds = LONGEST_ANSWER + int(request.headers.get("Content-Length") or 0) / LEAST_SPEED
        is_object, request.stream_output = request.stream_output, True  # else all of an answer would be read in `send`
        try:
            response = await asyncio.wait_for(super().send(request), seconds)
            if not is_object or response.status_code >= 300:
                response._content = await asyncio.wait_for(_read(response.raw, str(name)), LONGEST_ANSWER)
        except HTTPClientError as error:  # aiobotocore makes one of any error
            if isinstance(error.__context__, RemoteError):
                raise error.__context__ from None
            raise
        except TimeoutError as error:
            raise RemoteError(f"{name} took more than {seconds:.0f} s for an answer; try again later") from error
        finally:
            request.stream_output = is_object
        return response

    @override
    async def _get_session(self, proxy_url: Any) -> aiohttp.ClientSession:
        session: aiohttp.ClientSession = await super()._get_session(proxy_url)
        if not session.trace_configs:
            trace = aiohttp.TraceConfig()
            trace.on_request_redirect.append(_refuse_other_origin)
            trace.freeze()
            session.trace_configs.append(trace)
        return session


async def read_paced(body: Any, name: str, size: int) -> AsyncIterator[bytes]:
    """Yield at most `size` bytes of an answer at a time, at no less than the least speed. name: for messages."""
    loop, pace = asyncio.get_running_loop(), Pace(name)
    while True:
        started = loop.time()
        data: bytes = await body.read(size)
        pace.add(loop.time() - started, len(data))
        if not data:
            return
        yield data


async def _read(raw: aiohttp.ClientResponse, name: str) -> bytes:
    data = bytearray()
    async for piece in read_paced(raw.content, name, _CHUNK):
        data += piece
        if len(data) > LARGEST_ANSWER:
            raw.close()
            raise RemoteError(f"{name} answered more than {LARGEST_ANSWER:,} bytes; does it speak S3?")
    return bytes(data)


async def _refuse_other_origin(
    session: aiohttp.ClientSession, context: SimpleNamespace, params: aiohttp.TraceRequestRedirectParams
) -> None:
    before = params.response.url
    after = before.join(URL(params.response.headers.get("Location", "")))
    if after.origin() != before.origin():
        text = f"{before.origin()} redirects to another address, {after.origin()}, which is not followed"
        raise RemoteError(f"{text}; is AWS_ENDPOINT_URL (or the region) right?")


def code_of(error: BaseException) -> str:
    """Return S3's code of an error, or an HTTP status as text; empty if no server answered."""
    return str(_answer(error, "Error").get("Code", ""))


def status_of(error: BaseException) -> int:
    """Return the HTTP status of the answer; 0 if no server answered."""
    return int(_answer(error, "ResponseMetadata").get("HTTPStatusCode", 0) or 0)


def translate(error: Exception, what: str, bucket: str) -> RemoteError:
    """Return botocore's error as one line that says what to do. what: was being done, with the place."""
    name, code, status = type(error).__name__, code_of(error), status_of(error)
    if name in ("NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError", "ProfileNotFound"):
        return AuthError(f"cannot {what}: not logged in; set {CREDENTIALS}")
    if code in _KEYS or status == 401:
        return AuthError(f"cannot {what}: the key is not accepted ({code or status}); set {CREDENTIALS} again")
    if code == "NoSuchBucket":
        return NotFoundError(f"cannot {what}: there is no bucket {bucket}; make it, or check the name and the endpoint")
    if code in _FULL or status == 507:
        return NoSpaceError(f"cannot {what}: the store is full ({code or status}); make room there and try again")
    if code in _BUSY or status in (408, 409, 429) or status >= 500:
        headers: Mapping[str, str] = _answer(error, "ResponseMetadata").get("HTTPHeaders", {})
        return TransientError(f"cannot {what}: {code or status}", retry_after(headers.get("retry-after")))
    if code in ("NoSuchKey", "404", "NotFound") or status == 404:
        return NotFoundError(f"cannot {what}: nothing is there; check the name")
    if code in ("AccessDenied", "403", "Forbidden", "AllAccessDisabled") or status == 403:
        text = "this key has no permission for it; ask the bucket's owner, or use a key that has it"
        return AuthError(f"cannot {what}: {text}")
    if name == "EndpointConnectionError" and "Could not connect" in str(error):
        endpoint = str(getattr(error, "kwargs", {}).get("endpoint_url", "the endpoint")).split("?")[0]
        return TransientError(f"cannot {what}: no answer from {endpoint}; check AWS_ENDPOINT_URL")
    is_cut = any(base.__name__ in _CUT for base in type(error).__mro__)
    if status == 0 and (is_cut or isinstance(error, OSError | EOFError)):
        return TransientError(f"cannot {what}: the connection was lost ({name})")
    return RemoteError(f"cannot {what}: {code or name}: {' '.join(str(error).split())[:300]}")


def _answer(error: BaseException, part: str) -> Mapping[str, Any]:
    """Return a part of the answer that botocore made an error of; empty if no server answered."""
    response = getattr(error, "response", None)
    return cast("Mapping[str, Any]", response).get(part, {}) if isinstance(response, dict) else {}
