"""One word says where; what cannot be read says how it is written, and never shows a password."""

from __future__ import annotations

import pytest

from manip_il.errors import UsageError
from manip_il.store.remote import RemoteUrl


@pytest.mark.parametrize(
    ("text", "place", "kind", "revision"),
    [
        ("hf://datasets/me/demos", "me/demos", "dataset", None),
        ("hf://datasets/me/demos@v3.0", "me/demos", "dataset", "v3.0"),
        ("hf://me/policy@refs/pr/1", "me/policy", "policy", "refs/pr/1"),
        ("s3://bucket/a/b/", "bucket/a/b", None, None),
        ("file:///a/b", "/a/b", None, None),
        ("file://a/b", "a/b", None, None),
        ("sftp://host/a", "/a", None, None),
    ],
)
def test_what_it_means(text: str, place: str, kind: str | None, revision: str | None) -> None:
    url = RemoteUrl.parse(text)
    assert (url.place, url.kind, url.revision) == (place, kind, revision)
    assert RemoteUrl.parse(str(url)) == url


def test_a_host_with_everything() -> None:
    url = RemoteUrl.parse("sftp://me:p%40ss@[::1]:2222/a b")
    assert (url.user, url.password, url.host, url.port, url.place) == ("me", "p@ss", "::1", 2222, "/a b")
    assert str(url) == "sftp://me@[::1]:2222/a b"
    assert "p@ss" not in repr(url)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("s4://bucket/x", r"unknown scheme 's4://' \(did you mean 's3://'\?\); known: file://, hf://, s3://, sftp://"),
        ("datasets/demos", "is not a URL; expected one of hf://datasets/USER/NAME"),
        ("s3://bucket", "cannot be read; expected s3://BUCKET/FOLDER"),
        ("s3://bucket/../x", "expected s3://"),
        ("hf://demos", "expected hf://"),
        ("hf://datasets/demos", "expected hf://datasets/USER/NAME"),
        ("hf://datasets/me/..", "expected hf://"),
        ("hf://me/x@../y", "expected hf://"),
        ("sftp://host", "expected sftp://"),
        ("sftp://host:99999/x", "expected sftp://"),
        ("sftp://host/../x", "expected sftp://"),
        ("file://", "expected file://"),
        ("file://a\nb", "expected file://"),
    ],
)
def test_what_it_cannot_mean(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        RemoteUrl.parse(text)


@pytest.mark.parametrize(
    "text", ["sftp://me:hunter2@host", "sftp://me:hun/hunter2@host/x", "ftp://me:hunter2@h/x", "me:hunter2@h"]
)
def test_a_bad_url_does_not_show_its_password(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        RemoteUrl.parse(text)
    assert "hunter2" not in str(caught.value)
