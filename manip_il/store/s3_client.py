"""The HTTP session for botocore, and its errors in our words.

Every answer has a largest size and a longest time, and no redirect leads to another origin.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
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
    *(
        GONE,
        "InvalidPart",
        "BadDigest",
        "IncompleteBody",
        "XAmzContentSHA256Mismatch",
        "ConditionalRequestConflict",
        "OperationAborted",
    ),
}
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


async def read_paced(body: Any, size: int, pace: Pace) -> bytes:
    """Read at most `size` bytes more of an object, at no less than the least speed."""
    loop = asyncio.get_running_loop()
    started = loop.time()
    data: bytes = await body.read(size)
    pace.add(loop.time() - started, len(data))
    return data


async def _read(raw: aiohttp.ClientResponse, name: str) -> bytes:
    pace, data = Pace(name), bytearray()
    while piece := await read_paced(raw.content, _CHUNK, pace):
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
    response = _response(error)
    return str(cast("Mapping[str, Any]", response.get("Error", {})).get("Code", ""))


def status_of(error: BaseException) -> int:
    """Return the HTTP status of the answer; 0 if no server answered."""
    return int(_metadata(error).get("HTTPStatusCode", 0) or 0)


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
        headers = cast("Mapping[str, str]", _metadata(error).get("HTTPHeaders", {}))
        return TransientError(f"cannot {what}: {code or status}", retry_after(headers.get("retry-after")))
    if code in ("NoSuchKey", "404", "NotFound") or status == 404:
        return NotFoundError(f"cannot {what}: nothing is there; check the name")
    if code in ("AccessDenied", "403", "Forbidden", "AllAccessDisabled") or status == 403:
        text = "this key has no permission for it; ask the bucket's owner, or use a key that has it"
        return AuthError(f"cannot {what}: {text}")
    if name == "EndpointConnectionError" and "Could not connect" in str(error):
        return TransientError(f"cannot {what}: no answer from {_endpoint(error)}; check AWS_ENDPOINT_URL")
    if status == 0 and (isinstance(error, OSError | TimeoutError | EOFError) or _is_cut(error)):
        return TransientError(f"cannot {what}: the connection was lost ({name})")
    return RemoteError(f"cannot {what}: {code or name}: {' '.join(str(error).split())[:300]}")


def _endpoint(error: Exception) -> str:
    keywords = cast("Mapping[str, Any]", getattr(error, "kwargs", {}))
    return str(keywords.get("endpoint_url", "the endpoint")).split("?")[0]


def _is_cut(error: Exception) -> bool:
    """Return whether it is an error of a connection: botocore, aiohttp and urllib3 have classes of their own."""
    names = {base.__name__ for base in type(error).__mro__}
    return bool(
        names & {"HTTPClientError", "ConnectionError", "ClientError", "IncompleteReadError", "ClientPayloadError"}
    )


def _metadata(error: BaseException) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", _response(error).get("ResponseMetadata", {}))


def _response(error: BaseException) -> Mapping[str, Any]:
    response = getattr(error, "response", None)
    return cast("Mapping[str, Any]", response) if isinstance(response, dict) else {}
