"""Score of the demo: the runtime's pattern of each tap against its truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db, rmse_percent
from edge.inference.model_interface import Model
from edge.inference.pose_input import scheduled_rows
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.terminal.heatmap import Palette, Panel, draw
from firmware_bridge.zeroing.baseline import deformation


@dataclass(frozen=True, slots=True)
class TapScore:
    """Error of one tap's pattern against its truth, at the tap's peak frame.

    Attributes:
        tap: number of the tap, from 0.
        pose: x and y in [mm] and turn in [deg] of the pad, as the robot stated them.
        result: at the peak frame.
        truth: (H, W) in the model's output unit.
        psnr_db: in [dB].
        rmse_percent: in [% of full scale].
        alone_percent: the same of a pattern from this tap alone.
    """

    tap: int
    pose: tuple[float, float, float]
    result: Result
    truth: NDArray[np.float32]
    psnr_db: float
    rmse_percent: float
    alone_percent: float


class DemoScore(Sink):
    """Sink that keeps of each tap the result with the largest force, until the last tap is over.

    A result is matched to its truth by its raw counts, not by its number: a lost scan shifts nothing.

    Attributes:
        surface: name of the tapped surface.
        taps: number of taps in the recording.
        complete: True once the last tap is over.
    """

    def __init__(
        self, recording: Path, model: Model, on_complete: Callable[["DemoScore"], object] = lambda score: None
    ) -> None:
        """Load the truth, as train/demo.py records it; `on_complete` is called once, when the last tap is over.

        The recording's taps are numbered; after them come those that may be played in place of all but the first.
        """
        self._model, self._on_complete = model, on_complete
        with np.load(recording, allow_pickle=False) as data:
            self.surface = str(data["surface"])
            self.taps = len(data["tap_pose"])
            poses = np.concatenate([data["tap_pose"], data["option_pose"]])[:, :3].tolist()
            self._poses = [(x_mm, y_mm, turn_deg) for x_mm, y_mm, turn_deg in poses]
            patterns = [data["unit_patterns"], data["option_unit_patterns"]]
            self._unit_patterns = np.concatenate(patterns).astype(np.float32)
            shown = zip(data["tap"].tolist(), data["indentation_mm"].tolist(), data["counts"], strict=True)
            self._frames = {_key(counts): (tap, mm) for tap, mm, counts in shown if tap >= 0}
            options = zip(data["option_counts"], data["option_indentation_mm"].tolist(), strict=True)
            for place, (counts, depths_mm) in enumerate(options, self.taps):
                self._frames |= {_key(one): (place, mm) for one, mm in zip(counts, depths_mm, strict=True)}
            self._scenes = {_key(counts) for counts in data["counts"][data["scene"] >= 0]}
        self._peaks: list[tuple[Result, int, float]] = []  # with number of the tap's place, and indentation in [mm]
        self._between = True
        self.complete = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Keep the result if it is the strongest of its tap."""
        if self.complete:
            return
        key = result.scan.counts.tobytes()
        self._between |= result.contact is False
        if (self._between and len(self._peaks) == self.taps) or (self._peaks and key in self._scenes):
            self.complete = True
            self._on_complete(self)
            return
        if key not in self._frames or result.pattern is None or result.force_counts is None:
            return
        place, indentation_mm = self._frames[key]
        if self._between or place != self._peaks[-1][1]:
            self._peaks.append((result, place, indentation_mm))
            self._between = False
        elif result.force_counts > (self._peaks[-1][0].force_counts or 0):
            self._peaks[-1] = result, place, indentation_mm

    def close(self) -> None:
        """Do nothing, since there is nothing to finish."""

    def scores(self) -> list[TapScore]:
        """Return the scores of the taps that got a pattern."""
        return [self._score(tap, *peak) for tap, peak in enumerate(self._peaks)]

    def _score(self, tap: int, result: Result, place: int, indentation_mm: float) -> TapScore:
        truth = self._unit_patterns[place] * indentation_mm
        if result.pattern is None:
            raise ValueError("peak has no pattern, expected one kept by write")
        full_scale = self._model.contract.output_full_scale
        alone = result.pattern if result.taps_used < 2 else self._alone(result)
        error_db = float(psnr_db(result.pattern, truth, full_scale))
        errors = (float(rmse_percent(one, truth, full_scale)) for one in (result.pattern, alone))
        return TapScore(tap, self._poses[place], result, truth, error_db, *errors)

    def _alone(self, result: Result) -> NDArray[np.float32]:
        """Return the pattern of a result's newest tap alone."""
        contract = self._model.contract
        if result.window is None:
            raise ValueError("result has no window, expected one with a pattern")
        window = contract.scale_window(result.window)
        if contract.takes_poses:
            return self._model.run(window[:1], poses=scheduled_rows(1, contract.angle_step_deg))
        padded = np.zeros((contract.taps, *window.shape[1:]), dtype=np.float32)
        padded[0] = window[0]
        return self._model.run(padded)


