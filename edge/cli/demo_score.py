"""Score of the demo: the runtime's pattern of each tap against its truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db, rmse_percent, ssim
from edge.inference.contract import Contract
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.terminal.heatmap import Palette, Panel, draw
from firmware_bridge.zeroing.baseline import deformation


@dataclass(frozen=True, slots=True)
class TapScore:
    """Error of one tap's pattern against its truth, at the tap's peak frame.

    Attributes:
        tap: number of the tap, from 0.
        angle_deg: angle at which the surface was tapped, in [deg].
        result: result at the peak frame.
        truth: (H, W) in the model's output unit.
        psnr_db: in [dB].
        ssim: structural similarity, mean over Gaussian windows.
        rmse_percent: in [% of full scale].
    """

    tap: int
    angle_deg: float
    result: Result
    truth: NDArray[np.float32]
    psnr_db: float
    ssim: float
    rmse_percent: float


class DemoScore(Sink):
    """Sink that keeps of each tap the result with the largest force.

    A result is matched to its truth by its raw counts, not by its number: a lost scan shifts nothing.

    Attributes:
        surface: name of the tapped surface.
        complete: True once the last tap is over.
    """

    def __init__(
        self, recording: Path, contract: Contract, on_complete: Callable[["DemoScore"], object] = lambda score: None
    ) -> None:
        """Load the truth.

        Args:
            recording: .npz that has, in addition to `counts` (n, 3, rows, cols): `tap` (n,), -1 without
                contact; `indentation_mm` (n,); `unit_patterns` (taps, H, W), the truth per
                indentation; `angles_deg` (taps,); `surface`.
            contract: contract of the scored model.
            on_complete: called with this, once, when the last tap is over; later results are not scored.
        """
        self._full_scale = contract.output_full_scale
        with np.load(recording, allow_pickle=False) as data:
            self.surface = str(data["surface"])
            self._angles_deg = data["angles_deg"].astype(float).tolist()
            self._unit_patterns = data["unit_patterns"].astype(np.float32)
            self._frames = {
                counts.astype(np.int32).tobytes(): (int(tap), float(indentation_mm))
                for counts, tap, indentation_mm in zip(data["counts"], data["tap"], data["indentation_mm"], strict=True)
                if tap >= 0
            }
        self._peaks: dict[int, _Peak] = {}
        self._on_complete = on_complete
        self.complete = False

    @property
    def taps(self) -> int:
        """Number of taps in the recording."""
        return len(self._angles_deg)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Keep the result if it is the strongest of its tap."""
        if self.complete:
            return
        if result.contact is False and self.taps - 1 in self._peaks:
            self.complete = True
            self._on_complete(self)
            return
        frame = self._frames.get(result.scan.counts.tobytes())
        if frame is None or result.pattern is None or result.force_counts is None:
            return
        tap, indentation_mm = frame
        if tap not in self._peaks or result.force_counts > self._peaks[tap].force_counts:
            self._peaks[tap] = _Peak(result, result.pattern, result.force_counts, indentation_mm)

    def close(self) -> None:
        """Do nothing, since there is nothing to finish."""

    def scores(self) -> list[TapScore]:
        """Return the scores of the taps that got a pattern."""
        return [self._score(tap, self._peaks[tap]) for tap in sorted(self._peaks)]

    def _score(self, tap: int, peak: "_Peak") -> TapScore:
        truth = self._unit_patterns[tap] * peak.indentation_mm
        compared = (peak.pattern, truth, self._full_scale)
        return TapScore(
            tap=tap,
            angle_deg=self._angles_deg[tap],
            result=peak.result,
            truth=truth,
            psnr_db=float(psnr_db(*compared)),
            ssim=float(ssim(*compared)),
            rmse_percent=float(rmse_percent(*compared)),
        )


class _Peak(NamedTuple):
    result: Result
    pattern: NDArray[np.float32]
    force_counts: float
    indentation_mm: float


def score_table(scores: Sequence[TapScore]) -> str:
    """Return the scores as a table with a line for each tap, 40 columns wide.

    RMSE in [% of full scale]; "+-" is the model's own estimate of it, half the 90 % interval of touched pixels in [um].
    """
    lines = ["tap deg use   PSNR  SSIM   RMSE  +- time", "       taps     dB          %fs  um   us"]
    for score in scores:
        interval_mm = score.result.interval_mm
        interval = "-" if interval_mm is None else f"{1000 * interval_mm:.0f}"
        lines.append(
            f"{score.tap + 1:3d} {score.angle_deg:3.0f} {score.result.taps_used:3d} {score.psnr_db:6.2f}"
            f" {score.ssim:5.3f} {score.rmse_percent:6.2f} {interval:>3s} {score.result.run_time_us or 0:4.0f}"
        )
    return "\n".join(lines)


def score_picture(score: TapScore, columns: int, palette: Palette) -> str:
    """Return the taxels, the pattern and the truth as maps side by side."""
    result = score.result
    if result.pattern is None or result.baseline is None:
        raise ValueError("score has no pattern, expected one made by DemoScore")
    taxels_z = deformation(result.scan.counts, result.baseline)[2]
    highest = float(max(result.pattern.max(), score.truth.max()))
    believed = "super-resolved" if result.trusted is not False else "NOT BELIEVED"
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
