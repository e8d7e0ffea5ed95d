"""However an address is written, no part of its password is printed: not in errors, not in
tracebacks.
"""

import contextlib
import io
from urllib.parse import quote

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from manip_il.bridges.store.errors import RemoteError
from manip_il.cli.main import main

LETTERS = "abcdefgijkmnqtuvwyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789@:/%#?[]!&=+.~-_\\'\"$ "
SECRETS = st.text(LETTERS, min_size=8, max_size=20).filter(lambda text: text == text.strip())
SCHEMES = st.sampled_from(
    [
        "sftp://",
        "s3://",
        "hf://",
        "file://",
        "https://",
        "ftp://",
        "sftp:/",
        "sftp:",
        "SFTP://",
        "sftp:///",
        "u:",
        "",
    ]
)
USERS = st.sampled_from(["u", "", "me.too", "a/b", "datasets/me", "a@b", "u:v"])
BEHIND = st.sampled_from(
    ["@h/x", "@", "@h", "/@h/x", "@h:22/x", "@h:99999/x", "@/x", "@h/../x", "@[::1]/x", "@h/a@b", "@h//", "@h x/y"]
)  # fmt: skip
WORDS = st.sampled_from(["{}", "--remote={}", "--{}", "--debug {}", "--revision={}"])


def printed(words: list[str]) -> str:
    """All that a command says; no address is ever connected to."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        assert main(words) in (1, 2)
    return out.getvalue()


@pytest.fixture(autouse=True, scope="module")
def _nowhere():
    def refuse(url: str, **_: object) -> None:
        raise RemoteError(f"cannot reach {url}, {url!r}")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("manip_il.cli.run.transfer.open_remote", refuse)
        yield


def said_of(
    scheme: str, user: str, secret: str, behind: str, word: str, coded: bool, command: str
) -> str:
    address = f"{scheme}{user}:{quote(secret, safe='') if coded else secret}{behind}"
    words = (
        word.format(address).split(" ", 1) if word.startswith("--debug") else [word.format(address)]
    )
    return printed(
        [
            command,
            *(["out"] if command == "push" else []),
            *words,
            *(["out"] if command == "pull" else []),
        ]
    )


@settings(max_examples=300)
@given(SCHEMES, USERS, SECRETS, BEHIND, WORDS, st.booleans(), st.sampled_from(["pull", "push"]))
@example("sftp://", "u", "pa:ss@wd/", "@h/x", "{}", False, "pull")
@example("sftp://", "u", "22/password", "@h/x", "{}", False, "pull")
@example("sftp://", "u", "password", "@h/x", "--{}", False, "pull")
@example("sftp://", "u", "0000back", "@h/x", "--debug {}", False, "pull")  # as in "Traceback"
def test_no_tail_of_a_password_is_printed(
    scheme, user, secret, behind, word, coded, command
) -> None:
    assume(secret[-4:] not in said_of(scheme, user, "another one", behind, word, coded, command))
    said = said_of(scheme, user, secret, behind, word, coded, command)
    assert secret not in said
    assert secret[-4:] not in said, said
    if coded:
        assert quote(secret, safe="")[-4:] not in said
