"""Runs of edge-sr and edge.api whose outcome is frozen: what they give, and how it is told apart from noise."""

import contextlib
import json
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard
from unittest import mock

import numpy as np
from cli_samples import run

SAMPLED = 15
"""Every so many records of a sensor one is kept whole, and the first two of each stretch of a state."""
OF_THE_RUN = {
    *("time_ns", "device_time_ns", "run_time_us", "latency_us", "counters", "baseline", "baseline_age_s", "event"),
    *("events", "note", "notes"),
}
"""Keys that differ from run to run, or are kept apart."""
RELATIVE, ABSOLUTE = 0.02, 2e-3
"""Tolerances: 8-bit integers differ between processors by a thousandth of a pattern, and by as much of an area."""
OWN_ABSOLUTE = {"force_counts": 1.0, "area_mm2": 3.0, "mean": 2e-3, "peak": 5e-3}


def edge_sr(folder: Path, *arguments: object) -> dict[str, Any]:
    """Run edge-sr with records on stdout, in this process since as many starts take half a minute."""
    with contextlib.chdir(folder), mock.patch.dict(os.environ, environment()):
        done = run(*arguments)
    return outcome(done.returncode, done.stdout, done.stderr)


def environment() -> dict[str, str]:
    return os.environ | {"COLUMNS": "80", "NO_COLOR": "1"}


def outcome(code: int, out: str, err: str) -> dict[str, Any]:
    """Return exit code, messages and records in short."""
    lines = [json.loads(line) if line.startswith("{") else line for line in out.splitlines()]
    records = [line for line in lines if isinstance(line, dict)]
    texts = [masked(line) for line in lines if isinstance(line, str)]
    return {"exit": code, "stdout": texts, "stderr": [masked(line) for line in err.splitlines()], **short(records)}


def masked(text: str) -> str:
    """Return a text without ids, paths of a folder and numbers."""
    return re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?", "#", re.sub(r"/\S*/|\b[0-9a-f]{8}\b", "", text))


def short(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return records in short: states in stretches, notes and events as they come, and some records whole."""
    sensors: dict[str, Any] = {}
    for record in records:
        if record["state"] == "event":
            sensors.setdefault("", {"events": []})["events"].append(masked(record["event"]))
            continue
        of = sensors.setdefault(record["sensor"], {"states": [], "notes": [], "events": [], "records": []})
        if not of["states"] or of["states"][-1][0] != record["state"]:
            of["states"].append([record["state"], 0])
        of["states"][-1][1] += 1
        note = record.get("note")
        if note is not None and (not of["notes"] or of["notes"][-1][1] != masked(note)):
            of["notes"].append([record["scan"], masked(note)])
        if record.get("event"):
            of["events"].append([record["scan"], masked(record["event"])])
        if record["scan"] % SAMPLED == 0 or of["states"][-1][1] <= 2:
            of["records"].append({key: brief(value) for key, value in record.items() if key not in OF_THE_RUN})
    return {"sensors": sensors}


def brief(value: Any) -> Any:
    """Return a value, an array as its mean, its peak and the place of it."""
    if isinstance(value, list) and value and isinstance(value[0], list) and len(value) > 2:
        numbers = np.array([[np.nan if one is None else one for one in row] for row in flat(value)], dtype=float)
        row, column = np.unravel_index(int(np.nanargmax(numbers)), numbers.shape)
        return {"mean": float(np.nanmean(numbers)), "peak": float(np.nanmax(numbers)), "at": [int(row), int(column)]}
    if isinstance(value, dict):
        return {key: brief(one) for key, one in value.items()}
    return value


def flat(value: list[Any]) -> list[Any]:
    while isinstance(value[0][0], list):
        value = [row for part in value for row in part]
    return value


def differences(frozen: Any, now: Any, place: str = "") -> list[str]:
    """Return where two outcomes differ by more than the tolerances, a line each."""
    key = place.rpartition(".")[2]
    if isinstance(frozen, dict) and isinstance(now, dict):
        missing, common = frozen.keys() ^ now.keys(), frozen.keys() & now.keys()
        changed = [f"{place}.{name}: only {'before' if name in frozen else 'now'}" for name in missing]
        return changed + [line for name in common for line in differences(frozen[name], now[name], f"{place}.{name}")]
    if isinstance(frozen, list) and isinstance(now, list):
        if key == "at" and all(isinstance(one, int) for one in frozen):
            near = max(abs(a - b) for a, b in zip(frozen, now, strict=True)) <= 2
            return [] if near else [f"{place}: {now}, was {frozen}"]
        if len(frozen) != len(now):
            return [f"{place}: {len(now)} entries, were {len(frozen)}: {now}, was {frozen}"[:600]]
        pairs = enumerate(zip(frozen, now, strict=True))
        return [line for n, (a, b) in pairs for line in differences(a, b, f"{place}.{n}")]
    if frozen == now or (is_number(frozen) and is_number(now) and close(frozen, now, key)):
        return []
    return [f"{place}: {now!r}, was {frozen!r}"]


def is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def close(frozen: float, now: float, key: str) -> bool:
    return math.isclose(frozen, now, rel_tol=RELATIVE, abs_tol=OWN_ABSOLUTE.get(key, ABSOLUTE))
