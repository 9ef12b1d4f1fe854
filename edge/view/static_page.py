"""Static page as it is sent to a browser, with the policy that limits it."""

import base64
import hashlib
from pathlib import Path
from typing import Final, NamedTuple

FOLDER: Final = Path(__file__).with_name("page")
STYLE_LINK: Final = b'<link rel="stylesheet" href="page.css">'
SCRIPT_LINK: Final = b'<script type="module" src="page.js"></script>'
KEY: Final = b'<meta name="edge-sr-key" content="">'
SCRIPTS: Final = (
    *("colour_map.js", "words.js", "link.js", "traces.js", "marks.js", "history.js", "contact_shape.js", "relief.js"),
    *("overlay.js", "explain.js", "numbers.js", "limits.js", "sensor.js", "hand.js", "moment.js", "map.js", "page.js"),
)
"""Files of the script in the order in which they are joined, so that they share one scope."""


class Page(NamedTuple):
    """Headers and body of an answer."""

    headers: tuple[tuple[str, str], ...]
    body: bytes


def load_page(key: str = "") -> Page:
    """Return the page, with its style, its script and its key inside: nothing else is fetched."""
    style, script = (FOLDER / "page.css").read_bytes(), page_script()
    body = (FOLDER / "page.html").read_bytes()
    body = body.replace(STYLE_LINK, b"<style>\n%s</style>" % style)
    body = body.replace(SCRIPT_LINK, b'<script type="module">%s</script>' % script)
    body = body.replace(KEY, KEY.replace(b'""', b'"%s"' % key.encode()))
    headers = (
        ("Content-Type", "text/html; charset=utf-8"),
        ("Content-Length", str(len(body))),
        ("Content-Security-Policy", _policy(script)),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),  # the address may hold the token
        ("X-Frame-Options", "DENY"),  # or a stranger's page could make a user press a button unseen
    )
    return Page(headers, body)


def page_script() -> bytes:
    """Return the page's script, joined from its files."""
    return b"\n".join((FOLDER / name).read_bytes() for name in SCRIPTS)


def _policy(script: bytes) -> str:
    """Return a policy that lets the page run its own script, by its hash, and talk to this server."""
    digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
