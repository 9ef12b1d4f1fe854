"""Check of two pads against each other: a grip presses both alike, so that each is the other's reference."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from edge.doctor.findings import Finding, judged
from edge.doctor.guided_press import FREE_SCANS, Weighed
from edge.perception.run_options import OFF_COUNTS, ON_COUNTS

ASK: Final = "Let the gripper close on something firm, so that both pads press it, hold it for two seconds, and open."
HELD_SCANS: Final = 100  # scans of each pad in the grip, before its end is waited for


class Grip:
    """Course of one grip, by the summed z of two pads in counts over their baselines."""

    def __init__(self, names: tuple[str, str]) -> None:
        self.weighed: dict[str, Weighed] = {}  # after `judge` that of a pad without a weight, by its partner's
        self._names = names
        self._z: dict[str, list[tuple[float, float]]] = {name: [] for name in names}  # (time in [s], counts)

    def push(self, name: str, time_s: float, z_counts: float) -> None:
        """Take a reading of one of the pads."""
        self._z[name].append((time_s, z_counts))

    @property
    def over(self) -> bool:
        """True once both pads were pressed for long enough, and hardly are any more."""
        for course in self._z.values():
            sizes = [abs(z) for _, z in course]
            held = sum(size >= ON_COUNTS for size in sizes)
            if held < HELD_SCANS or max(sizes[-FREE_SCANS:]) > max(OFF_COUNTS, 0.5 * max(sizes)):
                return False
        return True

    def judge(self, weighed: Mapping[str, Weighed]) -> list[Finding]:
        """Return the findings; `weighed` holds what a weight showed of the pads on which one was laid, by name."""
        first, second = self._names
        remedy = "grip something firm with both pads: run the doctor once more"
        unclear = [Finding("grip", "not known", "the pads were not pressed together", "", remedy)]
        if not all(self._z.values()):
            return unclear
        times, here = np.abs(np.array(self._z[first]).T)
        there = np.interp(times, *np.abs(np.array(self._z[second]).T))
        gripped = (here >= ON_COUNTS) & (there >= ON_COUNTS)
        if np.count_nonzero(gripped) < HELD_SCANS // 2:
            return unclear
        findings: list[Finding] = []
        off_share = 0.0
        for name, z in ((first, here), (second, there)):
            rest, held = float(np.median(z[-FREE_SCANS:])), float(np.median(z[gripped]))
            lost = "it has lost its zero: zero the free pad again, and look whether something bears on it"
            verdict = "ok" if rest <= 0.1 * held else "wrong"
            off_share = max(off_share, rest / held)
            norm = "under a tenth of the grip"
            findings.append(judged("zero after a grip", verdict, f"sensor {name}: {rest:.0f} counts", norm, lost))
        ratio = float(here[gripped] @ there[gripped] / (there[gripped] @ there[gripped]))
        if first in weighed and second in weighed:
            share = ratio * weighed[second].counts_per_newton / weighed[first].counts_per_newton
            off = "lay the weight on both again: the one that has changed has lost its scale"
            verdict = "ok" if 1 / 1.1 <= share <= 1.1 else "wrong"
            measured = f"sensor {first} reads {share:.2f} of the newtons of sensor {second}"
            return [*findings, judged("scale in a grip", verdict, measured, "alike within 10 %", off)]
        measured = f"sensor {first} reads {ratio:.2f} of the counts of sensor {second}"
        off = "sensors differ less: lay a weight on each"
        scale = judged("scale in a grip", "ok" if 0.6 <= ratio <= 1.67 else "look", measured, "0.6 to 1.67", off)
        if scale.verdict == "ok" and first not in weighed and second not in weighed:
            remedy = "each of them may read a quarter more or less: lay a weight on one, or on both"
            scale = Finding("scale in a grip", "not known", measured, "", remedy)
        findings.append(scale)
        if any(finding.verdict != "ok" for finding in findings):  # a scale from here would look right
            return findings
        for name, partner, factor in ((second, first, 1 / ratio), (first, second, ratio)):
            if partner in weighed:
                per_newton, error = weighed[partner]
                # Half of the 90 % interval of the ratio: seven real grips scatter by 0.027.
                self.weighed = {name: Weighed(per_newton * factor, math.hypot(error, 0.045, off_share))}
        return findings
