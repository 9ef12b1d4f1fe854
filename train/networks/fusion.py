"""Network that fuses taps from any poses: what earlier taps show is carried into the newest tap's axes.

The newest tap takes the way of a network of one tap. Every earlier tap is encoded in its own axes, all by the same
weights; each cell of the trunk takes a weighted mean over the cells of all earlier taps, whose weights fall with their
distance by the poses. Half-way through the trunk its state is carried the other way and compared with each tap's
readings, and what differs comes back. What a chip shows in all taps is averaged there, because a gain belongs to the
chip and not to the place. Number and order of the earlier taps are free, and one tap alone is a network of one tap.
"""

from math import log
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from train.networks.compact import QUIET_UNITS, CompactNet, Seen, tap_amplitude
from train.networks.symmetric import Group, SymmetricConv2d, fields, scalars, vectors
from train.surfaces.poses import ANGLE_STEP_DEG

_CARRIED: Final = 48
"""Channels that are carried between the taps' axes."""
_HEADS: Final = 12
"""Weights of each cell, one for every field of carried channels."""
_CELLS: Final = 2
"""Cells per taxel pitch, those of the trunk: readings hold no finer wave than two pitches."""
_FIRST_REACH: Final = 0.5
"""Distance in cells at which a weight has fallen to .6, before training."""
_LEAST_WEIGHT: Final = 1e-2
_PLACE_MM: Final = 5.0
_TURN_ERROR_DEG: Final = 5.0
"""Lengths and angles that enter as 1."""


