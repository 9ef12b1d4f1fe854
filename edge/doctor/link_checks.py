"""Checks of the way from the sensor to here: CAN ids, counters, line speed, latency, rate, torn and lost scans."""

from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from edge.doctor.findings import Finding, graded, judged
from edge.doctor.taxel_checks import Samples
from firmware_bridge.links.serial_ports import LATENCY_ROOT
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import LATEST_SCAN_S
from firmware_bridge.zeroing.baseline import Baseline


@dataclass
class Watched:
    """Data of a watch while the pads were free."""

    scans: dict[str, list[Scan]] = field(default_factory=dict)  # of each sensor, in their order
    counters: Mapping[str, int] = field(default_factory=dict)  # of the link
    duration_s: float = 0.0  # length of the watch so far, in [s]
    stopped: bool = False  # whether it ended before its time, at a user's wish
    port: str | None = None  # of a serial adapter; None for other links
    baud: int | None = None  # speed at which its line was opened, in bit/s
    latency_ms: int | None = None  # time for which the adapter's driver holds bytes back; None where it is not shown
    ids: frozenset[int] = frozenset()  # the CAN ids that came; empty where the link sees none
    model: ModelMap = USPA44_MAP  # the id map that the user chose
    rate_hz: float | None = None  # that a user expects of each sensor, in [Hz]
    references: Mapping[str, Baseline] = field(default_factory=dict)  # earlier baselines of the free pads, by sensor
    until_ns: int | None = None  # end of the watch, on the clock of the scans in [ns]; None stands for the newest scan
    mountings: Mapping[str, Mounting] = field(default_factory=dict)  # of the sensors, as far as they are available


def check_id_map(watched: Watched, half_silent: bool) -> Finding | None:
    """Check the id map by the CAN ids that came, and by whether some sensor is half silent; None if none came."""
    ids, model = watched.ids, watched.model
    if not ids:
        return None
    norm = "every taxel of a sensor by its id"
    whole = _whole_sensors(ids, model)
    others = {name: _whole_sensors(ids, other) for name, other in ID_MAPS.items() if name != model.name}
    # The ids of a smaller pad may be among those of a larger one: then the larger one is on the bus.
    sizes = {name: ID_MAPS[name].geometry.taxel_count for name, sensors in others.items() if sensors}
    largest = max(sizes.values(), default=0)
    others = {name: others[name] for name, size in sizes.items() if size == largest}
    if whole and not half_silent and largest <= model.geometry.taxel_count:
        return Finding("id map", "ok", f"{model.name}, all ids of sensor {', '.join(whole)} received", norm)
    if others:
        owners = " or ".join(f"{name} (sensor {', '.join(sensors)})" for name, sensors in others.items())
        tries = " or ".join(f"--id-map {name}" for name in others)
        measured = f"the ids received are not {model.name}'s but those of {owners}"
        return Finding("id map", "wrong", measured, norm, tries)
    mapped = [can_id for can_id in ids if can_id in model.taxels]
    shown = ", ".join(f"0x{can_id:03x}" for can_id in sorted(ids)[:8]) + ", ..." * (len(ids) > 8)
    measured = f"{len(ids)} ids received, {len(mapped)} of them {model.name}'s: {shown}"
    remedy = "no map has all of these ids: half of the sensor may be broken, or other devices share the bus"
    return judged("id map", "wrong" if half_silent or not mapped else "ok", measured, norm, remedy)


def _whole_sensors(ids: AbstractSet[int], model: ModelMap) -> list[str]:
    """Return the sensors of a model whose ids all came."""
    taxels: Counter[str] = Counter(sensor for can_id, (sensor, _) in model.taxels.items() if can_id in ids)
    return [sensor for sensor, count in taxels.items() if count == model.geometry.taxel_count]


BITS_PER_BYTE: Final = 10  # bits of a byte on a serial line: eight, a start bit and a stop bit
FULL_SHARE: Final = 0.9
_BAD_LIMITS: Final = (1e-4, 1e-2)


