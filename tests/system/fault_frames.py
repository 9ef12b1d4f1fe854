"""Faults of frames on the bus."""

import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP

INTACT: Final = "intact"
READ: Final = (INTACT, "reordered", "repeated", "stuck", "foreign", "flipped")
"""Fates of frames that reach the reader; the last three hold a reading that no taxel had in that cycle."""
FOREIGN_ID: Final = 0x740


class BusFrame(NamedTuple):
    """Frame on the bus and its fate so far.

    Attributes:
        time_s: time on the bus, in [s] from the first scan.
        frame: the frame in its present state.
        cycle: number of earlier frames of its id.
        fate: one of READ, or the cause of its loss.
    """

    time_s: float
    frame: CanFrame
    cycle: int
    fate: str = INTACT

    @property
    def lost(self) -> bool:
        """True if the reader never gets it."""
        return self.fate not in READ


class FrameFault(ABC):
    """Fault on the bus during an interval."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        """Begin the fault.

        Args:
            draw: source of all random numbers.
            parameter: parameter as the user wrote it, empty for the usual one.

        Raises:
            ValueError: the parameter is invalid.
        """
        self.draw = draw

    @abstractmethod
    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Yield the frames that replace a frame that is not lost yet."""

    def winds_down(self) -> bool:
        """Start no further disturbance; return False while one is under way."""
        return True

    def end(self) -> Iterator[BusFrame]:
        """Return the frames still held back at the end of the fault."""
        return iter(())


class Chance(FrameFault):
    """Fault that strikes a share of the frames, by default `usual_share`."""

    usual_share = 0.02

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._share = share(parameter, self.usual_share)

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Strike the frame by chance, or pass it on."""
        return self.strike(sent) if self.draw.random() < self._share else self.spare(sent)

    def spare(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Pass the frame on."""
        yield sent

    @abstractmethod
    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Yield the frames that replace the struck one."""


class Lost(Chance):
    """Frames that are lost, as when a queue in the adapter overflows."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Mark the frame as lost."""
        yield sent._replace(fate="lost")


class Repeated(Chance):
    """Frames that come twice in a row."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Yield the frame twice."""
        yield sent
        yield sent._replace(fate="repeated")


class Reordered(Chance):
    """Frames that change places with the next one."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._held: list[BusFrame] = []

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Hold the frame back, unless another one is held back."""
        if self._held:
            yield from self.spare(sent)
        else:
            self._held.append(sent._replace(fate="reordered"))

    def spare(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Yield the frame before the one that is held back."""
        yield sent
        yield from self.end()

    def end(self) -> Iterator[BusFrame]:
        """Yield the frame that is held back."""
        held, self._held = self._held, []
        yield from held


class Foreign(Chance):
    """Frames of another device on the bus."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Yield a foreign frame before the frame."""
        frame = CanFrame(FOREIGN_ID | self.draw.randrange(16), self.draw.randbytes(8))
        yield BusFrame(sent.time_s, frame, 0, "foreign")
        yield sent


class OneTaxel(FrameFault):
    """Fault of one taxel: SENSOR.TAXEL, or that of a frame drawn at random."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._can_id: int | None = None
        if parameter:
            sensor, _, taxel = parameter.partition(".")
            ids = {f"{place[0]}.{place[1]}": can_id for can_id, place in USPA44_MAP.taxels.items()}
            self._can_id = ids.get(f"{sensor}.{taxel}")
            if self._can_id is None:
                raise ValueError(f"taxel is {parameter!r}, expected SENSOR.TAXEL, such as 4.11")

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Strike a frame of the taxel, or pass another one on."""
        if self._can_id is None and sent.fate != "foreign" and self.draw.random() < 1 / 16:
            self._can_id = sent.frame.can_id
        yield self.strike(sent) if sent.frame.can_id == self._can_id else sent

    @abstractmethod
    def strike(self, sent: BusFrame) -> BusFrame:
        """Return the frame that replaces the struck one."""


class DeadTaxel(OneTaxel):
    """Taxel that sends no frame."""

    def strike(self, sent: BusFrame) -> BusFrame:
        """Mark the frame as lost."""
        return sent._replace(fate="dead")


class StuckTaxel(OneTaxel):
    """Taxel that sends the same reading for ever."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._first: CanFrame | None = None

    def strike(self, sent: BusFrame) -> BusFrame:
        """Replace each later reading by the first."""
        if self._first is None:
            self._first = sent.frame
            return sent
        return sent._replace(frame=self._first, fate="stuck")


class SilentSensor(FrameFault):
    """Sensor with a broken cable: the named one, or that of the first frame."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._sensor = parameter
        if parameter and parameter not in {name for name, _ in USPA44_MAP.taxels.values()}:
            raise ValueError(f"sensor is {parameter!r}, expected a controller 0..15")

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose a frame of that sensor."""
        sensor = USPA44_MAP.taxels.get(sent.frame.can_id, ("", 0))[0]
        self._sensor = self._sensor or sensor
        yield sent._replace(fate="silent") if sensor == self._sensor else sent


class Vanished(FrameFault):
    """Share of whole scans that are not sent: scans have no numbers on the wire, so only their times show the loss."""

    usual_share = 0.05

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._share = share(parameter, self.usual_share)
        self._vanishes: dict[str, bool] = {}

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose the frame if its scan vanishes, which is drawn at the first frame of the scan."""
        sensor = USPA44_MAP.taxels.get(sent.frame.can_id, ("", 0))[0]
        if sent.frame.can_id >> 4 == 0:
            self._vanishes[sensor] = self.draw.random() < self._share
        yield sent._replace(fate="vanished") if self._vanishes.get(sensor) else sent

    def winds_down(self) -> bool:
        """Let no further scan vanish; return True once the present ones have ended."""
        self._share = 0.0
        return not any(self._vanishes.values())


class BusOff(FrameFault):
    """Adapter that has left the bus after too many errors; it returns by itself."""

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Mark the frame as lost."""
        yield sent._replace(fate="bus-off")


FRAME_FAULTS: Final[Mapping[str, Callable[[random.Random, str], FrameFault]]] = MappingProxyType(
    {
        "lost": Lost,
        "repeated": Repeated,
        "reordered": Reordered,
        "foreign": Foreign,
        "dead": DeadTaxel,
        "stuck": StuckTaxel,
        "silent": SilentSensor,
        "vanished": Vanished,
        "bus-off": BusOff,
    }
)


def share(parameter: str, usual_share: float) -> float:
    """Parse a share as a user wrote it.

    Raises:
        ValueError: it is no share.
    """
    try:
        value = float(parameter) if parameter else usual_share
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise ValueError(f"share is {parameter!r}, expected a number 0..1")
    return value


def through(faults: Sequence[FrameFault], sent: BusFrame) -> Iterator[BusFrame]:
    """Pass a frame through one fault after the other; later faults do not see lost ones."""
    if not faults or sent.lost:
        yield sent
        return
    for left in faults[0].take(sent):
        yield from through(faults[1:], left)