class FusionNet(CompactNet):
    """Network from a window of 1 to K taps and their poses to pattern, deviation and traction.

    Args:
        taps: K, the most taps.
        scale: pattern pixels per taxel pitch, even.
        channels: of the trunk, a multiple of the symmetries.
        blocks: residual blocks of the trunk.
        known: numbers that say constants of the pad.
        group: symmetries.
        intervals: correct the deviations by region.

    Raises:
        ValueError: fewer than two taps, an odd scale, or channels that do not divide.
    """

    takes_poses = True

    def __init__(
        self,
        taps: int,
        scale: int,
        channels: int = 64,
        blocks: int = 6,
        known: int = 0,
        group: Group = "p4",
        intervals: bool = False,
    ) -> None:
        if taps < 2:
            raise ValueError(f"{taps} taps asked for, expected at least 2: a network of one tap has nothing to fuse")
        super().__init__(1, scale, channels, blocks, known, group)
        self.taps = taps
        wide, merged = fields(group, channels), fields(group, channels * 3 // 2)
        about, pose = scalars(group, known + 1), vectors(group) + scalars(group, 4)
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
        self.log_reach = nn.Parameter(torch.full((2,), log(_FIRST_REACH)))
        if intervals:
            self.add_intervals()

    def take_over(self, start: CompactNet) -> None:
        """Copy a network of one tap, or another one of this kind; what encodes earlier taps starts as its entrance.

        Raises:
            ValueError: another width, or another number of inputs for the pad.
        """
        if isinstance(start, FusionNet):
            try:
                self.load_state_dict(start.state_dict())
            except RuntimeError as error:
                raise ValueError(str(error).splitlines()[-1].strip()) from error
            return
        super().take_over(start)
        weight = torch.zeros_like(self.enter_earlier.weight)
        entrance = self.enter.weight.detach()
        weight[:, : entrance.shape[1]] = entrance
        self.enter_earlier.assign(weight, self.enter.bias.detach())
        self.encode[1].load_state_dict(self.merge[1].state_dict())

    def forward(
        self, window: Tensor, pad: Tensor | None = None, poses: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return patterns and their deviations, both (n, H, W) in [mm], and tractions (n, 3, h, w) in [kPa].

        Args:
            window: (n, 3k, rows, cols) in network units, of 1 to K taps, newest first; absent taps are all zeros.
            pad: (n, known), constants of the pads; None for no constants.
            poses: (n, k, 5), x, y in [mm] and turn in [deg] of each tap in the newest one's axes, then the standard
                deviations of place and turn; None for the paper's schedule.
        """
        return self.finished(self.see(window, pad, poses))

    def see(self, window: Tensor, pad: Tensor | None = None, poses: Tensor | None = None) -> Seen:
        """Return the outputs before any correction, and what they were made of; arguments as `forward`."""
        rows, cols = window.shape[2:]
        taps = window.unflatten(1, (-1, 3))
        amplitude = tap_amplitude(taps)
        shapes, newest = taps / amplitude, amplitude[:, 0, 0]
        there = (amplitude[:, 1:] > QUIET_UNITS).to(window.dtype)
        entered = self.enter_pad(shapes[:, 0], shapes[:, 0], self.about(newest, pad))
        poses = self._schedule(taps) if poses is None else poses
        carrier = _Carrier(poses[:, 1:], there, (rows * _CELLS, cols * _CELLS), self.log_reach)

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

    @staticmethod
    def _schedule(taps: Tensor) -> Tensor:
        """Return the poses of the paper's schedule, (n, k, 5)."""
        number = torch.arange(taps.shape[1], dtype=taps.dtype)[:, None]
        later = (number > 0).to(taps.dtype)
        zeros = torch.zeros_like(number)
        errors = [later * PLACE_ERROR_MM, later * TURN_ERROR_DEG]
        return torch.cat([zeros, zeros, number * ANGLE_STEP_DEG, *errors], dim=1).expand(len(taps), -1, -1)


class _Carrier:
    """Exchange of features between the cells of earlier taps and those of the newest one, by the taps' poses.

    A weight is a Gaussian of two cells' distance; the error of the pose widens it.

    Args:
        poses: (n, k - 1, 5) of the earlier taps.
        there: (n, k - 1, 1, 1, 1), 1 for each that is there, else 0.
        shape: cells of a pad, (height, width).
        log_reach: (2,), logarithms of the Gaussians' deviations in cells, to the newest tap and from it.

    Attributes:
        inputs: (n, k - 1, 7), the poses as inputs of the encoder.
        any: (n, 1, 1, 1), 1 where some earlier tap is there, else 0.
    """

    def __init__(self, poses: Tensor, there: Tensor, shape: tuple[int, int], log_reach: Tensor) -> None:
        self._taps, self._shape = poses.shape[:2], shape
        place, turn, errors = poses[..., :2], torch.deg2rad(poses[..., 2:3]), poses[..., 3:]
        cosine, sine = torch.cos(turn), torch.sin(turn)
        about_errors = torch.cat([errors[..., :1], errors[..., 1:] / _TURN_ERROR_DEG], dim=2)
        self.inputs = torch.cat([place / _PLACE_MM, torch.zeros_like(turn), 1 - cosine, sine, about_errors], dim=2)
        self.any = (there.sum(dim=1) > 0).to(poses.dtype)
        cell_mm = USPA44.pitch_mm / _CELLS
        down, across = (torch.arange(length) - (length - 1) / 2 for length in shape)
        y, x = (grid.flatten().to(poses.dtype) for grid in torch.meshgrid(down, across, indexing="ij"))
        x_there = cosine * x - sine * y + place[..., :1] / cell_mm  # (n, k - 1, cells), in the newest tap's axes
        y_there = sine * x + cosine * y + place[..., 1:] / cell_mm
        away = x * x + y * y
        error = (errors[..., :1] / cell_mm).square() + torch.deg2rad(errors[..., 1:]).square() * away
        # Minus half the squared distance over the variance, as one product of matrices.
        here = torch.stack([x, y, torch.ones_like(x), away], dim=1)
        whole = x_there * x_there + y_there * y_there
        self._weights: list[Tensor] = []
        for variance in torch.exp(2 * log_reach).unbind():
            inverse = 1 / (variance + error)
            terms = torch.stack([x_there, y_there, -whole / 2, torch.full_like(whole, -0.5)], dim=3)
            terms = (terms * inverse[..., None]).flatten(1, 2).transpose(1, 2)
            self._weights.append(torch.exp((here @ terms).clamp_max(0.0)))  # (n, cells, (k - 1) cells)
        self._there = there[:, :, 0, 0].expand(-1, -1, len(x)).flatten(1)[..., None]

    def to_newest(self, sent: Tensor) -> Tensor:
        """Return carried channels and the logarithms of their weights, (n, c + heads, H, W), of what taps sent.

        Args:
            sent: (n (k - 1), 4 (c + heads), rows, cols), four cells of a taxel side by side as before a pixel shuffle.
        """
        count, earlier = self._taps
        apart = sent.view(count, earlier, _CARRIED + _HEADS, _CELLS, _CELLS, *sent.shape[2:])
        cells = apart.permute(0, 1, 5, 3, 6, 4, 2).flatten(1, 5)  # (n, (k - 1) cells, c + heads)
        weight = F.softplus(cells[..., _CARRIED:]) * self._there
        weighted = (cells[..., :_CARRIED].unflatten(2, (_HEADS, -1)) * weight[..., None]).flatten(2)
        total = self._weights[0] @ torch.cat([weighted, weight], dim=2)
        amount = total[..., _CARRIED:] + _LEAST_WEIGHT
        mean = (total[..., :_CARRIED].unflatten(2, (_HEADS, -1)) / amount[..., None]).flatten(2)
        return torch.cat([mean, torch.log(amount)], dim=2).transpose(1, 2).unflatten(2, self._shape)

    def to_taps(self, state: Tensor) -> Tensor:
        """Return channels (n, c, H, W) of the newest tap's cells in each earlier tap's axes.

        Returns:
            (n (k - 1), 4 c, rows, cols), four cells of a taxel side by side.
        """
        weight = self._weights[1].transpose(1, 2)
        weight = weight / (weight.sum(dim=2, keepdim=True) + _LEAST_WEIGHT)
        moved = weight @ state.flatten(2).transpose(1, 2)
        (count, earlier), (height, width), channels = self._taps, self._shape, state.shape[1]
        rows, cols = height // _CELLS, width // _CELLS
        apart = moved.view(count, earlier, rows, _CELLS, cols, _CELLS, channels).permute(0, 1, 6, 3, 5, 2, 4)
        return apart.reshape(count * earlier, channels * _CELLS**2, rows, cols)
