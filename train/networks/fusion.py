"""Network that fuses taps from any poses: what earlier taps show is carried into the newest tap's axes.

The newest tap takes the way of a network of one tap. Every earlier tap is encoded in its own axes, all by the same
weights; each cell of the trunk takes a weighted mean over the cells of all earlier taps, whose weights fall with their
distance by the poses. Half-way through the trunk its state is carried the other way and compared with each tap's
readings, and what differs comes back. What a chip shows in all taps is averaged there, because a gain belongs to the
chip and not to the place. Number and order of the earlier taps are free, and one tap alone is a network of one tap.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from functools import lru_cache
from math import log
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from edge.inference.contract import scheduled_rows
from firmware_bridge.pad_geometry import USPA44
from train.networks.blocks import PatternNet
from train.networks.compact import QUIET_UNITS, CompactNet, Seen, tap_amplitude
from train.networks.symmetric import SymmetricConv2d, fields, scalars, vectors
from train.surfaces.poses import ANGLE_STEP_DEG

_CARRIED: Final = 48  # channels that are carried between the taps' axes
_HEADS: Final = 12  # weights of each cell, one for every field of carried channels
_CELLS: Final = 2  # cells per taxel pitch, those of the trunk: readings hold no finer wave than two pitches
_LEAST_WEIGHT: Final = 1e-2
_CELL_MM: Final = USPA44.pitch_mm / _CELLS


class FusionNet(CompactNet):
    """Network from a window of 1 to K taps, K of two at least, and their poses to pattern, deviation and traction."""

    takes_poses = True
    reach_to: Tensor
    reach_from: Tensor

    def __init__(self, taps: int, scale: int, *, intervals: bool = False, **shape: Any) -> None:
        if taps < 2:
            raise ValueError(f"{taps} taps asked for, expected at least 2: a network of one tap has nothing to fuse")
        super().__init__(scale, **shape)
        self.taps, group, channels = taps, self.group, self._width[0]
        wide, merged = fields(group, channels), fields(group, channels * 3 // 2)
        about, pose = scalars(group, self.known + 1), vectors(group) + scalars(group, 4)
        carried, heads = fields(group, _CARRIED), scalars(group, _HEADS)
        sent = (carried + heads).shuffled(_CELLS)
        self.enter_earlier = SymmetricConv2d(vectors(group) + about + pose, merged, 3)
        self.encode = nn.Sequential(nn.ReLU(), SymmetricConv2d(merged, merged, 3), nn.ReLU())
        self.send = SymmetricConv2d(merged, sent, 1)
        self.receive = SymmetricConv2d(carried + heads, wide, 1)
        self.ask = SymmetricConv2d(wide, carried, 1)
        self.hear = SymmetricConv2d(carried.shuffled(_CELLS), merged, 1)
        self.compare = SymmetricConv2d(merged, merged, 3)
        self.share = SymmetricConv2d(merged, merged + wide.shuffled(_CELLS), 1)
        self.answer = SymmetricConv2d(merged, sent, 1)
        self.revise = SymmetricConv2d(carried + heads, wide, 1)
        # At first earlier taps change nothing.
        for added in (self.receive, self.revise):
            for part in added.parameters():
                nn.init.zeros_(part)
        self.own_share = nn.Parameter(torch.zeros(()))
        self.log_reach = nn.Parameter(torch.full((2,), log(0.5)))  # cells at which a weight has fallen to 0.6
        if intervals:
            self.add_intervals()

    def take_over(self, start: PatternNet) -> None:
        """Copy a network of one tap, or another one of this kind; what encodes earlier taps starts as its entrance."""
        if isinstance(start, FusionNet):
            kept = {name: value for name, value in start.state_dict().items() if not name.startswith("intervals.")}
            self.load_state_dict(kept)
            return
        super().take_over(start)
        weight = torch.zeros_like(self.enter_earlier.weight)
        entrance = self.enter.weight.detach()
        weight[:, : entrance.shape[1]] = entrance
        self.enter_earlier.assign(weight, self.enter.bias.detach())
        self.encode[1].load_state_dict(self.merge[1].state_dict())

    def write_out(self) -> None:
        """Replace the logarithms of the reaches by variances, which a graph holds under their own names."""
        for name, variance in zip(("reach_to", "reach_from"), torch.exp(2 * self.log_reach.detach()), strict=True):
            self.register_buffer(name, variance.clone())
        del self.log_reach

    def read_back(self, written: dict[str, Tensor]) -> None:
        """Add the logarithms of the reaches to the weights of a network that was written out."""
        if {"reach_to", "reach_from"} <= written.keys():
            reaches = torch.stack([written["reach_to"].reshape(()), written["reach_from"].reshape(())])
            written["log_reach"] = torch.log(reaches) / 2

    def _reaches(self) -> Sequence[Tensor]:
        if hasattr(self, "reach_to"):
            return self.reach_to, self.reach_from
        return torch.exp(2 * self.log_reach).unbind()

    def forward(
        self, window: Tensor, pad: Tensor | None = None, poses: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `CompactNet.forward` does, of windows (n, 3k, rows, cols) or (n, k, 3, rows, cols) of k taps.

        Poses (n, k, 5) are x, y in [mm] and turn in [deg] of each tap in the newest one's axes, then the standard
        deviations of both; None for the paper's schedule.
        """
        return self.finished(self.see(window, pad, poses))

    def see(self, window: Tensor, pad: Tensor | None = None, poses: Tensor | None = None) -> Seen:
        """Return the outputs before any correction, and what they were made of; arguments as `forward`."""
        taps = window if window.ndim == 5 else window.unflatten(1, (-1, 3))
        rows, cols = taps.shape[3:]
        amplitude = tap_amplitude(taps)
        shapes, newest = taps / amplitude, amplitude[:, 0, 0]
        there = (amplitude[:, 1:] > QUIET_UNITS).to(window.dtype)
        entered = self.enter_pad(shapes[:, 0], self.about(newest, pad))
        if poses is None:
            rows_of_schedule = torch.from_numpy(scheduled_rows(taps.shape[1], ANGLE_STEP_DEG)).to(taps)
            poses = rows_of_schedule.expand(len(taps), -1, -1)
        # Places of cells need more digits than bfloat16 has; a traced graph has no such types to choose from.
        with torch.autocast(window.device.type, enabled=False) if self.training else nullcontext():
            carrier = _Carrier(poses[:, 1:], there, (rows, cols), self._reaches())

        sizes = (amplitude / (amplitude + 1))[:, 1:, 0, 0]
        pads = entered.about[:, None, :-1].expand(-1, there.shape[1], -1)
        planes = torch.cat([pads, sizes, carrier.inputs], dim=2)[..., None, None].expand(-1, -1, -1, rows, cols)
        encoded = self.encode(self.enter_earlier(torch.cat([shapes[:, 1:], planes], dim=2).flatten(0, 1)))
        received = self.receive(carrier.to_newest(self.send(encoded))) * carrier.any
        state = torch.relu((entered.merged + received) * (1 + entered.scale) + entered.shift)

        half = len(self.trunk) // 2
        state = self.trunk[:half](state)
        asked = carrier.to_taps(self.ask(state))
        compared = torch.relu(self.compare(torch.relu(encoded + self.hear(asked)))).unflatten(0, there.shape[:2])
        mean = (compared * there).sum(dim=1) / there.sum(dim=1).clamp_min(1)
        chip, own = self.share(mean).split([compared.shape[2], _CELLS**2 * state.shape[1]], dim=1)
        answer = self.answer(torch.relu(compared + chip[:, None]).flatten(0, 1))
        revised = self.revise(carrier.to_newest(answer)) + F.pixel_shuffle(own, _CELLS) * self.own_share
        state = self.trunk[half:](torch.relu(state + revised * carrier.any))

        number = there.sum(dim=1)[:, :, 0, 0]
        later = (number > torch.arange(self.taps - 1)).to(window.dtype)
        return self.leave_pad(state, entered, newest, later)


