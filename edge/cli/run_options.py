"""Options of a run or another command of `edge-sr`, as they were typed."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from edge.cli.run_help import HELP
from edge.errors import UsageError
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import Parser

_FIXED: Final[dict[str, dict[str, Any]]] = {
    "demo": {"sensor": None, "id_map": None, "force": False, "baseline": None, "poses": [], "give_up_s": None},
    "replay": {"source": [], "id_map": None, "give_up_s": None, "realtime": False, "poses": []},
}
"""Options of a run that a command of its kind does not have, with the values that they have there."""


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, or of `edge-sr` without one."""
    name, help_ = f"edge-sr {command}".rstrip(), HELP[command]
    made = Parser(prog=name, usage=f"{name} {help_.usage}", description=help_.about, epilog=help_.more)
    for listed in help_.groups:
        group = made if listed.title is None else made.add_argument_group(listed.title, listed.about)
        for one in listed.options:
            to = group.add_mutually_exclusive_group() if isinstance(one, tuple) else group
            for option in one if isinstance(one, tuple) else (one,):
                to.add_argument(option.name, **option.settings)
    made.set_defaults(**_FIXED.get(command, {}))
    return made


def understood(command: str, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options of a command, and check of a run all that can be checked before anything is opened."""
    options = parser(command).parse_args(arguments)
    if "sink" not in options:
        return options
    for text in options.sink:
        check_sink(text)
    check_apart(options.sink)
    if options.fields is not None:
        from edge.sinks.json_encoding import chosen_fields

        chosen_fields(options.fields)
        if not any(text.startswith("jsonl:") for text in options.sink):
            raise UsageError("--fields requires a sink of JSON records, such as --sink jsonl:-")
    for text in options.poses:
        from edge.pose_sources.open_poses import check_poses

        check_poses(text)
    runtime_options(options)
    return options


def runtime_options(options: argparse.Namespace) -> RuntimeOptions:
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults."""
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in asdict(DEFAULTS) if name in given})
