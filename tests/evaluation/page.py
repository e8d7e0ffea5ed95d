"""A report's page as a test reads it, and what holds for every page."""

import base64
import re
from html.parser import HTMLParser

from manip_il.evaluation.report import Report

VOID = {"meta", "link", "img", "br", "hr", "input"}
EVIL = '<script>alert("x")</script>&$'


class Page(HTMLParser):
    """Tags with their attributes, and whether every element was closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(html.replace("<wbr>", ""))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())

    @property
    def figures(self) -> list[str]:
        """What each figure shows, in words."""
        return [
            a["alt"] or "" for tag, a in self.tags if tag == "img" and "svg" in (a["src"] or "")
        ]


def page_of(report: Report) -> Page:
    """The page, which closes all elements, runs no script, reaches nothing outside and begins
    with its verdict.
    """
    html = report.render()
    assert html == report.render()
    page = Page(html)
    assert page.open == []
    assert not re.search(r"(?<!&#34;)https?:|@import|url\(|<script", html)
    assert any(
        "default-src 'none'" in (attributes.get("content") or "") for _, attributes in page.tags
    )
    for tag, attributes in page.tags:
        assert tag != "script"
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "poster"):
            source = attributes.get(name) or "data:"
            assert source.startswith("data:"), (tag, attributes)
            if source.startswith("data:image/svg"):
                assert b"<script" not in base64.b64decode(source.partition(",")[2])
    assert re.findall(r"<h[12]>(.*?)</h[12]>", html)[1] == report.sections[0].heading
    assert report.verdict in page.text
    return page
