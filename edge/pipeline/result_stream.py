"""Stream of the results of a source: every one, the newest, or pairs of several sensors; and its loop into sinks."""

import gc
import math
from collections import Counter, deque
from collections.abc import AsyncIterator, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from edge.errors import NoResultError, UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.loop import ALL_HEARD_SCANS, LinkState, Loop
from edge.pipeline.pose_queue import PoseError, pose_of_fields
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import CAPACITY_SCANS, Source
from edge.pipeline.sink import Sink
from edge.validation import check_positive
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG
from firmware_bridge.schedule import NS_PER_S, POLL_S


@dataclass(frozen=True, slots=True)
class Latest:
    """Newest result of a sensor, with all that decides whether it still holds."""

    result: Result | None  # None before the first
    age_s: float  # time since its reading was taken, at most; it grows until the next scan, and is at first infinite
    link: LinkState  # "silent", no scan arrives; "lost", the adapter is gone; "ended", no more will come
    new: bool  # False if an earlier call, or an iteration, returned this result
    skipped: int  # results of the sensor that nothing returned, since the last one that was


class Stream(Loop):
    """Results of a source, one for every scan, until it ends, `stop` is set or `duration_s` is over.

    A loop over it gets every result in order, and may be left and continued; `latest` and `read` return the newest, and
    leave out those before it. Of the scans that wait, the newest of each sensor gets a pattern. A result is made in the
    thread that asks for it: between two calls the runtime may be asked to zero or to reset. A sensor that has a
    baseline or counts per newton, and of which no scan arrives, is reported as an event.
    """

    _worker: ThreadPoolExecutor | None = None

    def pose(
        self,
        x_mm: float,
        y_mm: float,
        turn_deg: float = 0.0,
        *,
        error_mm: float = PLACE_ERROR_MM,
        error_deg: float = TURN_ERROR_DEG,
        time_ns: int | None = None,
        sensor: str | None = None,
        holds: bool = False,
    ) -> None:
        """State where the middle of a sensor's pad is, and its turn from x to y, in the object's plane.

        Any thread may call it, and it applies from the next scans on. Errors are standard deviations. The pad was there
        at `time_ns`, by `time.monotonic_ns`, later than the pose before; None stands for now. Without a sensor it is of
        all that have no poses of their own. A pad that `holds` rests there until the next pose; else poses must come
        several times a second. Raises UsageError for a value out of range, and for a recording.
        """
        if self._source.patient:
            raise UsageError(
                f"{self._source.name} is a recording: give `runtime.pose` a PadPose and a time of its scans"
            )
        self.check_sensor(sensor)
        now_ns = self._clock_ns()
        fields = {"x_mm": x_mm, "y_mm": y_mm, "turn_deg": turn_deg, "error_mm": error_mm, "error_deg": error_deg}
        fields |= {"sensor": sensor, "holds": holds, "time_ns": now_ns if time_ns is None else time_ns}
        try:
            self._poses.put(pose_of_fields(fields, now_ns))
        except PoseError as error:
            raise UsageError(f"a pose: {error}") from error

    def __iter__(self) -> Iterator[Result]:
        """Yield every result from the next one on; then raise what ended it: LinkLostError, ModelError, SinkError."""
        while True:
            yield from self._returned()
            if self._ended and self._error is None:
                return
            self._step(POLL_S)

    async def __aiter__(self) -> AsyncIterator[Result]:
        """Yield every result as `__iter__` does, beside other tasks; nothing is lost where one of them cancels it."""
        while True:
            for result in self._returned():
                yield result
            if self._ended and self._error is None:
                return
            await self._step_beside(POLL_S)

    def latest(self, sensor: str | None = None) -> Latest:
        """Return the newest result of a sensor, such as "left/4", or of the only one; never waits for a scan.

        Results before the newest are skipped, and counted; sinks get them all. Raises UsageError where no sensor has
        this name, or none is named and there are several, or the source is a recording that is not paced; and the
        errors of `__iter__`, now and at every later call.
        """
        self._step_live(0.0)
        self.check_sensor(sensor)
        return self._take_newest(sensor)

    def latest_of_all(self) -> dict[str, Latest]:
        """Return the newest result of every sensor that has sent a scan, by name; otherwise as `latest`."""
        self._step_live(0.0)
        return {name: self._take_newest(name) for name in tuple(self._newest)}

    def read(self, sensor: str | None = None, *, timeout_s: float = 1.0) -> Latest:
        """Return the newest result as `latest`, once there is a new one, or raise NoResultError after `timeout_s`."""
        for wait_s in self._waits_s(sensor, timeout_s):
            self._step_live(wait_s)
        return self._take_newest(sensor)

    async def read_async(self, sensor: str | None = None, *, timeout_s: float = 1.0) -> Latest:
        """Return what `read` does, beside other tasks; one of them may cancel it at any time."""
        for wait_s in self._waits_s(sensor, timeout_s):
            await self._step_beside(wait_s)
        return self._take_newest(sensor)

    def check_sensor(self, sensor: str | None) -> None:
        """Raise a UsageError where no sensor has this name, nor may have it until its link has sent some scans."""
        why = None if sensor is None else self._no_sensor(sensor)
        if why is not None:
            raise UsageError(why)

    def _waits_s(self, sensor: str | None, timeout_s: float) -> Iterator[float]:
        """Yield how long to wait for a scan, in [s], again and again until a sensor has a new result."""
        check_positive("timeout_s", timeout_s)
        end_ns = self._clock_ns() + timeout_s * NS_PER_S
        yield 0.0  # a result that an iteration has made and not returned is old by what has come since
        while not self._unseen.get(self._named(sensor), 0):
            self.check_sensor(sensor)
            left_s = (end_ns - self._clock_ns()) / NS_PER_S
            if left_s <= 0 or self._ended:
                of, heard = "" if sensor is None else f" of sensor {sensor}", ", ".join(sorted(self._newest)) or "none"
                raise NoResultError(f"no new result{of}: link {self._link(sensor)}, sensors so far: {heard}")
            yield min(POLL_S, left_s)

    def _take_newest(self, sensor: str | None) -> Latest:
        name, age_s = self._named(sensor), math.inf
        result, unseen = self._newest.get(name), self._unseen.get(name, 0)
        if result is not None:
            age_s = max(self._clock_ns() - result.scan.not_before_ns, 0) / NS_PER_S
            self._unseen[name] = 0
        self._pass_over()
        return Latest(result, age_s, self._link(name or None), unseen > 0, max(unseen - 1, 0))

    def _named(self, sensor: str | None) -> str:
        """Return the name of a sensor; without one, that of the only sensor so far, or "" before its first result."""
        if sensor is None and len(self._newest) > 1:
            raise UsageError(f"there are sensors {', '.join(sorted(self._newest))}: name one of them")
        return next(iter(self._newest), "") if sensor is None else sensor

    def _link(self, sensor: str | None) -> LinkState:
        """Return the state of a sensor's link, or the worst of all: an outage is of a sensor, or of all of a link."""
        if self._ended:
            return "ended"
        down: set[LinkState] = set()
        for (name, what), state in self._down.items():
            if sensor is None or sensor == name or (what == "link" and sensor.startswith(name)):
                down.add(state)
        return "lost" if "lost" in down else "silent" if down else "up"

    def run(self) -> None:
        """Make all results for the sinks alone, as late as all of them allow at rest; raises as `__iter__`."""
        self._cadences.patience_s = min((sink.patience_s for sink in self._sinks), default=0.0)
        while self._error is not None or not self._ended:
            self._step(POLL_S)
            self._pass_over()

    def _returned(self) -> Iterator[Result]:
        """Yield the results that were made, each as one that an iteration returns."""
        while self._made:
            made = self._made.popleft()
            if isinstance(made, Event):
                self._on_event(made)
            else:
                self._unseen[made.scan.sensor] -= 1
                yield made

    def _step_live(self, wait_s: float) -> None:
        if self._source.patient:
            raise UsageError(
                f"{self._source.name} is a recording that is read as fast as its results are made, without a latest "
                "one: iterate over the stream, or open it with paced=True"
            )
        self._step(wait_s)

    async def _step_beside(self, wait_s: float) -> None:
        """Make the next results in a thread, once scans wait; they stay here if the task is cancelled."""
        import asyncio

        def wait_and_step() -> None:
            self._source.wait(wait_s)  # not within a step, which another task would have to wait for
            self._step(0.0)

        if self._error is not None:
            self._step(0.0)  # it raises it: a closed stream has no thread left
        if self._worker is None:
            self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="result-stream")
        await asyncio.get_running_loop().run_in_executor(self._worker, wait_and_step)

    def close(self) -> None:
        """End the stream, as closing its source does; its sinks, which may be closed by now, get nothing more."""
        super().close()
        if self._worker is not None:
            self._worker.shutdown()


