"""The documentation as a site: it builds strictly, so all links lead somewhere, and fetches nothing from elsewhere."""

import re
from pathlib import Path
from urllib.parse import urldefrag

import pytest
from edge_samples import ROOT
from mkdocs.commands.build import build
from mkdocs.config import load_config

FETCHING = re.compile(r"<(?:img|script|link|iframe|source|video|object)\b[^>]*>")
ELSEWHERE = re.compile(r"\b(?:src|href|data)=[\"']?(?:\w+:)?//|(?:url\(|@import)\s*[\"']?(?:https?:)?//")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


def test_the_first_page_and_the_reports_are_there(site):
    for page in ("index.html", "trouble.html", "reports/families.html", "decisions.html"):
        assert (site / page).is_file(), page
    assert not list(site.rglob("*.py"))
    assert "<code>echo 1 | sudo tee /sys/" in (site / "trouble.html").read_text()


def test_nothing_is_fetched_from_elsewhere(site):
    for path in (*site.rglob("*.html"), *site.rglob("*.css")):
        text = path.read_text(encoding="utf-8")
        parts = FETCHING.findall(text) if path.suffix == ".html" else [text]
        assert [one for one in parts if ELSEWHERE.search(one) and "canonical" not in one] == [], path.name


def test_what_links_of_the_repository_lead_to_is_there():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for address in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            address, _ = urldefrag(address)
            if address and not re.match(r"\w+:", address):
                assert (page.parent / address).exists(), f"{page.name} leads to {address}"
