"""Thresholds of silence: times without data after which the bridge reacts; of readings in [ns], of waits in [s].

The slowest sensor on record renews a taxel four times a second, so a quarter of a second without a reading is no
silence; and an adapter hands on its data after 16 ms at the latest.
"""

from typing import Final

SLOWEST_PERIOD_NS: Final = 250_000_000
"""Time between two scans of the slowest sensor on record, in [ns]."""

# ---- A sensor ----

SENSOR_SILENT_NS: Final = 2 * SLOWEST_PERIOD_NS
"""Time without a scan after which a sensor is reported silent, if another one goes on, and drawn grey."""
TAPS_FORGOTTEN_NS: Final = 4 * SLOWEST_PERIOD_NS
"""Time without a scan after which earlier taps are dropped: a tap is over by then."""
SCAN_GIVEN_UP_NS: Final = 4 * SLOWEST_PERIOD_NS
"""Time after its first reading at which an incomplete scan is given up: later readings are another scan's."""
SERVER_READING_OLD_NS: Final = 4 * SLOWEST_PERIOD_NS
"""Age at which a reading from the vendor's server belongs to a silent sensor."""
TAXEL_SILENT_SCANS: Final = 50
"""Scans without a taxel after which its loss is reported, and zeroing goes on without it."""
POSES_SILENT_NS: Final = SENSOR_SILENT_NS
"""Time without a pose, after one that does not hold, after which its source is reported silent: some scans were without
one by then."""
LATEST_SCAN_S: Final = 2.0
"""Age of the last scan at the end of its watch above which the doctor reports a sensor."""

# ---- A link ----

LINK_SILENT_S: Final = 0.7
"""Time without a scan after which a link is opened again: a little more than a sensor's silence, which must not."""
ADAPTER_ASKED_NS: Final = 500_000_000
"""Time without a scan after which an adapter's status, which can explain the silence, is requested."""
SERVER_QUIET_S: Final = 0.75
"""Time without a message after which the vendor's server is pinged."""

# ---- A person, or a program that waits ----

SHOWN_SILENT_S: Final = 1.0
"""Time without a scan after which the status line and the diagnostics report it, in [s]: below, they would flicker."""
SHOWN_AT_REST_S: Final = 0.1
"""Longest time for which the scans of sensors at rest may wait until a person sees them, in [s]: the status line is
rewritten as seldom."""
GIVEN_UP_S: Final = 10.0
"""Time without a scan after which zeroing and the doctor give up: a sensor just plugged in has come by then."""
POLL_S: Final = 0.25
"""Longest time until a stop, a command or a silent link is noticed, in [s]: waits for scans are cut in such pieces.
Scans at rest come more often, so that these waits seldom end before them: each end wakes two threads."""
