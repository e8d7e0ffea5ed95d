"""A report's page as a test reads it, and what holds for every page."""

from __future__ import annotations

import re
from html.parser import HTMLParser

from manip_il.evaluation.report import Report

VOID = {"meta", "link", "img", "br", "hr", "input"}
EVIL = '<script>alert("x")</script>&'


class Page(HTMLParser):
    """Tags with their attributes, and whether every element was closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())

    def count(self, css_class: str) -> int:
        return sum(attributes.get("class") == css_class for _, attributes in self.tags)

    def bar_widths(self, kind: str) -> list[str | None]:
        return [a["width"] for tag, a in self.tags if tag == "rect" and re.match(f"bar {kind}", a.get("class") or "")]


def page_of(report: Report) -> Page:
    """The page, which closes all elements, runs no script, reaches nothing outside and begins with its verdict."""
    html = report.render()
    assert html == report.render()
    page = Page(html)
    assert page.open == []
    assert not re.search(r"(?<!&#34;)https?:|@import|url\(|<script", html)
    assert any("default-src 'none'" in (attributes.get("content") or "") for _, attributes in page.tags)
    for tag, attributes in page.tags:
        assert tag != "script"
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "poster", "xlink:href"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
    headings = re.findall(r"<h[12]>(.*?)</h[12]>", html)
    assert headings[1] == "Results"
    assert report.verdict in page.text
    return page
