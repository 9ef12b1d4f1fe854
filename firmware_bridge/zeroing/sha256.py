"""SHA-256 by Python's own code: `hashlib` loads OpenSSL for it, 3.7 MB and 5 ms of every start."""

from contextlib import suppress
from importlib import import_module
from typing import Final

_MODULES: Final = ("_sha2", "_sha256", "hashlib")
"""Modules with the function: of Python 3.12 and later, of 3.11, and of an interpreter that is built without either."""


def sha256_hex(data: bytes) -> str:
    """Return the hash of some bytes, in hexadecimal."""
    for name in _MODULES:
        with suppress(ImportError):
            return import_module(name).sha256(data).hexdigest()
    raise ImportError(f"no module of {', '.join(_MODULES)} is there")
