"""The HTTP session that botocore gets from here: every answer has an end, and nothing follows to another address."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, override

import aiohttp
from aiobotocore.httpsession import AIOHTTPSession
from botocore.exceptions import HTTPClientError
from yarl import URL

from manip_il.store.errors import RemoteError
from manip_il.store.pace import LEAST_SPEED, Pace

LARGEST_ANSWER = 2**26  # of anything but an object [bytes]; a list of a thousand objects has half a million
LONGEST_ANSWER = 600.0  # until its headers are there, beside what sending takes at the least speed [s]
MOST_PAGES = 5_000  # of one list, a thousand objects each
_CHUNK = 2**16


class BoundedSession(AIOHTTPSession):
    """As aiobotocore's own, with limits on size and time, and no redirects to other origins.

    Those would be sent the session's token.
    """

    @override
    async def send(self, request: Any) -> Any:
        """Raise `RemoteError` beyond a limit."""
        name = URL(request.url).origin()
        seconds = LONGEST_ANSWER + int(request.headers.get("Content-Length") or 0) / LEAST_SPEED
        is_object, request.stream_output = request.stream_output, True  # else all of any answer would be read there
        try:
            response = await asyncio.wait_for(super().send(request), seconds)
            if not is_object or response.status_code >= 300:
                response._content = await asyncio.wait_for(_read(response.raw, str(name)), LONGEST_ANSWER)
        except HTTPClientError as error:  # into which aiobotocore makes whatever it meets
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
            trace.on_request_redirect.append(_stay)
            trace.freeze()
            session.trace_configs.append(trace)
        return session


async def read_paced(body: Any, size: int, pace: Pace) -> bytes:
    """At most so many bytes more of an object, at no less than the least speed."""
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


async def _stay(session: aiohttp.ClientSession, context: SimpleNamespace, params: aiohttp.TraceRequestRedirectParams):
    before = params.response.url
    after = before.join(URL(params.response.headers.get("Location", "")))
    if after.origin() != before.origin():
        text = f"{before.origin()} redirects to another address, {after.origin()}, which is not followed"
        raise RemoteError(f"{text}; is AWS_ENDPOINT_URL (or the region) right?")
