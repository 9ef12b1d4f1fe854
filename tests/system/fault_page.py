"""Page about a run among faults: promises, accounts, losses and latencies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from fault_accounts import CONSISTENT, DIFFERENT, EQUAL, Account, accounts
from fault_judge import READY_US, Found
from fault_log import Told
from fault_outages import LONGEST_BACK_S, seconds_to_use
from fault_records import Ran
from fault_run import CALM_S
from fault_server import GARBAGE_EVERY, ServerFound, ServerRan
from fault_stretches import LINK_FAULTS
from soak import slope

from edge.bench.live_report import head, line

EXIT_SINK: Final = 5
MEMORY_MB_PER_MINUTE: Final = 0.2
FEWEST_SIZES: Final = 60
"""Sizes of a minute: in less time, allocations of the start look like growth."""
SINKS_GIVEN_UP: Final = 4
_GIVEN_UP: Final = "the other sinks continue"
"""Words on stderr about each sink given up; a record of it may be left out where its reader is slow."""


@dataclass(frozen=True, slots=True)
class Promise:
    """Promise of the program, and what the run showed of it."""

    text: str
    seen: str
    kept: bool


def promises(ran: Ran, found: Found, told: Told) -> list[Promise]:
    """Return all promises, in order of weight."""
    books = accounts(found, told, ran.said)
    wrong = [book.name for book in books if book.verdict == DIFFERENT]
    back_s = seconds_to_use(found, told, LINK_FAULTS)
    sinks = ran.said.count(_GIVEN_UP)
    growth, half = _memory(ran)
    third = max(len(ran.sizes) // 3, 1)
    early, late = (max((s.descriptors for s in part), default=0) for part in (ran.sizes[:third], ran.sizes[-third:]))
    steps = ran.clock_steps_s
    back = _steps_back(ran)
    return [
        Promise(
            "the process ends when it is asked to, with the code of the sinks that failed",
            f"exit code {ran.exit_code}",
            ran.exit_code == EXIT_SINK and "Traceback" not in ran.said,
        ),
        Promise("no reading is made up", f"{found.made_up} of {found.shown}", found.shown > 0 and not found.made_up),
        Promise(
            "no pattern from stale or made-up readings without saying so",
            f"{len(found.false_patterns)} of {found.patterns}" + _first(found.false_patterns),
            found.patterns > 0 and not found.false_patterns,
        ),
        Promise(
            "no whole scan mixes two cycles",
            f"{len(found.mixed)} of {found.whole - found.unstamped}" + _first(found.mixed),
            found.whole > found.unstamped and not found.mixed,
        ),
        Promise("losses are counted: the accounts of both sides agree", _agreement(books) + _first(wrong), not wrong),
        Promise(
            f"a link that is back, its cable in again (under another name too) or its adapter reset, is used within "
            f"{LONGEST_BACK_S:g} s",
            f"{len(back_s)} times, at most {max(back_s):.2f} s" if back_s else "no outage was measured",
            bool(back_s) and max(back_s) <= LONGEST_BACK_S,
        ),
        Promise(
            "a sink that fails is dropped and told, the others go on",
            f"{sinks} told, {found.records} records",
            sinks == SINKS_GIVEN_UP,
        ),
        Promise(
            "files that could not go on, and what slow readers got, are whole records",
            f"{ran.slow} to the slow reader, {ran.unwritten} left out for it" + _first(ran.broken),
            not ran.broken,
        ),
        Promise(
            "steps of the wall clock move nothing, the age of the baseline included",
            f"{len(steps)} jumps of it; {back} scans back in time",
            not steps and back == 0,
        ),
        Promise(
            f"memory grows by less than {MEMORY_MB_PER_MINUTE:g} MB a minute, descriptors by none",
            f"{growth:+.3f} (+- {half:.3f}); {early} descriptors at most, at last {late}",
            growth - half < MEMORY_MB_PER_MINUTE and late <= early,
        ),
    ]


def show(ran: Ran, found: Found, told: Told, say: Callable[[str], object]) -> bool:
    """Show the whole run; return True where every promise was kept."""
    kept = promises(ran, found, told)
    say("\n## Promises\n\n" + head(("promise", "seen", "kept")))
    for promise in kept:
        say(_promise_line(promise))
    say(_patterns(found))
    say("\n## Faults\n\n" + head(("fault", "times", "frames struck", "used again s p50", "max")))
    for row in _faults(found, told):
        say(line(row))
    say("\n## Accounts\n\n" + head(("", "injector", "edge-sr", "tolerance", "verdict")))
    for book in accounts(found, told, ran.said):
        say(_book_line(book))
    say(_losses(found, told))
    say("\n## Latency\n\n" + head(("last byte handed on to record read, us", "patterns", "p50", "p99", "max")))
    for name, latencies_us in _latencies(found, told):
        figures = ["-"] * 3
        if latencies_us:
            figures = [f"{value:.0f}" for value in (*np.percentile(latencies_us, (50, 99)), max(latencies_us))]
        say(line((name, str(len(latencies_us)), *figures)))
    return all(promise.kept for promise in kept)


def show_server(ran: ServerRan, found: ServerFound, say: Callable[[str], object]) -> bool:
    """Show the run against the server; return True where every promise was kept."""
    kept = [
        Promise("the process ends well", f"exit code {ran.exit_code}", ran.exit_code == 0),
        Promise(
            "no reading is made up",
            f"{found.made_up} in {found.records} records",
            found.records > 0 and not found.made_up,
        ),
        Promise(
            "no pattern of readings that lie apart",
            f"{found.apart} of {found.patterns}",
            found.patterns > 0 and not found.apart,
        ),
        Promise(
            f"a server that is back is used within {LONGEST_BACK_S:g} s",
            f"{len(found.back_s)} of {len(ran.down)} times, at most {max(found.back_s, default=0.0):.2f} s",
            0 < len(found.back_s) == len(ran.down) and max(found.back_s, default=0.0) <= LONGEST_BACK_S,
        ),
    ]
    names = [name for name, _, _ in ran.down]
    say(
        f"\n## Server\n\nxela_server, killed {names.count('killed')} times and hung {names.count('frozen')} times for "
        f".3 to 1.5 s; one message in {GARBAGE_EVERY} is followed by nonsense.\n\n" + head(("promise", "seen", "kept"))
    )
    for promise in kept:
        say(_promise_line(promise))
    return all(promise.kept for promise in kept)


def _promise_line(promise: Promise) -> str:
    return line((promise.text, promise.seen, "yes" if promise.kept else "no"))


def _patterns(found: Found) -> str:
    spread_ms, held_ms = max(found.spread_ms, default=0.0), max(found.held_ms, default=0.0)
    ready_ms = max(found.ready_ms, default=0.0)
    return (
        f"\n{found.records} records, {found.patterns} patterns: {found.whole_patterns} from sixteen readings as they "
        f"were sent, {found.told_patterns} from fewer, and the record says so. The readings of one pattern were on the "
        f"bus at most {spread_ms:.0f} ms apart; one that `fresh` says is held was at most {held_ms:.0f} ms older. A "
        f"pattern was ready at most {ready_ms:.0f} ms after its newest reading was handed on; above "
        f"{READY_US / 1e3:.0f} ms its note says so. {found.left_out} records between others were left out, since the "
        f"evaluation read too slowly.\n\n"
        f"What no reader can know: {found.flipped_patterns} patterns hold a reading in which a digit was changed on "
        f"the way, which the wire has no checksum against; {found.stuck_patterns} one of a stuck taxel that was lost "
        f"when it was sent first, so that it looked new. Of {found.whole} whole scans, those without a missing taxel, "
        f"{found.flipped_whole} hold a changed digit and {found.stuck_whole} a reading that a stuck taxel sent in more "
        f"than one cycle: their cycle is judged by the other readings. {found.unstamped} came without a time stamp of "
        f"the adapter, so that a gap which was read late is not seen; of these {found.unstamped_mixed} mix two cycles, "
        f"which the promise does not count."
    )


def _faults(found: Found, told: Told) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    fates, begun = told.accounts["fates"], told.accounts["begun"]
    for name in sorted(begun):
        back_s = seconds_to_use(found, told, (name,))
        used = [f"{np.median(back_s):.2f}", f"{max(back_s):.2f}"] if back_s else ["-", "-"]
        struck = str(told.accounts["noise"] if name == "garbage" else fates.get(name, 0) or "-")
        rows.append((name, str(begun[name]), struck, *used))
    rows += [(f"({name})", "-", str(fates.get(name, 0)), "-", "-") for name in ("unheard", "unread", "overflow")]
    return rows


def _book_line(book: Account) -> str:
    return line((book.name, str(book.injected), str(book.counted), book.tolerance, book.verdict))


def _agreement(books: Sequence[Account]) -> str:
    verdicts = [book.verdict for book in books]
    parts = [f"{verdicts.count(EQUAL)} of {len(books)} equal"]
    parts += [f"{book.name} {CONSISTENT}, {book.tolerance}" for book in books if book.verdict == CONSISTENT]
    return "; ".join(parts)


def _losses(found: Found, told: Told) -> str:
    sent = sum(told.accounts["fates"].values())
    cycles = vanished_scans(found, told)
    return (
        f"\nOf {sent} frames on the bus, repeated and foreign ones included, {found.shown} are in records. "
        f"{cycles} scans left no trace, since nothing on the wire numbers them; `missed` estimates "
        f"{found.last_counters.get('missed', 0)}."
    )


def vanished_scans(found: Found, told: Told) -> int:
    """Return the cycles of all sensors from their first record to the last, less the records."""
    total = 0
    for sensor in found.first_us:
        inside = (told.frames["bus_us"] >= found.first_us[sensor]) & (told.frames["bus_us"] <= found.last_us[sensor])
        mine = told.frames["can_id"] == int(sensor)  # its first taxel alone, which is one frame a cycle
        total += len(np.unique(told.frames["cycle"][inside & mine]))
    return total - found.records


def _latencies(found: Found, told: Told) -> list[tuple[str, list[float]]]:
    first_ns = min((event["time_ns"] for event in told.events), default=0)
    return [
        (f"first {CALM_S:g} s, without faults", [us for at_ns, us in found.latencies if at_ns < first_ns]),
        ("among faults", [us for at_ns, us in found.latencies if at_ns >= first_ns]),
    ]


def _steps_back(ran: Ran) -> int:
    """Return the number of records that are older than the one before of their sensor."""
    newest_ns: dict[str, int] = {}
    back = 0
    for one in ran.seen:
        if one.counts is not None:
            back += one.head["time_ns"] < newest_ns.get(one.head["sensor"], 0)
            newest_ns[one.head["sensor"]] = one.head["time_ns"]
    return back


def _memory(ran: Ran) -> tuple[float, float]:
    late = ran.sizes[len(ran.sizes) // 4 :]
    if len(late) < FEWEST_SIZES:
        return 0.0, 0.0
    return slope([size.time_s / 60 for size in late], [size.resident_mb for size in late])


def _first(texts: Sequence[str]) -> str:
    return f": {texts[0]}" if texts else ""
