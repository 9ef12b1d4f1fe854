"""The documentation as a site: it builds strictly, leads nowhere else, and shows no picture that nobody can make."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest
from edge_samples import ROOT
from mkdocs.commands.build import build
from mkdocs.config import load_config

FETCHED = {
    "img": "src",
    "script": "src",
    "link": "href",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "object": "data",
}


class Page(HTMLParser):
    """Page of the site: its fetches, its links, and the anchors in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = dict(attrs)
        self.anchors |= {told[name] for name in ("id", "name") if told.get(name)}
        address = told.get(FETCHED.get(tag, ""))
        if address and told.get("rel") not in ("canonical", "prev", "next"):
            self.fetched.append(address)
        if tag == "a" and told.get("href"):
            self.links.append(told["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


@pytest.fixture(scope="module")
def pages(site) -> dict[Path, Page]:
    return {path: Page(path) for path in sorted(site.rglob("*.html"))}


def test_the_first_page_and_the_reports_are_there(site, pages):
    assert {"index.html", "trouble.html", "reports/families.html", "decisions.html"} <= {
        path.relative_to(site).as_posix() for path in pages
    }
    assert not list(site.rglob("*.py"))
    assert "<code>echo 1 | sudo tee /sys/" in (site / "trouble.html").read_text()


def test_nothing_is_fetched_from_elsewhere(site, pages):
    for path, page in pages.items():
        assert [one for one in page.fetched if re.match(r"\w+:|//", one)] == [], path.name
    for style in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//[^)]*", style.read_text(encoding="utf-8")) == []


def test_all_that_is_fetched_and_led_to_is_there(site, pages):
    for path, page in pages.items():
        if path.name == "404.html":  # shown in place of any page: its own links begin at the site's root
            continue
        for address in [*page.fetched, *page.links]:
            address, anchor = urldefrag(address)
            if re.match(r"\w+:", address):
                continue
            target = (path.parent / unquote(address)).resolve() if address else path
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{path.relative_to(site)} leads to {address}"
            assert not anchor or target.suffix != ".html" or unquote(anchor) in pages[target].anchors | {"__skip"}, (
                f"{path.relative_to(site)} leads to {address}#{anchor}"
            )


def test_what_links_of_the_repository_lead_to_is_there():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for address in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            address, _ = urldefrag(address)
            if address and not re.match(r"\w+:", address):
                assert (page.parent / address).exists(), f"{page.name} leads to {address}"
