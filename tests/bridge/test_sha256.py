"""SHA-256 without OpenSSL: the same hash, by whichever module the interpreter has."""

import hashlib

import pytest

from firmware_bridge.zeroing import sha256


@pytest.mark.parametrize("modules", [sha256._MODULES, ("_absent", "hashlib")])
@pytest.mark.parametrize("data", [b"", b"abc", bytes(1000)])
def test_it_is_the_hash_of_hashlib(modules, data, monkeypatch):
    monkeypatch.setattr(sha256, "_MODULES", modules)
    assert sha256.sha256_hex(data) == hashlib.sha256(data).hexdigest()


def test_no_module_is_one_line(monkeypatch):
    monkeypatch.setattr(sha256, "_MODULES", ("_absent",))
    with pytest.raises(ImportError, match="no module of _absent is there"):
        sha256.sha256_hex(b"")
