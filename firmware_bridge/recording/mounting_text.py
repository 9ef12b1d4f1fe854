"""Mounting of a sensor as text in recordings."""

import json
from dataclasses import asdict

from firmware_bridge.scans.mounting import Mounting


def mounting_text(mounting: Mounting) -> str:
    """Return a mounting as JSON, without its number of taxels, which the scans show."""
    fields = asdict(mounting)
    del fields["taxel_count"]
    return json.dumps(fields)


def read_mounting(text: str, taxel_count: int) -> Mounting:
    """Return the mounting in a text of `mounting_text`.

    Raises:
        ValueError: it is none, or none of so many taxels.
    """
    try:
        fields = json.loads(text)
        order, signs, gains = (tuple(fields[key]) for key in ("order", "signs", "gains"))
        if not all(type(value) is int for value in (*order, *signs)) or type(fields["swap_xy"]) is not bool:
            raise ValueError("not whole numbers")
        return Mounting(order, fields["swap_xy"], signs, tuple(map(float, gains)), taxel_count)
    except (TypeError, KeyError, RecursionError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())[:120] or type(error).__name__) from error