class Together(tuple[Result, ...]):
    """Results of several sensors that belong together in time."""

    @property
    def imbalance(self) -> float | None:
        """Difference of force between the first of two pads and the second, over the mean of both; None unless touched.

        A grip presses both alike: on a real one it was 0.04 to 0.09 with nominal newtons. Beyond 0.1 a pad has lost its
        zero or its scale, or something else bears on what is gripped.
        """
        if len(self) != 2 or not all(result.contact for result in self):
            return None
        newtons = [result.force_n for result in self]
        forces = [result.force_counts for result in self] if None in newtons else newtons
        first, second = (0.0 if force is None else force for force in forces)
        return 2 * (first - second) / (first + second) if first > 0 and second > 0 else None


def paired(results: Iterable[Result], sensors: Sequence[str], *, apart_s: float = 0.02) -> Iterator[Together]:
    """Yield the results of several sensors that belong together in time: one of each, in the order of their names.

    Times are those on the bus, where the device states them, from the first to the last at most `apart_s`: two periods
    at 100 Hz. Each result is used once at most; of two that could follow, the nearer one is taken, which is known a
    period later. Results without a partner are left out. Raises UsageError for names that are fewer than two, or that
    no sensor has.
    """
    check_positive("apart_s", apart_s)
    if isinstance(sensors, str) or len(sensors) < 2 or len(set(sensors)) < len(sensors):
        raise UsageError(f"sensors are {sensors!r}, expected two or more different names")
    waiting: dict[str, deque[Result]] = {name: deque(maxlen=CAPACITY_SCANS) for name in sensors}
    return _pairs(results, waiting, round(apart_s * 1e9))


