"""Conditions that hold in every test."""

import os
import signal
import sys
import tracemalloc
from functools import partial
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from edge.inference import bundled
from firmware_bridge.links.serial_ports import Port

ROOT = Path(__file__).parents[1]
# Programs that tests start find this checkout, whatever is installed; and their output is buffered, as usual, since the
# rest of an unbuffered write that a signal interrupts is left out.
os.environ["PYTHONPATH"] = f"{ROOT}:{ROOT / 'tests/support'}"
os.environ["PYTHONUNBUFFERED"] = ""

# A shell ignores Ctrl-C in what it starts in the background, nohup a hang-up; programs of a test would inherit that.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


def pytest_collection_modifyitems(items):
    """Take a file of each folder in turn.

    Those that wait then run beside those that compute; the last are of the folders with many files, which are short.
    """
    turns: dict[Path, dict[Path, int]] = {}
    for item in items:
        files = turns.setdefault(item.path.parent, {})
        files.setdefault(item.path, len(files))
    items.sort(key=lambda item: (turns[item.path.parent][item.path], item.path))


@pytest.fixture
def limits(monkeypatch):
    """Function that sets limits of a module, of time or size, which a test would have to wait for or to fill."""

    def set_limits(module, **limits):
        for name, limit in limits.items():
            monkeypatch.setattr(module, name, limit)

    return set_limits


@pytest.fixture
def plugged(monkeypatch):
    """Serial ports that pyserial finds on this machine, to be filled by a test."""
    ports: list[Port] = []

    def listed(port):
        info = ListPortInfo(port.path)
        info.vid, info.pid = port.usb_id or (None, None)
        info.serial_number, info.description = port.serial_number, port.description
        info.product, info.manufacturer = port.product, port.manufacturer
        info.location = f"{port.location or ''}:{port.interface or ''}"
        return info

    monkeypatch.setattr(list_ports, "comports", lambda: list(map(listed, ports)))
    return ports


@pytest.fixture
def bundle(monkeypatch, tmp_path):
    """Empty folder in place of that of the bundled models."""
    monkeypatch.setattr(bundled, "BUNDLE_DIR", tmp_path / "bundled")
    bundled.BUNDLE_DIR.mkdir()
    return bundled.BUNDLE_DIR


@pytest.fixture
def stdin(monkeypatch):
    """Function that sets sys.stdin."""
    return partial(monkeypatch.setattr, sys, "stdin")


@pytest.fixture
def argv(monkeypatch):
    """Function that sets sys.argv, for programs that take nothing else."""
    return partial(monkeypatch.setattr, sys, "argv")


@pytest.fixture
def bounded_memory():
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60_000_000
