"""Parting of the frames on a bus into whole cycles, where those of several sensors mix. No I/O, no clock.

A whole cycle is decoded at a fifth of the cost of its frames one by one. On a bus with four sensors hardly a cycle
comes in one piece: frames mix, and a read ends within a cycle. So the frames of a cycle that has begun well wait for
its end. Only time stamps show afterwards that there was no pause in it, so without stamps nothing waits.
"""

from operator import itemgetter
from typing import Final

import numpy as np

from firmware_bridge.scans.can_id_maps import ModelMap

FOREIGN: Final = 255
"""Number of no sensor."""
BEFORE: Final = -1
"""Place of frames that came before the present ones."""
_IDS: Final = 1 << 11
_TWO_BYTES: Final = np.dtype(">u2")
"""The first two of a frame: its id, and 4 bits of its length."""


class MixedCycles:
    """Frames of begun cycles, by sensor; the numbers of sensors are those of `names`.

    Attributes:
        names: names of all sensors of the model.
        begun: the frames that wait, and the time at which the first of them arrived, in [ns], by number of the sensor.
    """

    def __init__(self, model: ModelMap) -> None:
        """Begin without a frame; cycles are expected in the order of the model's ids."""
        self.names = sorted({sensor for sensor, _ in model.taxels.values()})
        self.begun: dict[int, tuple[bytes, int]] = {}
        self._sensors = np.full(_IDS, FOREIGN, dtype=np.uint8)
        self._places = np.zeros(_IDS, dtype=np.uint8)
        self._order = bytes(range(model.geometry.taxel_count))
        for number, name in enumerate(self.names):
            for place, (can_id, _) in enumerate(model.wire_order(name)):
                self._sensors[can_id], self._places[can_id] = number, place

    def part(self, packed: bytes, frame_bytes: int, time_ns: int, *, waits: bool) -> list[tuple[int, bytes]]:
        """Return whole cycles and single frames, each with the place of its last frame in `packed`, and by that order.

        Args:
            packed: frames of a standard id, as `SlcanDecoder.cut` packs them.
            frame_bytes: length of each.
            time_ns: monotonic time of their arrival, in [ns].
            waits: True to let begun cycles wait; those that came so far are returned if they do not go on.
        """
        ids = np.frombuffer(packed, dtype=_TWO_BYTES)[:: frame_bytes // 2] >> 4
        sensors = self._sensors[ids]
        # Sorted once: to look for the frames of each sensor takes as long for every sensor as this for all.
        by_sensor = sensors.argsort(kind="stable")
        frames = np.frombuffer(packed, dtype=f"V{frame_bytes}")[by_sensor].tobytes()
        all_places, all_at = self._places[ids[by_sensor]].tobytes(), by_sensor.tolist()
        numbers = sensors[by_sensor].tobytes()
        parted: list[tuple[int, bytes]] = []
        end = 0
        while end < len(numbers):
            first, number = end, numbers[end]
            end += numbers.count(number)
            text, order, at = frames[first * frame_bytes : end * frame_bytes], all_places[first:end], all_at[first:end]
            begun, since_ns = self.begun.pop(number, (b"", time_ns))
            if begun:
                count = len(begun) // frame_bytes
                text, order, at = begun + text, self._order[:count] + order, [BEFORE] * count + at
            start = 0
            while (found := order.find(self._order, start)) >= 0 and number != FOREIGN:
                parted += _singly(text, frame_bytes, at, start, found)
                start = found + len(self._order)
                parted.append((at[start - 1], text[found * frame_bytes : start * frame_bytes]))
                since_ns = time_ns
            last = order.rfind(b"\0", start) if waits and number != FOREIGN else -1
            if last >= 0 and self._order.startswith(order[last:]):
                self.begun[number] = text[last * frame_bytes :], time_ns if last > start else since_ns
            else:
                last = len(order)
            parted += _singly(text, frame_bytes, at, start, last)
        parted.sort(key=itemgetter(0))
        return parted


def _singly(text: bytes, frame_bytes: int, at: list[int], start: int, end: int) -> list[tuple[int, bytes]]:
    return [(at[frame], text[frame * frame_bytes : (frame + 1) * frame_bytes]) for frame in range(start, end)]