class _Carrier:
    """Exchange of features between the cells of earlier taps and those of the newest one, by the taps' poses.

    A weight is a Gaussian of two cells' distance; the error of the pose widens it. Cells of an earlier tap are in the
    order in which its channels hold them: the four parts of a taxel first, then rows and columns. Poses are
    (n, k - 1, 5) of the earlier taps, and `there` (n, k - 1, 1, 1, 1) is 1 for each that is there, else 0. The grid is
    (rows, cols); reaches are variances of the Gaussians in cells, to the newest tap and from it.
    """

    def __init__(self, poses: Tensor, there: Tensor, grid: tuple[int, int], reaches: Sequence[Tensor]) -> None:
        self._taps, self._grid, self._cells = poses.shape[:2], grid, _CELLS**2 * grid[0] * grid[1]
        # (n, 1, 1, 1), 1 where some earlier tap is there.
        self.any = (there.sum(dim=1) > 0).to(poses.dtype)
        self._there = there.transpose(1, 2)[..., 0]  # (n, 1, k - 1, 1)
        constants = [torch.from_numpy(array).to(poses.dtype) for array in (*_encoding(), *_geometry(*grid))]
        factors, offsets, here, course, spread = constants
        turn = torch.deg2rad(poses[..., 2:3])
        cosine, sine = torch.cos(turn), torch.sin(turn)
        place, errors = poses[..., :2] / _CELL_MM, poses[..., 3:]
        self.inputs = torch.cat([poses[..., :2], cosine, sine, errors], dim=2) @ factors + offsets
        # Where a cell lies in the newest tap's axes, and its distance there from the pad's centre, follow from the pose
        # linearly.
        x, y = place[..., :1], place[..., 1:]
        moved = [cosine, sine, place, cosine * x + sine * y, cosine * y - sine * x, x * x + y * y]
        terms = (torch.cat([*moved, torch.ones_like(x)], dim=2) @ course).unflatten(2, (4, -1))
        squared = torch.cat([errors[..., :1] / _CELL_MM, torch.deg2rad(errors[..., 1:])], dim=2).square()
        variance = (squared @ spread)[:, :, None]
        self._weights: list[Tensor] = []  # (n, cells, (k - 1) cells)
        for reach in reaches:
            # Minus half the squared distance over the variance, as one product of matrices.
            over = (terms / (variance + reach)).transpose(1, 2).flatten(2)  # (n, 4, (k - 1) cells)
            self._weights.append(torch.exp((here @ over).clamp_max(0.0)))

    def to_newest(self, sent: Tensor) -> Tensor:
        """Return channels and log weights, (n, c + heads, H, W), of what taps sent, (n (k - 1), ..., rows, cols)."""
        cells = sent.reshape(*self._taps, _CARRIED + _HEADS, self._cells).transpose(1, 2)
        weight = F.softplus(cells[:, _CARRIED:]) * self._there
        weighted = cells[:, :_CARRIED].unflatten(1, (_HEADS, -1)) * weight[:, :, None]
        # A cell of zeros more: onnxruntime 1.31 leaves a product over no cells at all, of one tap alone, unwritten.
        shared = F.pad(torch.cat([weighted.flatten(1, 2), weight], dim=1).flatten(2), (0, 1))
        total = shared @ F.pad(self._weights[0], (0, 1)).transpose(1, 2)
        amount = total[:, _CARRIED:] + _LEAST_WEIGHT
        mean = (total[:, :_CARRIED].unflatten(1, (_HEADS, -1)) / amount[:, :, None]).flatten(1, 2)
        return torch.cat([mean, torch.log(amount)], dim=1).unflatten(2, [_CELLS * length for length in self._grid])

    def to_taps(self, state: Tensor) -> Tensor:
        """Return channels (n, c, H, W) in each earlier tap's axes, (n (k - 1), 4 c, rows, cols)."""
        (count, earlier), (rows, cols), channels = self._taps, self._grid, state.shape[1]
        weight = self._weights[1]
        weight = weight / (weight.sum(dim=1, keepdim=True) + _LEAST_WEIGHT)
        moved = (state.flatten(2) @ weight).reshape(count, channels, earlier, self._cells)
        return moved.transpose(1, 2).reshape(count * earlier, _CELLS**2 * channels, rows, cols)


