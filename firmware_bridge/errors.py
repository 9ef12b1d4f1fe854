"""Errors of the bridge, and the message where an optional dependency, an extra of pyproject.toml, is missing.

Bad frames, skipped bytes and torn scans are counted, never raised.
"""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from shlex import quote

_FOLDER = Path(__file__).resolve().parent.parent


def harmless(text: str, kept: str = "\n\t") -> str:
    """Return a stranger's text with escapes for what is not printable, but for `kept`; it can always be encoded."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() or letter in kept else _escaped(letter) for letter in text)


def _escaped(letter: str) -> str:
    # Python decodes a byte that is not UTF-8 in a file name as U+DC80 to U+DCFF.
    return f"\\x{ord(letter) - 0xDC00:02x}" if "\udc80" <= letter <= "\udcff" else ascii(letter)[1:-1]


def as_typed(text: object) -> str:
    """Return a name as a person types it in a command, quoted where a shell needs that, or as bash's $'...'."""
    name = str(text)
    if name.isprintable():
        return quote(name)
    letters = re.sub(r"([\\'])", r"\\\1", name)
    return f"$'{''.join(letter if letter.isprintable() else _typed_escape(letter) for letter in letters)}'"


def _typed_escape(letter: str) -> str:
    # Two digits are a byte to bash, and a letter beyond ASCII has several.
    return f"\\u{ord(letter):04x}" if "\x80" <= letter <= "\xff" else _escaped(letter)


class BridgeError(Exception):
    """Root of all errors of the bridge; its text holds no control characters."""

    def __str__(self) -> str:
        return harmless(super().__str__())


class DeviceError(BridgeError, OSError):
    """A device or port that cannot be used."""


class NoDeviceError(DeviceError):
    """No sensor adapter, or several without a choice."""


class LinkLostError(DeviceError, ConnectionError):
    """The link to the sensor was there and is gone."""


class BaselineRefusedError(BridgeError, ValueError):
    """Scans that cannot serve as a baseline."""


class RecordingError(BridgeError, ValueError):
    """A recording or baseline file that cannot be used."""


class NpzError(BridgeError, ValueError):
    """An npz file that is damaged, larger than expected, or not plain arrays."""


class CdrError(BridgeError, ValueError):
    """Bytes that are no message of their stated type."""


class SensorFileError(BridgeError, ValueError):
    """A sensor file that cannot be used."""


class SourceError(BridgeError, ValueError):
    """A text that names no source."""


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml, in a checkout or beside an installed wheel."""
    where = _FOLDER if (_FOLDER / "pyproject.toml").is_file() else "tactile-edge-sr"
    return f"pip install {as_typed(f'{where}[{extra}]')}"


def need(extra: str, *modules: str) -> None:
    """Raise a ModuleNotFoundError if modules of an extra are missing; a command ends with its message alone."""
    missing = [name for name in modules if find_spec(name) is None]
    if not missing:
        return
    why = f"not installed: {', '.join(missing)}; {how_to_install(extra)}"
    if sys.argv[:1] == ["-m"]:  # python -m imports the package to find the command in it
        sys.exit(why)
    raise ModuleNotFoundError(why, name=missing[0])
