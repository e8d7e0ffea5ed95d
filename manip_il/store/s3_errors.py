"""What botocore raises, as errors that say what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from manip_il.store.errors import AuthError, NoSpaceError, NotFoundError, RemoteError, TransientError
from manip_il.store.retry import retry_after

CREDENTIALS = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile in ~/.aws"
GONE = "NoSuchUpload"  # somebody else has completed or aborted it
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


def code_of(error: BaseException) -> str:
    """Return S3's word for what went wrong, or an HTTP status as text; empty where no server answered."""
    response = _response(error)
    return str(cast("Mapping[str, Any]", response.get("Error", {})).get("Code", ""))


def status_of(error: BaseException) -> int:
    """Return HTTP status of the answer; 0 where no server answered."""
    return int(_metadata(error).get("HTTPStatusCode", 0) or 0)


def explained(error: Exception, what: str, bucket: str) -> RemoteError:
    """Return one line that says what to do. what: what was being done, with the place."""
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
    """Botocore's, aiohttp's and urllib3's errors of a connection; by module, as each has a family of its own."""
    names = {base.__name__ for base in type(error).__mro__}
    return bool(
        names & {"HTTPClientError", "ConnectionError", "ClientError", "IncompleteReadError", "ClientPayloadError"}
    )


def _metadata(error: BaseException) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", _response(error).get("ResponseMetadata", {}))


def _response(error: BaseException) -> Mapping[str, Any]:
    response = getattr(error, "response", None)
    return cast("Mapping[str, Any]", response) if isinstance(response, dict) else {}
