"""Optional dependencies, the extras of pyproject.toml, and the messages where they are missing."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

_FOLDER: Final = Path(__file__).resolve().parent.parent
_PACKAGE: Final = "tactile-edge-sr"


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml, for the message that it is missing."""
    if (_FOLDER / "pyproject.toml").is_file():
        return f"pip install '{_FOLDER}[{extra}]'"
    from importlib.metadata import PackageNotFoundError, requires  # imported here, since it takes long

    try:
        wanted = _wanted(requires(_PACKAGE) or [], extra)
    except PackageNotFoundError:  # a copy of the sources that was never installed
        wanted = []
    return f"pip install {' '.join(wanted)}" if wanted else f"pip install '{_PACKAGE}[{extra}]'"


def need(extra: str, *modules: str) -> None:
    """Refuse to import a package with a missing extra; a command ends with this message alone.

    Raises:
        ModuleNotFoundError: modules of the extra are not installed.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if not missing:
        return
    why = f"not installed: {', '.join(missing)}; {how_to_install(extra)}"
    if sys.argv[:1] == ["-m"]:  # python -m imports the package to find the command in it
        sys.exit(why)
    raise ModuleNotFoundError(why, name=missing[0])


def _wanted(requirements: list[str], extra: str) -> list[str]:
    """Return the requirements of an extra from a package's metadata, each quoted for a shell."""
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