def _pairs(results: Iterable[Result], waiting: dict[str, deque[Result]], apart_ns: int) -> Iterator[Together]:
    newest_ns = 0
    missing, heard = set(waiting), Counter[str]()
    for result in results:
        sensor = result.scan.sensor
        if missing:
            missing.discard(sensor)
            heard[sensor] += 1
            if isinstance(results, Stream):
                for name in missing:
                    results.check_sensor(name)
        queue = waiting.get(sensor)
        if queue is None:
            continue
        queue.append(result)
        newest_ns = max(newest_ns, result.scan.on_bus_ns)
        yield from _matches(waiting, apart_ns, newest_ns)
    yield from _matches(waiting, apart_ns, None)
    if missing and max(heard.values(), default=0) >= ALL_HEARD_SCANS:
        raise UsageError(f"no result of sensor {min(missing)!r}: there are those of {', '.join(sorted(heard))}")


def _matches(waiting: dict[str, deque[Result]], apart_ns: int, newest_ns: int | None) -> Iterator[Together]:
    """Yield the pairs that nothing newer can better; `newest_ns` is None where nothing newer will come."""
    while all(waiting.values()):
        times_ns = [queue[0].scan.on_bus_ns for queue in waiting.values()]
        first_ns, last_ns = min(times_ns), max(times_ns)
        earliest = list(waiting.values())[times_ns.index(first_ns)]
        spread_ns, better = last_ns - first_ns, False
        if len(earliest) > 1:
            times_ns[times_ns.index(first_ns)] = earliest[1].scan.on_bus_ns
            better = max(times_ns) - min(times_ns) < spread_ns
        if better or spread_ns > apart_ns:
            earliest.popleft()
        elif len(earliest) == 1 and newest_ns is not None and newest_ns - last_ns < spread_ns:
            return  # its next one may be nearer
        else:
            yield Together(queue.popleft() for queue in waiting.values())


@contextmanager
def uncollected() -> Generator[None, None, None]:
    """Disable garbage collection, which stops everything for several periods of a sensor; the loop makes no cycles."""
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()


def pump(source: Source, runtime: Runtime, sinks: Sequence[Sink], statistics: Statistics, **settings: Any) -> None:
    """Run a stream into its sinks until it ends, without pauses for garbage collection; it takes the same settings."""
    stream = Stream(source, runtime, sinks=sinks, statistics=statistics, **settings)
    with uncollected():
        stream.run()