def _key(counts: NDArray[np.integer]) -> bytes:
    return counts.astype(np.int32).tobytes()


def score_table(scores: Sequence[TapScore]) -> str:
    """Return the scores as a table with a line for each tap, 50 columns wide, and what the taps together are worth.

    RMSE in [% of full scale], of the pattern and of one from the same tap alone; "+-" is the model's own estimate, half
    the 90 % interval of touched pixels in [um].
    """
    lines = ["tap    x    y turn use   PSNR  RMSE alone  +- time", "      mm   mm  deg taps    dB   %fs   %fs  um   us"]
    for score in scores:
        interval_mm = score.result.interval_mm
        interval = "-" if interval_mm is None else f"{1000 * interval_mm:.0f}"
        x_mm, y_mm, turn_deg = score.pose
        figures = f"{score.psnr_db:6.2f} {score.rmse_percent:5.2f} {score.alone_percent:5.2f}"
        place = f"{score.tap + 1:3d} {x_mm:4.1f} {y_mm:4.1f} {turn_deg:4.0f} {score.result.taps_used:3d}"
        lines.append(f"{place} {figures} {interval:>3s} {score.result.run_time_us or 0:4.0f}")
    return "\n".join([*lines, _gained(scores)])


def _gained(scores: Sequence[TapScore]) -> str:
    """Return what the earlier taps have changed, also where it is nothing good."""
    last = scores[-1]
    if last.result.taps_used < 2:
        return "Each pattern is of one tap: the model takes one, or the earlier ones were dropped."
    change = "fell" if last.rmse_percent < last.alone_percent else "did not fall"
    errors = f"{last.rmse_percent:.2f} % of full scale, {last.alone_percent:.2f} % with it alone"
    risen = [str(one.tap + 1) for before, one in pairwise(scores) if one.rmse_percent > before.rmse_percent]
    rose = f"\nFrom tap to tap it rose at tap {' and '.join(risen)}." if risen else ""
    return f"With {last.result.taps_used} taps the last one's error {change}: {errors}.{rose}"


def score_picture(score: TapScore, columns: int, palette: Palette) -> str:
    """Return the taxels, the pattern and the truth as maps side by side."""
    result = score.result
    if result.pattern is None or result.baseline is None:
        raise ValueError("score has no pattern, expected one made by DemoScore")
    taxels_z = deformation(result.scan.counts, result.baseline)[2]
    highest = float(max(result.pattern.max(), score.truth.max()))
    believed = {True: "super-resolved", None: "not checked", False: "NOT BELIEVED"}[result.trusted]
    height, width = result.pattern.shape
    return draw(
        [
            Panel(f"taxels, {taxels_z.shape[0]} x {taxels_z.shape[1]}", taxels_z, 0.0, float(taxels_z.max()), "counts"),
            Panel(f"{believed}, {height} x {width}", result.pattern, 0.0, highest, result.pattern_unit),
            Panel("truth", score.truth, 0.0, highest, result.pattern_unit),
        ],
        columns,
        palette,
    )
