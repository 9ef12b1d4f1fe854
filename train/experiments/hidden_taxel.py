"""One taxel of a scan hidden, and told from the others: scans, real and simulated, and methods that tell."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from edge.classical import fit_gain, fit_linear_map
from edge.frozen import FrozenSet
from edge.progress import tracked
from firmware_bridge.baseline import LOAD_LIMIT_COUNTS, Baseline, deformation
from firmware_bridge.errors import RecordingError
from firmware_bridge.geometry import AXES, USPA44
from firmware_bridge.recording import load_recording
from train.errors import DatasetError
from train.networks.blocks import PatternNet
from train.psf_net import degrade
from train.training import infer

REST_SCANS: Final = 20
"""At the end of a recording, where one of the grips has been let go."""
GAMMAS: Final = tuple(np.geomspace(0.3, 3.0, 60).tolist())
BILINEAR, SIMULATED, OTHERS, TRUTH = "bilinear", "linear, simulated taps", "linear, other trials", "true pattern"
_TAXELS: Final = USPA44.taxel_count
_Z: Final = AXES.index("z")

Told = dict[str, list[NDArray[np.floating]]]
"""By method, what it says of every taxel when hidden: (n, taxels) for each set."""


@dataclass(frozen=True, slots=True)
class ScanSet:
    """Pressed scans of one contact.

    Attributes:
        sensor: whose taxels these are.
        trial: scans of one trial are not independent.
        counts: (n, 3, rows, cols) zeroed.
        patterns: (n, H, W) true ones in [mm], where they are known.
    """

    sensor: str
    trial: str
    counts: NDArray[np.float32]
    patterns: NDArray[np.float32] | None = None

    @property
    def z(self) -> NDArray[np.floating]:
        """What the taxels read, (n, taxels)."""
        return z_of(self.counts)


def z_of(counts: NDArray[np.floating]) -> NDArray[np.floating]:
    """Readings of z, (n, taxels), of scans (n, 3, rows, cols)."""
    return counts[:, _Z].reshape(-1, _TAXELS)


def recordings_folder() -> Path:
    """Where TACTILE_RECORDINGS says, else beside the repository."""
    beside = Path(__file__).parents[2] / "../shared/recordings/imanlab"
    return Path(os.environ.get("TACTILE_RECORDINGS", beside))


def recording_paths(folder: Path) -> list[Path]:
    """Recordings in a folder of folders, one for each trial, of `xela_SENSOR.csv`."""
    return sorted(folder.glob("*/xela_*.csv"))


def recorded_sets(folder: Path) -> list[ScanSet]:
    """Real scans under load, one set for each trial and sensor; scans sent again are left out.

    A sensor's rest level is taken from the end of the trial that ends with the least load: where a grip is let go.

    Args:
        folder: see `recording_paths`.

    Raises:
        DatasetError: no such folder or no recordings in it, or one cannot be read.
    """
    paths = recording_paths(folder)
    if not paths:
        raise DatasetError("no recordings of real sensors: set TACTILE_RECORDINGS to a folder of TRIAL/xela_SENSOR.csv")
    try:
        counts = {path: load_recording(path).tracks[0].counts for path in paths}
    except RecordingError as error:
        raise DatasetError(str(error)) from error
    sets: list[ScanSet] = []
    for sensor in dict.fromkeys(path.stem for path in paths):
        mine = [path for path in paths if path.stem == sensor]
        free = min(mine, key=lambda path: float(counts[path][-REST_SCANS:, _Z].mean()))
        rest = Baseline.from_counts(sensor, counts[free][-REST_SCANS:], created_unix_s=0.0)
        for path in mine:
            renewed = np.append(True, (np.diff(counts[path], axis=0) != 0).any(axis=(1, 2, 3)))
            zeroed = deformation(counts[path][renewed], rest)
            loaded = zeroed[:, _Z].max(axis=(1, 2)) > LOAD_LIMIT_COUNTS
            sets.append(ScanSet(sensor, path.parent.name, zeroed[loaded]))
    return [scans for scans in sets if len(scans.counts)]


def simulated_sets(frozen: FrozenSet) -> list[ScanSet]:
    """The same of a frozen set, each tap a trial."""
    patterns, newest = frozen.patterns(), frozen.newest.astype(np.float32)
    loaded = newest[:, _Z].max(axis=(1, 2)) > LOAD_LIMIT_COUNTS
    taps = {tap: (frozen.tap == tap) & loaded for tap in range(len(frozen.surface))}
    return [ScanSet("simulated", str(tap), newest[at], patterns[at]) for tap, at in taps.items() if at.any()]


def fit_gamma(patterns: NDArray[np.floating], z: NDArray[np.floating]) -> tuple[float, float]:
    """The perceptual region with which patterns explain readings best, by one gain.

    Args:
        patterns: (n, H, W).
        z: (n, taxels).

    Returns:
        gamma in [mm^0.5], and the share of z's energy it leaves unexplained.
    """
    left = []
    for gamma in GAMMAS:
        found = _degraded(patterns, gamma)
        left.append(float(np.sum((z - fit_gain(found, z) * found) ** 2) / np.sum(z**2)))
    best = int(np.argmin(left))
    return GAMMAS[best], left[best]


def hide(counts: NDArray[np.float32], taxel: int) -> NDArray[np.float32]:
    """Scans (n, 3, rows, cols) in which one taxel reads 0."""
    flat = counts.reshape(*counts.shape[:2], -1).copy()
    flat[:, :, taxel] = 0
    return flat.reshape(counts.shape)


def neighbours_mean(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """Mean of the taxels over each one's edges, (n, taxels): bilinear in its place, fewer at the rim."""
    row, col = np.divmod(np.arange(_TAXELS), USPA44.cols)
    beside = (np.abs(row[:, None] - row) + np.abs(col[:, None] - col)) == 1
    return z @ (beside / beside.sum(axis=0))


