"""A Hub that wants the token, or never to end: it gets nothing, and the user one line."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from huggingface_hub import close_session, constants

from manip_il.cli.main import main
from manip_il.store import errors, hub_http, hub_repo
from manip_il.store.errors import Retry
from manip_il.store.hub_repo import HubRepo

from .hub_use import DATASET, TOKEN
from .liar import Liar, a_liar, answer, drip, drip_headers, endless, error_of_pull, head
from .trees import wait_little

COMMIT = "c" * 40
INFO = {"_id": "0", "id": "user/demos", "sha": COMMIT, "private": False, "tags": [], "siblings": []}
FILE = {"type": "file", "path": "README.md", "oid": hashlib.sha1(b"blob 3\0abc").hexdigest(), "size": 3}


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    wait_little(monkeypatch, tries=2)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    yield
    close_session()


def honest(line: str) -> list[bytes]:
    """What a Hub answers about a repository with one file."""
    if "/tree/" in line:
        return answer([FILE])
    if "/resolve/" in line:
        return answer(b"abc")
    if line.endswith("/refs"):
        return answer({"branches": [{"name": "main", "ref": "refs/heads/main", "targetCommit": COMMIT}], "tags": []})
    return answer(INFO)


def pulled(hub: Liar, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr(constants, "ENDPOINT", hub.url)
    return error_of_pull(DATASET, folder, capsys, TOKEN)


def authorized(liar: Liar) -> list[bool]:
    """Of every request, whether the token came with it."""
    return [TOKEN in one for one in liar.asked]


def repo(hub: Liar) -> HubRepo:
    return HubRepo(hub.url, "dataset", "user/demos", "hf://datasets/user/demos", Retry(sleep=lambda _: None))


def test_the_next_page_of_a_list_gets_the_token_from_its_own_origin_alone() -> None:
    with a_liar(lambda _: answer([FILE | {"path": "stolen.md"}])) as thief:
        pages = itertools.count()

        def script(line: str) -> list[bytes]:
            places = [f"{hub.url}/api/datasets/user/demos/tree/{COMMIT}?page=2", f"{thief.url}/tree/next"]
            return answer([FILE], Link=f'<{places[next(pages)]}>; rel="next"')

        with a_liar(script) as hub:
            tree = repo(hub).tree(COMMIT)
        assert sorted(tree.files) == ["README.md", "stolen.md"]
        assert authorized(hub) == [True, True]
        assert authorized(thief) == [False]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_redirect_elsewhere_gets_no_token(host: str) -> None:
    with a_liar(lambda _: answer(INFO)) as thief:
        place = f"http://{host}:{thief.port}/x"
        with a_liar(lambda _: answer(status="302 Found", Location=place)) as hub:
            assert repo(hub).find("main") == COMMIT
        assert authorized(hub) == [True]
        assert authorized(thief) == [False]


def test_the_address_of_an_upload_gets_no_token(tmp_path: Path) -> None:
    from huggingface_hub import CommitOperationAdd

    (tmp_path / "x.bin").write_bytes(b"x" * 100)
    operation = CommitOperationAdd("x.bin", str(tmp_path / "x.bin"))
    with a_liar(lambda _: answer({})) as thief:

        def script(line: str) -> list[bytes]:
            if "/preupload/" in line:
                return answer({"files": [{"path": "x.bin", "uploadMode": "lfs", "shouldIgnore": False}]})
            actions = {name: {"href": f"{thief.url}/{name}"} for name in ("upload", "verify")}
            oid = operation.upload_info.sha256.hex()
            return answer({"transfer": "basic", "objects": [{"oid": oid, "size": 100, "actions": actions}]})

        with a_liar(script) as hub:
            repo(hub).upload("main", [operation])
        assert authorized(hub) == [True, True]
        assert [one.split()[0] for one in thief.asked] == ["PUT", "POST"]
        assert authorized(thief) == [False, False]


def test_a_connection_that_was_made_anew_keeps_to_the_limits(tmp_path: Path) -> None:
    """huggingface_hub makes another client after an error."""
    with a_liar(lambda _: answer(INFO)) as thief:
        script = itertools.chain([b""], itertools.repeat(answer(status="302 Found", Location=f"{thief.url}/x")))
        with a_liar(lambda _: next(script)) as hub:
            asked = repo(hub)
            close_session()
            assert asked.find("main") == COMMIT
        assert authorized(thief) == [False]


@pytest.mark.parametrize(
    ("left", "right", "is_same"),
    [
        ("https://hub.co/x", "https://HUB.co:443", True),
        ("http://hub.co", "https://hub.co", False),
        ("https://hub.co:444", "https://hub.co", False),
        ("https://hub.co.evil.com", "https://hub.co", False),
        ("https://hub.co@evil.com", "https://hub.co", False),
    ],
)
def test_an_origin_is_scheme_host_and_port(left: str, right: str, is_same: bool) -> None:
    assert hub_http._same_origin(httpx.URL(left), httpx.URL(right)) == is_same


ENDLESS = {
    "JSON": (lambda _: endless(b"[" * 65536), "answered more than 200,000 bytes"),
    "a body, bit by bit": (drip, "expected at least 1,000 bytes a second"),
    "headers, bit by bit": (drip_headers, "expected at least 1,000 bytes a second"),
    "headers": (lambda _: itertools.chain([b"HTTP/1.1 200 OK\r\n"], itertools.repeat(b"X-A: b\r\n" * 999)), "cut"),
    "an announced terabyte": (lambda _: [head(Content_Length=str(10**12)), *honest("")], "cut"),
    "redirects": (lambda line: answer(status="302 Found", Location=line.split()[1]), "TooManyRedirects"),
    "a wait": (lambda _: answer({}, "429 Too Many Requests", Retry_After="9" * 12), "asks to wait"),
    "a wait by the rate limit": (lambda _: answer({}, "429 Slow", RateLimit='"api";r=0;t=999999999'), "asks to wait"),
    "zipped zeros": (lambda _: answer(b"\x1f\x8b", Content_Encoding="gzip"), "in the encoding 'gzip'"),
}


@pytest.mark.parametrize(("script", "says"), ENDLESS.values(), ids=ENDLESS)
def test_what_has_no_end_ends_in_one_line(script, says, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(hub_http, "LARGEST_ANSWER", 200_000)
    if "a second" in says:  # the others may take as long as a busy machine needs
        monkeypatch.setattr(errors, "WINDOW", 0.2)
    with a_liar(script) as hub:
        assert says in pulled(hub, tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("page", [[], [FILE], [FILE | {"type": "directory"}]], ids=["empty", "files", "folders"])
def test_a_list_without_an_end_ends_in_one_line(page: Any, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(hub_http, "MOST_PAGES", 20)
    monkeypatch.setattr(hub_repo, "MOST_ENTRIES", 15)

    def script(line: str) -> list[bytes]:
        return answer(page, Link=f'<{hub.url}/tree/more>; rel="next"') if "/tree/" in line else honest(line)

    with a_liar(script) as hub:
        error = pulled(hub, tmp_path, monkeypatch, capsys)
        assert ("more than 15 files" if page else "a list of more than 20 pages") in error
        assert len(hub.asked) < 30


def test_an_answer_and_a_list_may_take_so_long_and_no_longer(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(hub_http, "LONGEST_LISTING", -1.0)
    with a_liar(honest) as hub:
        assert "has a list of more than -1 s" in pulled(hub, tmp_path, monkeypatch, capsys)
    monkeypatch.setattr(hub_http, "LONGEST_ANSWER", -1.0)
    with a_liar(honest) as hub:
        assert "took more than -1 s for an answer" in pulled(hub, tmp_path, monkeypatch, capsys)


def test_a_file_that_drips_ends_in_one_line_and_one_at_the_least_speed_comes(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(errors, "WINDOW", 0.2)
    large = answer([FILE | {"size": 10**6}])
    with a_liar(lambda x: drip(x) if "/resolve/" in x else large if "/tree/" in x else honest(x)) as hub:
        assert "expected at least 1,000 bytes a second" in pulled(hub, tmp_path, monkeypatch, capsys)
    slow = errors.Pace("x")
    for _ in range(1000):
        slow.add(errors.WINDOW / 7, int(errors.LEAST_SPEED * errors.WINDOW / 7) + 1)


DEEP = b'{"a":' * 100_000
WRONG: list[Any] = [
    *(None, True, 7, 1e308, "x", [], [[]], {}, [None], [7], ["x"], {"a": 1}, b"", b"{", b"\xff\xfe", b"9" * 5000),
    *(DEEP, b"[" * 100_000, b"NaN", b"null", b'{"sha": 1e999}', b'"\\ud800"'),
]
WRONG_INFO = [
    INFO | change
    for change in (
        {"sha": 7}, {"sha": ["a"]}, {"sha": "../../../x"}, {"sha": "A" * 10**6}, {"sha": {"a": 1}}, {"sha": True},
        {"siblings": 7}, {"siblings": [7]}, {"siblings": None}, {"tags": 7}, {"id": None}, {"lastModified": 7},
        {"cardData": 7}, {"siblings": [{}]}, {"private": []}, {"lastModified": "x"},
    )
]  # fmt: skip
LFS = {"oid": "b" * 64, "size": 3, "pointerSize": 1}
WRONG_FILES = [
    FILE | change
    for change in (
        {"path": None}, {"path": 7}, {"path": ["a"]}, {"path": "x" * 10**6}, {"path": "a/../../x"}, {"path": "/etc/x"},
        {"path": "C:\\x"}, {"path": "x.py"}, {"path": "x\x00"}, {"path": ""}, {"size": None}, {"size": -1},
        {"size": 2**80}, {"size": "3"}, {"size": 1e300}, {"size": True}, {"oid": None}, {"oid": 7}, {"oid": "../x"},
        {"oid": "z" * 10**6}, {"lfs": 7}, {"lfs": {}}, {"lfs": LFS | {"oid": "../x"}}, {"lfs": LFS | {"oid": None}},
        {"lfs": LFS | {"size": "3"}}, {"lfs": LFS | {"size": -3}}, {"lfs": LFS | {"size": 2**70}},
        {"type": "file", "lfs": [1]}, {"lastCommit": 7}, {"securityFileStatus": 7},
    )
]  # fmt: skip
WRONG_REFS: list[Any] = [
    *WRONG,
    {"branches": 7, "tags": []},
    {"branches": [7], "tags": []},
    {"branches": [{"name": ["a"], "ref": "x", "targetCommit": COMMIT}], "tags": []},
    {"branches": [{"name": "main", "ref": "x", "targetCommit": "../x"}], "tags": [], "converts": []},
    {"branches": [], "tags": [{"name": "main", "ref": "x", "targetCommit": None}], "converts": []},
]


def ends_well(hub: Liar, folder: Path, monkeypatch, capsys) -> None:
    """A pull comes to its end, in one line; or what was said did not matter to it."""
    monkeypatch.setattr(constants, "ENDPOINT", hub.url)
    code = main(["pull", DATASET, str(folder / "got"), "--quiet"])
    error = capsys.readouterr().err
    assert code == 0 or (code == 1 and error.count("\n") == 1 and "--debug" not in error), error
    assert len(error) < 2000
    assert {path.name for path in folder.iterdir()} <= {"got", ".got.pulling", "..got.pulling.lock"}


ANSWERS: dict[str, tuple[str, list[Any]]] = {
    "about the repository": ("", [*WRONG, *WRONG_INFO]),
    "the files": ("/tree/", [*WRONG, *([file] for file in WRONG_FILES)]),
    "the branches": ("/refs", WRONG_REFS),
}


@pytest.mark.slow
@pytest.mark.parametrize(("what", "values"), ANSWERS.values(), ids=ANSWERS)
def test_answers_of_the_wrong_shape_end_in_one_line(
    what: str, values: list[Any], tmp_path, monkeypatch, capsys
) -> None:
    for number, value in enumerate(values):

        def script(line: str, value: Any = value) -> list[bytes]:
            if what == "/refs" and "/revision/" in line:  # then all branches are asked for
                return answer({}, "404 Not Found", X_Error_Code="RevisionNotFound")
            is_it = what in line if what else "/tree/" not in line and "/resolve/" not in line
            return answer(value) if is_it else honest(line)

        (tmp_path / str(number)).mkdir()
        with a_liar(script) as hub:
            ends_well(hub, tmp_path / str(number), monkeypatch, capsys)


@pytest.mark.slow
def test_what_a_push_is_answered_may_be_anything(tmp_path, monkeypatch, capsys) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("# manip-il\n")
    commit = {"commitUrl": "x", "commitOid": 7, "success": True}
    for value in [*WRONG, commit, commit | {"commitUrl": f"https://x/user/demos/commit/{COMMIT}"}, {"files": 7}]:
        with a_liar(lambda line, value=value: answer(value) if line.startswith("POST") else honest(line)) as hub:
            monkeypatch.setattr(constants, "ENDPOINT", hub.url)
            assert main(["push", str(run), "hf://user/demos"]) == 1
            error = capsys.readouterr().err
            assert error.splitlines()[-1].startswith("manip-il: error: ")
            assert "--debug" not in error
            assert len(error) < 3000
