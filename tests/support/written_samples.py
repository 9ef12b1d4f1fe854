"""Commands, snippets and options in the text of the pages."""

import re
from pathlib import Path
from typing import NamedTuple

from edge_samples import ROOT

PAGES = (
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").glob("*.md") if page.stem not in ("decisions", "changelog")),
)
"""Pages whose commands must work; the others name commands and options as they were."""
LANGUAGES = {"sh", "python", "text", "json", "toml", "html", "ini", "xml", "c", "nginx"}
_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)")
_INDENTED = re.compile(r"(?<=\n\n)( {4,7})(?![-*] |\d+\. )\S.*\n(?:(?:\1.*|\n(?=\1))(?:\n|\Z))*")
_COMMENT = re.compile(r"(?:^|\s)#.*")
_RUNNABLE = re.compile(r"(?:edge-sr|make|pip install|python3?|sudo|torchrun|git|echo|ros2|ulimit) \S")
NAMED = re.compile(r"edge-sr ([a-z]+)")
"""A command that is spoken of, not one to be typed."""
_MAKEFILE = re.compile(
    r"^\t(?:\w+=\S+ )*\$\(BIN\)/((?:python -m (?!pip|pytest)|edge-sr|torchrun|mkdocs).*)$", re.MULTILINE
)


class Block(NamedTuple):
    """A block of a page: fenced, or indented, which is of commands if one of its lines is."""

    page: str
    language: str
    text: str


def blocks() -> list[Block]:
    found = []
    for page in PAGES:
        for indent, language, text in _FENCE.findall(page.read_text()):
            lines = [line.removeprefix(indent) for line in text.splitlines()]
            found.append(Block(page.name, language, "\n".join(lines)))
        for block in _INDENTED.finditer(unfenced(page)):
            lines = [line.removeprefix(block[1]) for line in block[0].splitlines()]
            language = "sh" if any(map(_RUNNABLE.match, lines)) else "text"
            found.append(Block(page.name, language, "\n".join(lines)))
    return found


def unfenced(page: Path) -> str:
    """Return the text outside the blocks."""
    return _FENCE.sub("", page.read_text())


def inline(page: Path) -> list[str]:
    """Return the texts between backticks."""
    return [" ".join(text.replace("\\|", "|").split()) for text in _INLINE.findall(unfenced(page))]


def commands() -> dict[str, list[str]]:
    """Return every command, and the pages that give it."""
    found: dict[str, list[str]] = {}
    for block in blocks():
        if block.language == "sh":
            for line in block.text.replace("\\\n", " ").splitlines():
                command = " ".join(_COMMENT.sub("", line).split())
                if command:
                    found.setdefault(command, []).append(block.page)
    for page in PAGES:
        for text in inline(page):
            if _RUNNABLE.match(text) and "..." not in text and not NAMED.fullmatch(text):
                found.setdefault(text, []).append(page.name)
    for command in _MAKEFILE.findall((ROOT / "Makefile").read_text()):
        found.setdefault(command.replace("$(NETWORKS)", "mine/stsr.pt").replace("$@", "out.npz"), []).append("Makefile")
    return found
