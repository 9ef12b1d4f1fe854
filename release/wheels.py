"""Build both wheels: the runtime, and what a workstation needs beside it to train, export, measure and emulate.

    python release/wheels.py [FOLDER]

The second wheel holds all files of the packages that pyproject.toml leaves out of the first, so that no file is in both
and none in neither. It requires the first in the same version. The first also installs completion for bash and zsh, and
a man page, which are made of the options of every command.
"""

import argparse
import copy
import os
import tempfile
import tomllib
from pathlib import Path
from typing import Any, Final

import shtab
from argparse_manpage.manpage import Manpage
from hatchling.builders.wheel import WheelBuilder

from edge import __version__
from edge.cli.main import COMMANDS, parser
from edge.inference.bundled import bundled_models

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


def write_terminal_files(folder: Path) -> dict[Path, str]:
    """Write completions and man page below an empty folder; returns each file's path, and its place in a wheel."""
    places = {"bash": "bash-completion/completions/edge-sr", "zsh": "zsh/site-functions/_edge-sr"}
    texts = {place: shtab.complete(command_tree(), shell) for shell, place in places.items()}
    os.environ["COLUMNS"] = "72"  # of texts that a man page keeps as they are: 80 less the margin
    about = {"manual_title": "Tactile super-resolution", "description": "tactile super-resolution at the sensor's rate"}
    texts["man/man1/edge-sr.1"] = str(Manpage(command_tree(), {"version": __version__} | about))
    written = {}
    for place, text in texts.items():
        path = folder / place
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
        written[path] = f"share/{place}"
    return written


def command_tree() -> argparse.ArgumentParser:
    """Return one parser with the commands as subparsers: the form that both generators read."""
    tree = parser()
    commands: Any = tree.add_subparsers(title="commands", metavar="COMMAND")
    for name in COMMANDS:
        one = parser(name)
        commands.add_parser(
            name,
            parents=[one],
            add_help=False,
            conflict_handler="resolve",
            usage=one.usage,
            help=" ".join((one.description or "").split()),
            description=one.description,
            epilog=one.epilog,
        )
    for command in (tree, *commands.choices.values()):
        for action in command._actions:
            _complete(action)
    return tree


def _complete(action: Any) -> None:
    """Let an argument complete to files, folders or the bundled models."""
    if action.metavar in ("FILE", "OLD.json"):
        action.complete = shtab.FILE
    elif action.metavar == "DIR":
        action.complete = shtab.DIRECTORY
    elif "--model" in action.option_strings:
        action.choices = [path.stem for path in bundled_models()]


if __name__ == "__main__":
    options = argparse.ArgumentParser(description="Builds the wheel of the runtime, and that of training.")
    options.add_argument("folder", type=Path, nargs="?", default=ROOT / "dist", help="folder of both (default dist)")
    for wheel in build(options.parse_args().folder):
        print(wheel)
