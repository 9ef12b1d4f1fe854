"""Build both wheels: the runtime, and what a workstation needs beside it to train, export, measure and emulate.

    python release/wheels.py [FOLDER]

The second wheel holds all files of the packages that pyproject.toml leaves out of the first, so that no file is in both
and none in neither. It requires the first in the same version.
"""

import argparse
import copy
import tempfile
import tomllib
from pathlib import Path
from typing import Any, Final

from hatchling.builders.wheel import WheelBuilder
from terminal_files import write_terminal_files

from edge import __version__

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ["firmware_bridge", "edge", "train", "export"]


def runtime_settings(project: dict[str, Any], shared: dict[Path, str]) -> dict[str, Any]:
    """Return the settings of pyproject.toml, with files, by path, and their places beside the packages."""
    settings = copy.deepcopy(project)
    _wheel(settings)["shared-data"] = {str(path): place for path, place in shared.items()}
    return settings


def training_settings(project: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of the second wheel: the packages without the files of the first."""
    settings = copy.deepcopy(project)
    first = [f"/{file.distribution_path}" for file in _builder(project).recurse_included_files()]
    _wheel(settings).update(packages=PACKAGES, exclude=first)
    about = settings["project"]
    extras = about.pop("optional-dependencies")
    wanted = [one for extra in ("train", "export") for one in extras[extra] if not one.startswith(about["name"])]
    about.update(
        name="tactile-edge-sr-train",
        description="Training, export, bench and emulation for tactile-edge-sr.",
        dependencies=[f"{about['name']}=={__version__}", *dict.fromkeys(wanted)],
    )
    del about["scripts"]
    return settings


def build(folder: Path) -> list[Path]:
    """Build both wheels into a folder; returns their paths."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as temporary:
        shared = write_terminal_files(Path(temporary))
        both = [runtime_settings(project, shared), training_settings(project)]
        return [
            Path(path)
            for settings in both
            for path in _builder(settings).build(directory=str(folder), versions=["standard"])
        ]


def _builder(settings: dict[str, Any]) -> WheelBuilder:
    return WheelBuilder(str(ROOT), config=settings)


def _wheel(settings: dict[str, Any]) -> dict[str, Any]:
    return settings["tool"]["hatch"]["build"]["targets"]["wheel"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Builds the wheel of the runtime, and that of training.")
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "dist", help="folder of both (default dist)")
    for wheel in build(parser.parse_args().folder):
        print(wheel)
