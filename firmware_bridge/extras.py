"""Optional dependencies, the extras of pyproject.toml, and the messages where they are missing."""

import sys
from importlib.util import find_spec
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent.parent


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml, for the message that it is missing.

    Of an installed wheel pip needs its name alone, wherever it came from: it adds what the extra lacks.
    """
    where = _FOLDER if (_FOLDER / "pyproject.toml").is_file() else "tactile-edge-sr"
    return f"pip install '{where}[{extra}]'"


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
