"""The page as a browser is given it, and what the browser lets it do."""

import base64
import hashlib
from pathlib import Path
from typing import Final, NamedTuple

FOLDER: Final = Path(__file__).with_name("page")
STYLE_LINK: Final = b'<link rel="stylesheet" href="page.css">'
SCRIPT_LINK: Final = b'<script type="module" src="page.js"></script>'
SCRIPTS: Final = ("words.js", "link.js", "traces.js", "marks.js", "sensor.js", "page.js")
"""Joined in this order into one script, in which they see each other's names."""


class Page(NamedTuple):
    """An answer's headers and body."""

    headers: tuple[tuple[str, str], ...]
    body: bytes


def load_page() -> Page:
    """Return the page, with its style and its script inside: nothing else is fetched."""
    style, script = (FOLDER / "page.css").read_bytes(), page_script()
    body = (FOLDER / "page.html").read_bytes()
    body = body.replace(STYLE_LINK, b"<style>\n%s</style>" % style)
    body = body.replace(SCRIPT_LINK, b'<script type="module">%s</script>' % script)
    headers = (
        ("Content-Type", "text/html; charset=utf-8"),
        ("Content-Length", str(len(body))),
        ("Content-Security-Policy", _policy(script)),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),  # the address may hold the token
        ("X-Frame-Options", "DENY"),  # or a stranger's page lets one press a button unseen
    )
    return Page(headers, body)


def page_script() -> bytes:
    """Return the page's script, joined from its files."""
    return b"\n".join((FOLDER / name).read_bytes() for name in SCRIPTS)


def _policy(script: bytes) -> str:
    """Let the page run its own script, by its hash, and talk to this server."""
    digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