def linear_from_others(fitted_on: NDArray[np.floating], z: NDArray[np.floating]) -> NDArray[np.floating]:
    """Each taxel of z (n, taxels) from the others, least squares over the rows of `fitted_on` (m, taxels)."""
    said = np.empty_like(z)
    for taxel in range(_TAXELS):
        others = np.arange(_TAXELS) != taxel
        said[:, taxel] = z[:, others] @ fit_linear_map(fitted_on[:, others], fitted_on[:, [taxel]])[:, 0]
    return said


def hidden_taxels(
    sets: Sequence[ScanSet], nets: Mapping[str, PatternNet], gamma: float, simulated: NDArray[np.float32]
) -> Told:
    """Every method's word on every taxel when it is hidden.

    Args:
        sets: scans.
        nets: of one tap, by name.
        gamma: of the degradation, in [mm^0.5].
        simulated: (m, 3, rows, cols) zeroed counts of simulated taps.
    """
    told: Told = {name: [] for name in nets}
    for name, net in tracked(nets.items(), "hidden taxels", "network"):
        for scans in sets:
            said = np.empty_like(scans.z)
            for taxel in range(_TAXELS):
                patterns, _ = infer(net, hide(scans.counts, taxel)[:, None])
                said[:, taxel] = _in_counts(_degraded(patterns, gamma), scans.z, taxel)
            told[name].append(said)
    told[BILINEAR] = [neighbours_mean(scans.z) for scans in sets]
    simulated_z = z_of(simulated)
    told[SIMULATED] = [linear_from_others(simulated_z, scans.z) for scans in sets]
    if all(scans.patterns is not None for scans in sets):
        told[TRUTH] = []
        for scans in sets:
            found = _degraded(scans.patterns, gamma)
            told[TRUTH].append(np.stack([_in_counts(found, scans.z, taxel) for taxel in range(_TAXELS)], axis=1))
    elif len({scans.trial for scans in sets}) > 1:
        told[OTHERS] = []
        for scans in sets:
            others = np.concatenate([other.z for other in sets if other.trial != scans.trial])
            told[OTHERS].append(linear_from_others(others, scans.z))
    return told


def _degraded(patterns: NDArray[np.floating] | None, gamma: float) -> NDArray[np.float32]:
    """(n, taxels) of patterns (n, H, W)."""
    maps = torch.from_numpy(np.asarray(patterns, dtype=np.float32))
    return degrade(maps, torch.tensor(gamma)).flatten(1).numpy()


def _in_counts(found: NDArray[np.floating], z: NDArray[np.floating], taxel: int) -> NDArray[np.floating]:
    """One taxel's word (n,) by the gain that suits the others."""
    others = np.arange(_TAXELS) != taxel
    if not found[:, others].any():
        return np.zeros(len(found))
    return fit_gain(found[:, others], z[:, others]) * found[:, taxel]