def check_link(watched: Watched) -> Finding | None:
    """Check the link by its counters; None where they count neither bytes nor frames."""
    counters = watched.counters
    received, frames = counters.get("received_bytes"), counters.get("frames")
    refusals = counters.get("refusals", 0)
    if received is None or frames is None:
        return _trouble(counters)
    measured = f"{received} bytes, {frames} frames in {watched.duration_s:.0f} s"
    refused = f", {refusals} refusals" if refusals else ""
    off = (
        "is the sensor powered? The VScom needs both USB plugs, power first; the bus runs at 1 Mbit/s; a controller "
        "from before 2021 speaks only with --id-map A or B"
    )
    if not received:
        return Finding("link", "wrong", measured, "", off)
    if not frames and received >= 64:  # fewer are the adapter's answers to commands
        remedy = "not slcan, or another line speed than the adapter's: try --source slcan:PORT@BAUD (VScom 3000000)"
        return Finding("link", "wrong", measured, "", remedy)
    if not frames:
        remedy = (
            "the adapter does not obey: its channel is held open or its bitrate is not 1 Mbit/s; end slcand, "
            "xela_server and every other program that holds it, pull its plug and put it in again"
        )
        return Finding("link", "wrong", measured + (refused or ", answers only"), "", remedy if refusals else off)
    bad = counters.get("bad_lines", 0) + counters.get("non_ascii_lines", 0)
    measured += f", {bad} bad lines{refused}"
    verdict = "ok" if bad <= 1 else graded(bad / (bad + frames), *_BAD_LIMITS)
    if verdict != "ok":
        remedy = "bytes are lost or garbled: a poor cable or hub, another line speed, or no RTS/CTS at the adapter"
        return Finding("link", verdict, measured, f"under {100 * _BAD_LIMITS[0]:.2f} % bad lines", remedy)
    return _trouble(counters) or Finding("link", "ok", measured)


def check_baud(watched: Watched, sensors: int) -> Finding | None:
    """Check that the serial line carries what so many sensors on the bus send; None where there is no serial line."""
    counters, duration_s, baud = watched.counters, watched.duration_s, watched.baud
    frames, received = counters.get("frames", 0), counters.get("received_bytes", 0)
    if baud is None or not frames or not sensors or duration_s <= 0:
        return None
    line_bytes = 26 if received / frames > 24 else 22  # of a taxel's slcan line with a time stamp, and without one
    carries_hz = baud / BITS_PER_BYTE / (line_bytes * watched.model.geometry.taxel_count * sensors)
    used = received * BITS_PER_BYTE / duration_s / baud
    pads = f"{sensors} sensors" if sensors > 1 else "a sensor"
    measured = f"{baud} baud carry {carries_hz:.0f} scans a second of {pads}, {100 * used:.0f} % are used"
    norm = f"under {100 * FULL_SHARE:.0f} % used"
    remedy = "open a faster line: --source slcan:PORT@3000000, and set the adapter to the same (slcand -S 3000000)"
    if used > 1.05:
        return Finding("baud rate", "ok", f"{measured}: this adapter goes by USB and ignores it", norm)
    if used > FULL_SHARE:
        return Finding("baud rate", "wrong", measured, norm, remedy)
    slow = carries_hz < (watched.rate_hz or 100.0) and "ttyACM" not in (watched.port or "")
    return judged("baud rate", "look" if slow else "ok", measured, norm, remedy)


def check_latency(watched: Watched) -> Finding | None:
    """Check that the adapter's driver passes bytes on as they come; None where it does not show its timer."""
    if watched.latency_ms is None:
        return None
    port = Path(watched.port or "").resolve().name
    shown = f"{LATENCY_ROOT}/{port if port.startswith('ttyUSB') else 'ttyUSBn'}/latency_timer"
    remedy = f"echo 1 | sudo tee {shown}, and a udev rule that does so at each plug-in"
    verdict = "wrong" if watched.latency_ms > 2 else "ok"
    return judged("latency timer", verdict, f"{watched.latency_ms} ms", "up to 2 ms", remedy)


