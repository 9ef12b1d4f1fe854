"""Completion for bash and zsh, and the man page, generated from the options of every command."""

import argparse
import os
from pathlib import Path
from typing import Any, Final

import shtab
from argparse_manpage.manpage import Manpage

from edge import __version__
from edge.cli.main import COMMANDS
from edge.cli.run_help import parser
from edge.inference.bundled import bundled_models

SHELLS: Final = {
    "bash": "bash-completion/completions/edge-sr",
    "zsh": "zsh/site-functions/_edge-sr",
}


def write_terminal_files(folder: Path) -> dict[Path, str]:
    """Write completions and man page below an empty folder; returns each file's path, and its place in a wheel."""
    texts = {place: shtab.complete(command_tree(), shell) for shell, place in SHELLS.items()}
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
