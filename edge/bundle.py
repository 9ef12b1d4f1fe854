"""The models and the demo recording that come with the package."""

from pathlib import Path
from typing import Final

from edge.errors import ModelError, UsageError

BUNDLE_DIR: Final = Path(__file__).parent / "models"
DEFAULT_MODEL: Final = "stsr"
"""Takes nothing for granted: a model of several taps is wrong, and looks right, where the taps before were of another
object or the pad was not turned."""
DEMO_MODEL: Final = "mtsr4"
"""The demo's taps are turned as this one expects."""


def bundled_models() -> list[Path]:
    """Files of the bundled models, by name."""
    return sorted(BUNDLE_DIR.glob("*.onnx"))


def find_model(name: str | Path) -> Path:
    """File of a model: a path that exists, else a bundled name with or without .onnx.

    Raises:
        ModelError: neither; the bundled ones are listed.
    """
    path = Path(name)
    if path.is_file():
        return path
    for model in bundled_models():
        if str(name) in (model.name, model.stem):
            return model
    bundled = ", ".join(model.name for model in bundled_models()) or "none"
    raise ModelError(f"no model '{name}': neither a file nor bundled (bundled: {bundled})")


def demo_recording() -> Path:
    """File of the recording that the demo plays.

    Raises:
        UsageError: it did not come with this package.
    """
    path = BUNDLE_DIR / "demo.npz"
    if not path.is_file():
        raise UsageError(f"the demo's recording is not installed: {path} is missing")
    return path
