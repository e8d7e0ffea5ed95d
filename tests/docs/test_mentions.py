"""What README and docs mention is there: options, commands, files, headings."""

import re
from pathlib import Path

import pytest

from manip_il.cli.main import COMMANDS, GROUPS

from .pages import PAGES, ROOT

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_INLINE_COMMAND = re.compile(r"`manip-il ([a-z]+(?: [a-z-]+)?)")


@pytest.mark.parametrize("page", PAGES)
def test_every_command_is_one_that_there_is(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    unknown = [
        words
        for words in _INLINE_COMMAND.findall(text)
        if not {words, words.split()[0]} & {*COMMANDS, *GROUPS}
    ]
    assert unknown == []


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_heading_of_the_repository(page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    for link in _LINK.findall(text):
        if link.startswith("https://"):
            continue
        name, _, heading = link.partition("#")
        target = (ROOT / page).parent / name if name else ROOT / page
        assert target.exists(), f"{page}: {link}"
        assert not heading or heading in _headings(target), f"{page}: {link}"


def test_every_page_of_the_docs_is_on_the_map():
    on_the_map = {
        link.partition("#")[0]
        for link in _LINK.findall((ROOT / "docs/README.md").read_text("utf-8"))
    }
    pages = {str(path.relative_to(ROOT / "docs")) for path in ROOT.glob("docs/**/*.md")}
    assert pages - {"README.md"} <= on_the_map


def _headings(page: Path) -> set[str]:
    """As GitHub names them in addresses."""
    lines = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}