def _trouble(counters: Mapping[str, int]) -> Finding | None:
    """Check the other counters of an adapter, by words in their names."""
    words = ("overrun", "overflow", "error", "lost")
    troubles = [f"{name} {n}" for name, n in counters.items() if n > 0 and any(word in name for word in words)]
    if not troubles:
        return None
    remedy = "the adapter loses frames: check the termination of the bus, and end what else loads this machine"
    return Finding("link", "look", ", ".join(troubles), "none", remedy)


_LOSS_LIMITS: Final = (0.001, 0.01)
_OLD_LIMITS: Final = (0.1, 0.3)
_LOSS_REMEDY: Final = (
    "frames are lost on the way: check the plugs and the termination of the bus, end what else loads this machine, "
    "and try another USB port without a hub"
)


def check_rate(samples: Samples, wanted_hz: float | None, line_full: bool) -> Finding:
    """Check the scans and the new readings a second, in [Hz]; on a full line the sensor's own rate cannot be seen."""
    rate_hz = 1 / samples.period_s()
    new_hz = samples.renewed[:, samples.living & ~samples.stuck()].mean(axis=0) * rate_hz
    taxels = f", taxels renewed {new_hz.min():.1f} to {new_hz.max():.1f} Hz" if new_hz.size else ""
    measured = f"{rate_hz:.1f} scans a second{taxels}"
    # Measured on sensors of sixteen taxels are 74 to 113 scans a second.
    low, high = (70.0, 120.0) if wanted_hz is None else (0.9 * wanted_hz, 1.1 * wanted_hz)
    norm = f"{low:.0f} to {high:.0f} Hz"
    if line_full:
        return Finding("rate", "not known", measured, norm, "the line is full: see baud rate")
    remedy = "harmless, if the processor keeps up: state the expected rate with --rate-hz"
    if rate_hz < low:
        remedy = "set the sensor's rate in its controller, or state the expected one with --rate-hz"
    return judged("rate", "ok" if low <= rate_hz <= high else "look", measured, norm, remedy)


def check_torn(samples: Samples) -> Finding:
    """Check the share of scans that lack a taxel, or in which part of the taxels are old readings."""
    torn, old = float(samples.torn().mean()), float(samples.half_old().mean())
    measured = f"{100 * torn:.2f} % lack a taxel, {100 * old:.2f} % hold old readings"
    norm = f"under {100 * _LOSS_LIMITS[0]:.1f} % and {100 * _OLD_LIMITS[0]:.0f} %"
    verdict = graded(torn, *_LOSS_LIMITS)
    if verdict != "ok":
        missing = np.where(samples.living, (~samples.fresh).mean(axis=0), 0)
        most = int(missing.argmax())
        only = missing[most] > 0.8 * missing.sum()
        remedy = f"taxel {most} comes and goes: its connection may be broken" if only else _LOSS_REMEDY
        return Finding("torn scans", verdict, measured, norm, remedy)
    remedy = "the sender of these scans repeats itself: lower its rate to that of the sensor"
    return judged("torn scans", graded(old, *_OLD_LIMITS), measured, norm, remedy)


def check_lost(samples: Samples, silent_s: float) -> Finding:
    """Check the share of scans that never came, by the gaps they left; none came for `silent_s` at the end."""
    if silent_s > LATEST_SCAN_S:
        remedy = "the sensor fell silent: check its power and its plug"
        return Finding("lost scans", "wrong", f"all of the last {silent_s:.0f} s", "", remedy)
    lost = samples.lost()
    gap_ms = 1000 * float(np.diff(samples.time_s).max())
    measured = f"{lost} of {lost + samples.scans}, longest gap {gap_ms:.0f} ms"
    norm = f"under {100 * _LOSS_LIMITS[0]:.1f} %"
    return judged("lost scans", graded(lost / (lost + samples.scans), *_LOSS_LIMITS), measured, norm, _LOSS_REMEDY)
