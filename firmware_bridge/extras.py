"""What is installed only where it is asked for."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

_FOLDER: Final = Path(__file__).resolve().parent.parent
_PACKAGE: Final = "tactile-edge-sr"


def how_to_install(extra: str) -> str:
    """The command that brings an extra of pyproject.toml, for a line that says what is missing."""
    if (_FOLDER / "pyproject.toml").is_file():
        return f"pip install '{_FOLDER}[{extra}]'"
    from importlib.metadata import PackageNotFoundError, requires  # here alone: it takes long to import

    try:
        wanted = _wanted(requires(_PACKAGE) or [], extra)
    except PackageNotFoundError:  # a copy of the sources that was never installed
        wanted = []
    return f"pip install {' '.join(wanted)}" if wanted else f"pip install '{_PACKAGE}[{extra}]'"


def need(extra: str, *modules: str) -> None:
    """Refuse to import a package of which an extra is missing; a command ends with the line alone.

    Raises:
        ModuleNotFoundError: modules of the extra are not installed.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if not missing:
        return
    why = f"not installed: {', '.join(missing)}; {how_to_install(extra)}"
    if sys.argv[:1] == ["-m"]:  # python -m looks for the command, which is within the package
        sys.exit(why)
    raise ModuleNotFoundError(why, name=missing[0])


def _wanted(requirements: list[str], extra: str) -> list[str]:
    """The extra's requirements of a package's metadata, each quoted for a shell."""
    wanted: list[str] = []
    for requirement in requirements:
        text, _, condition = requirement.partition(";")
        if not re.search(rf"extra == ['\"]{extra}['\"]", condition):
            continue
        own = re.fullmatch(rf"{_PACKAGE}\[(.+)\]", text.strip())
        if own is None:
            wanted.append(f"'{text.strip()}'")
            continue
        for other in own[1].split(","):
            wanted += _wanted(requirements, other.strip())
    return wanted
