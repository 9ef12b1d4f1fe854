"""Models and demo recording that come with the package."""

from pathlib import Path
from typing import Final

from edge.errors import ModelError, UsageError

BUNDLE_DIR: Final = Path(__file__).resolve().parents[1] / "models"
TAXELS: Final = BUNDLE_DIR / "taxels.npz"
"""File of the estimator of dead taxels."""
CONTACTS: Final = BUNDLE_DIR / "contacts.npz"
"""File of the distribution of contacts by which a running sensor learns its gains."""
DEFAULT_MODEL: Final = "stsr-int8"
"""Model that assumes nothing of earlier taps."""
INT8_SUFFIX: Final = "-int8"
POSED_MODEL: Final = "mtsr7-int8"
"""Default where poses of the pad come: it combines up to 7 taps, and gives for one alone what DEFAULT_MODEL gives."""


def bundled_models() -> list[Path]:
    """Return the files of the bundled models, by name."""
    return sorted(BUNDLE_DIR.glob("*.onnx"))


def find_model(name: str | Path) -> Path:
    """Return the file of a model: a path, or a bundled name, with or without .onnx.

    A name without its precision is the best file there is: that in float32, or where an installation lacks it, such as
    the wheel, that in 8-bit integers.

    Raises:
        ModelError: there is none; the message lists the bundled ones.
    """
    path = Path(name)
    if path.is_file():
        return path
    stem = path.name.removesuffix(".onnx")
    folder = path.parent if path.parent.name else BUNDLE_DIR
    for file in (folder / f"{stem}.onnx", folder / f"{stem}{INT8_SUFFIX}.onnx"):
        if stem and file.is_file():
            return file
    bundled = ", ".join(model.name for model in bundled_models()) or "none"
    raise ModelError(f"no model '{name}': neither a file nor bundled (bundled: {bundled})")


def demo_recording() -> Path:
    """Return the file of the recording that the demo plays.

    Raises:
        UsageError: it is missing from this installation.
    """
    path = BUNDLE_DIR / "demo.npz"
    if not path.is_file():
        raise UsageError(f"the demo's recording is not installed: {path} is missing")
    return path
