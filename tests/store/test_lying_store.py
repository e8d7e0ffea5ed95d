"""A store that says it speaks S3, and does not: one line, within a time, and its user's token goes nowhere else."""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path
from typing import Any

import pytest

from manip_il.store import errors, s3_client
from manip_il.store.errors import RemoteError
from manip_il.store.remote import RemoteUrl
from manip_il.store.s3_store import S3Blobs

from .liar import Liar, a_liar, answer, drip, drip_headers, endless, error_of_pull
from .trees import wait_little

TOKEN = "TheTokenOfASessionIsASecretToo"
KEY = "0" * 64


@pytest.fixture(autouse=True)
def _somebody(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_little(monkeypatch, tries=2)
    given = {"ACCESS_KEY_ID": "somebody", "SECRET_ACCESS_KEY": "a-secret-access-key", "SESSION_TOKEN": TOKEN}
    for name, value in (given | {"DEFAULT_REGION": "us-east-1"}).items():
        monkeypatch.setenv(f"AWS_{name}", value)


def pulled(store: Liar, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setenv("AWS_ENDPOINT_URL", store.url)
    return error_of_pull("s3://bucket/demos", folder, capsys, TOKEN)


ENDLESS = {
    "an object, bit by bit": (drip, "expected at least 1,000 bytes a second"),
    "an error": (
        lambda _: endless(b"<a>" * 10_000, "500 Never", Content_Type="application/xml"),
        "answered more than 200,000 bytes",
    ),
    "headers, bit by bit": (drip_headers, "took more than 1 s for an answer"),
}


@pytest.mark.parametrize(("script", "says"), ENDLESS.values(), ids=ENDLESS)
def test_what_has_no_end_ends_in_one_line(script, says, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(s3_client, "LARGEST_ANSWER", 200_000)
    monkeypatch.setattr(errors, "WINDOW", 0.2)
    if script is drip_headers:
        monkeypatch.setattr(s3_client, "LONGEST_ANSWER", 1.0)
    with a_liar(script) as store:
        assert says in pulled(store, tmp_path, monkeypatch, capsys)


def test_nothing_is_followed_to_another_address(tmp_path, monkeypatch, capsys) -> None:
    with a_liar(lambda _: answer(b"{}")) as thief:
        place = f"{thief.url}/bucket/x"
        with a_liar(lambda _: answer(b"", "307 Temporary Redirect", Location=place)) as store:
            assert "redirects to another address" in pulled(store, tmp_path, monkeypatch, capsys)
        assert TOKEN in store.asked[0]
        assert thief.asked == []


def page(token: str, items: str = "") -> list[bytes]:
    more = f"<IsTruncated>true</IsTruncated><NextContinuationToken>{token}</NextContinuationToken>"
    return answer(f"<ListBucketResult>{more}{items}</ListBucketResult>".encode(), Content_Type="application/xml")


def item(key: str = f"demos/objects/00/{KEY}", size: str = "3", when: str = "2025-01-01T00:00:00Z") -> str:
    return f"<Contents><Key>{key}</Key><Size>{size}</Size><LastModified>{when}</LastModified></Contents>"


WRONG_LISTS = {
    "the same page again": (lambda n: page("again"), "goes on from where it was"),
    "pages without an end": (lambda n: page(str(n)), "more than 20 pages"),
    "no next page": (lambda n: answer(b"<L><IsTruncated>true</IsTruncated></L>"), "something that S3 does not"),
    "no XML": (lambda n: answer(b"<"), "cannot list"),
    "JSON": (lambda n: answer({"Contents": 7}), "cannot list"),
    "no key": (lambda n: page("x", "<Contents><Size>3</Size></Contents>"), "something that S3 does not"),
    "a size that is none": (lambda n: page("x", item(size="x")), "cannot list"),
    "a time that is none": (lambda n: page("x", item(when="x")), "cannot list"),
    "deep": (lambda n: answer(b"<a>" * 100_000), "cannot list"),
}


@pytest.mark.parametrize(("script", "says"), WRONG_LISTS.values(), ids=WRONG_LISTS)
def test_a_wrong_list_is_one_line(script, says, monkeypatch) -> None:
    monkeypatch.setattr(s3_client, "MOST_PAGES", 20)
    numbers = itertools.count()
    with a_liar(lambda _: script(next(numbers))) as store:
        monkeypatch.setenv("AWS_ENDPOINT_URL", store.url)
        with pytest.raises(RemoteError, match=says) as caught:
            S3Blobs(RemoteUrl.parse("s3://bucket/demos")).list()
        assert len(str(caught.value)) < 1000
        assert len(store.asked) <= 20


def test_a_store_that_does_not_say_what_it_stored_is_one_line(monkeypatch) -> None:
    class Client:
        async def put_object(self, **_: Any) -> dict[str, Any]:
            return {}

    blobs = S3Blobs(RemoteUrl.parse("s3://bucket/demos"))
    monkeypatch.setattr(blobs, "_honours_conditions", True)  # conditions, as a push has found out by then
    monkeypatch.setattr(blobs, "_run", lambda work, _: asyncio.run(work(Client())))
    with pytest.raises(RemoteError, match="answer has no ETag"):
        blobs.swap(b"{}", None, {})
