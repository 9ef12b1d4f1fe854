"""Hooks of mkdocs for a site of README.md, docs/ and reports/.

Pages exist once in the repository, with links that work there; a link from docs/ to ../reports/ is rewritten here for
the site.
"""

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT: Final = Path(__file__).resolve().parent.parent
SHOWN: Final = (".md", ".png", ".svg", ".csv")
_LINK: Final = re.compile(r"(?<=\]\()(?:docs/|\.\./)(?=[\w.])")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the first page and the reports to the site."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=readme))
    for path in sorted((ROOT / "reports").rglob("*")):
        if path.suffix in SHOWN:
            name = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Rewrite links to files of the repository as links to pages of the site."""
    return markdown if page.file.src_uri.startswith("reports/") else _LINK.sub("", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Show a bar in a table's code as GitHub does, without its escaping backslash."""
    return re.sub(r"<code>[^<]*</code>", lambda code: code[0].replace("\\|", "|"), html)