@lru_cache
def _encoding() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return factors (6, 7) and offsets (7,) from x, y, cosine, sine and both errors to inputs of the encoder."""
    factors, offsets = np.zeros((6, 7), dtype=np.float32), np.zeros(7, dtype=np.float32)
    factors[0, 0] = factors[1, 1] = 1 / 5.0  # of 5 mm, a vector, whose third part is 0
    factors[2, 3], offsets[3] = -1, 1
    factors[3, 4] = factors[4, 5] = 1
    factors[5, 6] = 1 / 5.0  # of 5 degrees
    return factors, offsets


@lru_cache
def _geometry(rows: int, cols: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return terms of the newest tap's cells, (cells, 4), and factors from a pose to what an earlier tap's cells have.

    The factors are (8, 4 cells) to the terms of the cells, and (2, cells) from squared errors to variances.
    """
    part_y, part_x, row, col = np.meshgrid(*map(np.arange, (_CELLS, _CELLS, rows, cols)), indexing="ij")
    x = (_CELLS * col + part_x - (_CELLS * cols - 1) / 2).ravel()
    y = (_CELLS * row + part_y - (_CELLS * rows - 1) / 2).ravel()
    away, zeros, ones = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    order = np.lexsort((x, y))  # the newest tap's rows and columns
    here = np.stack([x, y, ones, away], axis=1)[order]
    course = np.concatenate(
        [  # of x there, y there, minus half their squares, and the constant
            *(x, y, zeros, zeros),
            *(-y, x, zeros, zeros),
            *(ones, zeros, zeros, zeros),
            *(zeros, ones, zeros, zeros),
            *(zeros, zeros, -x, zeros),
            *(zeros, zeros, -y, zeros),
            *(zeros, zeros, -ones / 2, zeros),
            *(zeros, zeros, -away / 2, -ones / 2),
        ]
    ).reshape(8, -1)
    return here.astype(np.float32), course.astype(np.float32), np.stack([ones, away]).astype(np.float32)
