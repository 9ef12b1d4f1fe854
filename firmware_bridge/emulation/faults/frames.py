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
"""Fates of frames that reach the reader, the last three with something in them that no taxel read in that cycle."""
FOREIGN_ID: Final = 0x740


class BusFrame(NamedTuple):
    """A frame on the bus and what became of it so far.

    Attributes:
        time_s: on the bus, in [s] from the first scan.
        frame: as it is now.
        cycle: how often its id was sent before.
        fate: one of READ, or what it was lost to.
    """

    time_s: float
    frame: CanFrame
    cycle: int
    fate: str = INTACT

    @property
    def lost(self) -> bool:
        """The reader never gets it."""
        return self.fate not in READ


class FrameFault(ABC):
    """Something that goes wrong on the bus for a while."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        """Begin.

        Args:
            draw: where all chance comes from.
            parameter: as the user wrote it, empty for the usual one.

        Raises:
            ValueError: no such parameter.
        """
        self.draw = draw

    @abstractmethod
    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """What there is instead of a frame that is not lost yet."""

    def winds_down(self) -> bool:
        """Begin nothing new; False while something is under way."""
        return True

    def end(self) -> Iterator[BusFrame]:
        """What is still held back when it is over."""
        return iter(())


class Chance(FrameFault):
    """Strikes a share of the frames, `usual_share` of them unless told otherwise."""

    usual_share = 0.02

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._share = share(parameter, self.usual_share)

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Strike, or pass it on."""
        return self.strike(sent) if self.draw.random() < self._share else self.spare(sent)

    def spare(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Pass it on."""
        yield sent

    @abstractmethod
    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """What there is instead of it."""


class Lost(Chance):
    """Frames that no one receives, as where a queue in the adapter runs over."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose it."""
        yield sent._replace(fate="lost")


class Repeated(Chance):
    """Frames that come twice in a row."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Give it again."""
        yield sent
        yield sent._replace(fate="repeated")


class Reordered(Chance):
    """Frames that change places with the next one."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._held: list[BusFrame] = []

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Hold it back, unless another is."""
        if self._held:
            yield from self.spare(sent)
        else:
            self._held.append(sent._replace(fate="reordered"))

    def spare(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Give it before what is held back."""
        yield sent
        yield from self.end()

    def end(self) -> Iterator[BusFrame]:
        """Give what is held back."""
        held, self._held = self._held, []
        yield from held


class Foreign(Chance):
    """Frames of somebody else on the bus."""

    def strike(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Put one before it."""
        frame = CanFrame(FOREIGN_ID | self.draw.randrange(16), self.draw.randbytes(8))
        yield BusFrame(sent.time_s, frame, 0, "foreign")
        yield sent


class OneTaxel(FrameFault):
    """Strikes one taxel: SENSOR.TAXEL, or that of the first frame that a die lets through."""

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
        """Strike it, or pass another's on."""
        if self._can_id is None and sent.fate != "foreign" and self.draw.random() < 1 / 16:
            self._can_id = sent.frame.can_id
        yield self.strike(sent) if sent.frame.can_id == self._can_id else sent

    @abstractmethod
    def strike(self, sent: BusFrame) -> BusFrame:
        """What there is instead of it."""


class DeadTaxel(OneTaxel):
    """A taxel that sends nothing."""

    def strike(self, sent: BusFrame) -> BusFrame:
        """Lose it."""
        return sent._replace(fate="dead")


class StuckTaxel(OneTaxel):
    """A taxel that sends the same reading for ever."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._first: CanFrame | None = None

    def strike(self, sent: BusFrame) -> BusFrame:
        """Put its first reading in the place of each one after."""
        if self._first is None:
            self._first = sent.frame
            return sent
        return sent._replace(frame=self._first, fate="stuck")


class SilentSensor(FrameFault):
    """A finger whose cable is broken; the one named, or that of the first frame."""

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._sensor = parameter
        if parameter and parameter not in {name for name, _ in USPA44_MAP.taxels.values()}:
            raise ValueError(f"sensor is {parameter!r}, expected a controller 0..15")

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose it if it is of that sensor."""
        sensor = USPA44_MAP.taxels.get(sent.frame.can_id, ("", 0))[0]
        self._sensor = self._sensor or sensor
        yield sent._replace(fate="silent") if sensor == self._sensor else sent


class Vanished(FrameFault):
    """Whole scans that are not sent, a share of them: the wire numbers nothing, and so shows nothing but time."""

    usual_share = 0.05

    def __init__(self, draw: random.Random, parameter: str) -> None:
        super().__init__(draw, parameter)
        self._share = share(parameter, self.usual_share)
        self._vanishes: dict[str, bool] = {}

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose it if its scan vanishes, which its first frame decides."""
        sensor = USPA44_MAP.taxels.get(sent.frame.can_id, ("", 0))[0]
        if sent.frame.can_id >> 4 == 0:
            self._vanishes[sensor] = self.draw.random() < self._share
        yield sent._replace(fate="vanished") if self._vanishes.get(sensor) else sent

    def winds_down(self) -> bool:
        """Let no other scan vanish, and those that do to their ends."""
        self._share = 0.0
        return not any(self._vanishes.values())


class BusOff(FrameFault):
    """The adapter has left the bus after too many errors; it comes back to it by itself."""

    def take(self, sent: BusFrame) -> Iterator[BusFrame]:
        """Lose it."""
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
    """A share of all, as a user wrote it.

    Raises:
        ValueError: it is none.
    """
    try:
        value = float(parameter) if parameter else usual_share
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise ValueError(f"share is {parameter!r}, expected a number 0..1")
    return value


def through(faults: Sequence[FrameFault], sent: BusFrame) -> Iterator[BusFrame]:
    """A frame through one fault after the other; what is lost, the next do not see."""
    if not faults or sent.lost:
        yield sent
        return
    for left in faults[0].take(sent):
        yield from through(faults[1:], left)
