"""How long silence may last before it means something: every threshold, and why it has its value.

Two figures decide most of them. The slowest sensor on record renews a taxel four times a second, so a quarter of a
second without a reading is no silence; and an adapter hands on what it holds after 16 ms at the latest. Thresholds of
one reading or scan are in [ns], on the clock of the scans; those of a wait for something are in [s].
"""

from typing import Final

SLOWEST_PERIOD_NS: Final = 250_000_000
"""Between two scans of the slowest sensor on record."""

# ---- A sensor ----

SENSOR_SILENT_NS: Final = 2 * SLOWEST_PERIOD_NS
"""Without a scan, while another sensor goes on, a sensor is told to be silent, and the page draws it grey."""
TAPS_FORGOTTEN_NS: Final = 4 * SLOWEST_PERIOD_NS
"""Without a scan, what a sensor felt before is worth nothing: a tap is over within."""
SCAN_GIVEN_UP_NS: Final = 4 * SLOWEST_PERIOD_NS
"""After its first reading a scan that is not whole is waited for no longer: older readings are another scan's."""
SERVER_READING_OLD_NS: Final = 4 * SLOWEST_PERIOD_NS
"""A reading older than this when the vendor's server sends it is one of a sensor that is heard no more."""
TAXEL_SILENT_SCANS: Final = 50
"""Scans without a taxel after which it is not lost for a moment: the user is told, and zeroing goes on without it."""
LATEST_SCAN_S: Final = 2.0
"""The doctor finds a sensor wrong whose last scan is older than this when the watching ends."""

# ---- A link ----

LINK_SILENT_S: Final = 0.7
"""Without a scan, a link is closed and opened again: an adapter that was reset keeps its port and says nothing until
its channel is opened anew. It is a little more than a sensor's silence, which it would else be taken for."""
ADAPTER_ASKED_NS: Final = 500_000_000
"""Without a scan, an adapter is asked for its status, for then there is something to learn; before the link is opened
again."""
SERVER_QUIET_S: Final = 0.75
"""Without a message, the vendor's server is asked whether it is there."""

# ---- A person, or a program that waits ----

SHOWN_SILENT_S: Final = 1.0
"""Without a scan, the status line and the diagnostics say so; below, a person would see it flicker."""
GIVEN_UP_S: Final = 10.0
"""Without a scan, zeroing and the doctor give up: a sensor that is plugged in meanwhile has come by then."""
POLL_S: Final = 0.1
"""How long a stop, a command or a silent link may go unnoticed: every wait for scans is cut in pieces of it."""
