"""The page as a browser is given it, and what the browser lets it do."""

import base64
import hashlib
import re
from pathlib import Path
from typing import Final, NamedTuple

PAGE_FILE: Final = Path(__file__).with_name("page.html")


class Page(NamedTuple):
    """An answer's headers and body."""

    headers: tuple[tuple[str, str], ...]
    body: bytes


def load_page() -> Page:
    """The one file that there is."""
    body = PAGE_FILE.read_bytes()
    headers = (
        ("Content-Type", "text/html; charset=utf-8"),
        ("Content-Length", str(len(body))),
        ("Content-Security-Policy", _policy(body)),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),  # the address may hold the token
        ("X-Frame-Options", "DENY"),  # or a stranger's page lets one press a button unseen
    )
    return Page(headers, body)


def _policy(page: bytes) -> str:
    """To run its own script, by its hash, and to talk to this server."""
    scripts = re.findall(rb"<script[^>]*>(.*?)</script>", page, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
