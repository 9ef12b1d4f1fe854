"""Models and demo recording that come with the package."""

import re
from pathlib import Path
from typing import Final

from edge.errors import ModelError, UsageError

BUNDLE_DIR: Final = Path(__file__).resolve().parents[1] / "models"
TAXELS_FILE: Final = BUNDLE_DIR / "taxels.npz"  # file of the estimator of dead taxels
CONTACTS_FILE: Final = (
    BUNDLE_DIR / "contacts.npz"
)  # distribution of contacts, by which a running sensor learns its gains
DEFAULT_MODEL: Final = "stsr-int8"  # model that assumes nothing of earlier taps
INT8_SUFFIX: Final = "-int8"
POSED_MODEL: Final = "mtsr-int8"  # default where poses of the pad come: it combines up to 7 taps
_OF_TAPS: Final = re.compile(r"(?<=^mtsr)[2-7](?=-int8$|$)")  # mtsr4, a name of the paper's, is mtsr given four taps


def bundled_models() -> list[Path]:
    """Return the files of the bundled models, by name."""
    return sorted(BUNDLE_DIR.glob("*.onnx"))


def find_model(name: str | Path) -> Path:
    """Return the file of a model, a path or a bundled name, with or without .onnx, or raise a ModelError.

    A name without its precision is the best file there is: that in float32, or where an installation lacks it, such as
    the wheel, that in 8-bit integers. The names mtsr2 to mtsr7 mean the file mtsr.
    """
    path = Path(name)
    if path.is_file():
        return path
    stem = _stem(name)
    folder = path.parent if path.parent.name else BUNDLE_DIR
    for of_taps in (stem, _OF_TAPS.sub("", stem)):
        for file in (folder / f"{of_taps}.onnx", folder / f"{of_taps}{INT8_SUFFIX}.onnx"):
            if stem and file.is_file():
                return file
    bundled = ", ".join(model.name for model in bundled_models()) or "none"
    raise ModelError(f"no model '{name}': neither a file nor bundled (bundled: {bundled})")


def taps_of(name: str | Path) -> int | None:
    """Return the number of taps that a bundled name states and its file does not, as mtsr4 does; else None."""
    stated = _OF_TAPS.search(_stem(name))
    return int(stated[0]) if stated and not _OF_TAPS.search(find_model(name).stem) else None


def _stem(name: str | Path) -> str:
    return Path(name).name.removesuffix(".onnx")


def demo_recording() -> Path:
    """Return the file of the recording that the demo plays, or raise a UsageError."""
    return _installed("demo.npz")


def example_recording() -> Path:
    """Return the file of a recording of two emulated fingers that grip things, or raise a UsageError."""
    return _installed("grip.npz")


def _installed(name: str) -> Path:
    path = BUNDLE_DIR / name
    if not path.is_file():
        raise UsageError(f"a recording is not installed: {path} is missing")
    return path
