"""Convolutions that are exactly symmetric under quarter turns and mirror images of the pad.

A contact that is turned or mirrored has the turned or mirrored pattern: a square pad has no preferred direction.
A symmetry of the square permutes channels, with a sign for those with a direction (the shear x, y). A kernel that
keeps this has one free number for each orbit of its entries; the others are copies. Written out, it is an ordinary
convolution, at the same cost.

Source: Cohen and Welling 2016, group equivariant convolutional networks, p4 and p4m.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

# The half turn, as any rectangle has it, the four quarter turns, or these and their mirror images.
Group = Literal["p2", "p4", "p4m"]

_ELEMENTS: Final[dict[Group, tuple[tuple[int, bool], ...]]] = {
    "p2": ((0, False), (2, False)),
    "p4": tuple((turns, False) for turns in range(4)),
    "p4m": tuple((turns, mirrored) for mirrored in (False, True) for turns in range(4)),
}


@dataclass(frozen=True, slots=True)
class Channels:
    """Channels under symmetries g: channel i becomes sign[g, i], 1 or -1, times channel index[g, i]."""

    group: Group
    index: NDArray[np.int64]
    sign: NDArray[np.int64]

    def __len__(self) -> int:
        return self.index.shape[1]

    def __add__(self, other: "Channels") -> "Channels":
        """Return these channels followed by the others."""
        index = np.concatenate([self.index, other.index + len(self)], axis=1)
        return Channels(self.group, index, np.concatenate([self.sign, other.sign], axis=1))

    def __mul__(self, times: int) -> "Channels":
        """Return the same channels `times` times, one set after the other."""
        return reduce(Channels.__add__, [self] * times)

    def shuffled(self, side: int) -> "Channels":
        """Return the channels before a pixel shuffle, `side` x `side` pixels of each of these."""
        pixels = _moved_places(self.group, side)
        index = self.index[:, :, None] * side * side + pixels[:, None, :]
        sign = np.repeat(self.sign, side * side, axis=1)
        return Channels(self.group, index.reshape(len(index), -1), sign)


def scalars(group: Group, count: int) -> Channels:
    """Return channels that no symmetry changes: pressure, deviation, constants of the pad."""
    elements = len(_ELEMENTS[group])
    return Channels(group, np.tile(np.arange(count), (elements, 1)), np.ones((elements, count), dtype=np.int64))


def vectors(group: Group, count: int = 1) -> Channels:
    """Return channels x, y, z of `count` vectors: x to the right and y down turn with the pad, z does not."""
    index, sign = [], []
    for turns, mirrored in _ELEMENTS[group]:
        place, signs = np.array([0, 1, 2]), np.array([-1 if mirrored else 1, 1, 1])
        for _ in range(turns):  # a quarter turn maps y to x, and x to -y
            place, signs = place[[1, 0, 2]], signs[[1, 0, 2]] * np.array([1, -1, 1])
        index.append(place)
        sign.append(signs)
    return Channels(group, np.array(index), np.array(sign)) * count


def fields(group: Group, channels: int) -> Channels:
    """Return hidden channels in groups of as many as there are symmetries, which permute them."""
    elements = len(_ELEMENTS[group])
    if channels % elements:
        raise ValueError(f"{channels} channels, expected a multiple of the {elements} symmetries of {group}")
    places = _moved_places(group, 3)
    place_of = {tuple(places[g]): g for g in range(elements)}
    # Places move as (T_g f)[p] = f[places[g][p]], so T_g after T_h reads places[h] at places[g].
    product = np.array([[place_of[tuple(places[h][places[g]])] for h in range(elements)] for g in range(elements)])
    inverse = product.argmin(axis=1)  # element 0 is the identity
    index = product[inverse]
    return Channels(group, index, np.ones_like(index)) * (channels // elements)


class SymmetricConv2d(nn.Module):
    """Convolution that keeps the size and commutes with the symmetries; `kernel` is odd."""

    def __init__(self, enter: Channels, leave: Channels, kernel: int) -> None:
        super().__init__()
        places = _moved_places(enter.group, kernel)
        shape = (len(leave), len(enter), kernel, kernel)
        count = len(leave) * len(enter)
        moved = leave.index[:, :, None] * len(enter) + enter.index[:, None, :]
        moved = moved.reshape(-1, count)[:, :, None] * kernel**2 + places[:, None, :]
        signs = leave.sign[:, :, None] * enter.sign[:, None, :]
        signs = np.broadcast_to(signs.reshape(-1, count, 1), moved.shape)
        self._orbits("weight", moved.reshape(len(moved), -1), signs.reshape(len(signs), -1), shape)
        self._orbits("bias", leave.index, leave.sign, (len(leave),))
        self._padding = kernel // 2
        bound = 1 / (len(enter) * kernel**2) ** 0.5  # the bound of torch's initialisation of nn.Conv2d
        for free in (self.weight_free, self.bias_free):
            nn.init.uniform_(free, -bound, bound)

    def _orbits(self, name: str, moved: NDArray[np.int64], signs: NDArray[np.int64], shape: tuple[int, ...]) -> None:
        """Register one free number for each orbit of entries, and each entry's orbit and sign."""
        first = moved.argmin(axis=0)
        lowest = np.take_along_axis(moved, first[None], axis=0)[0]
        sign = np.take_along_axis(signs, first[None], axis=0)[0]
        against_itself = ((moved == np.arange(moved.shape[1])) & (signs < 0)).any(axis=0)
        places, orbit = np.unique(lowest, return_inverse=True)
        sign = np.where(against_itself[lowest], 0, sign)
        setattr(self, f"{name}_free", nn.Parameter(torch.zeros(len(places))))
        self.register_buffer(f"_{name}_orbit", torch.from_numpy(orbit.reshape(-1)), persistent=False)
        sign_of = torch.from_numpy(sign.astype(np.float32)).reshape(shape)
        self.register_buffer(f"_{name}_sign", sign_of, persistent=False)

    weight_free: nn.Parameter
    bias_free: nn.Parameter
    _weight_orbit: Tensor
    _weight_sign: Tensor
    _bias_orbit: Tensor
    _bias_sign: Tensor

    @property
    def weight(self) -> Tensor:
        """Kernel written out, (leave, enter, kernel, kernel)."""
        return self.weight_free.index_select(0, self._weight_orbit).view_as(self._weight_sign) * self._weight_sign

    @property
    def bias(self) -> Tensor:
        """Bias written out, (leave,)."""
        return self.bias_free.index_select(0, self._bias_orbit).view_as(self._bias_sign) * self._bias_sign

    def forward(self, x: Tensor) -> Tensor:
        """Map (n, enter, H, W) to (n, leave, H, W)."""
        # Channels last takes an eighth less time to train (2 cores, batch 64).
        weight = self.weight.contiguous(memory_format=torch.channels_last)
        return F.conv2d(x, weight, self.bias, padding=self._padding)

    @torch.no_grad()
    def assign(self, weight: Tensor, bias: Tensor) -> None:
        """Set the symmetric part of a kernel (leave, enter, kernel, kernel) and a bias (leave,)."""
        for name, values in (("weight", weight), ("bias", bias)):
            orbit, sign = getattr(self, f"_{name}_orbit"), getattr(self, f"_{name}_sign").flatten()
            free = getattr(self, f"{name}_free")
            total = torch.zeros_like(free).index_add_(0, orbit, values.flatten() * sign)
            free.copy_(total / torch.bincount(orbit, minlength=len(free)))

    def written_out(self) -> nn.Conv2d:
        """Return the equivalent ordinary convolution, with its own weights."""
        leave, enter, kernel, _ = self._weight_sign.shape
        plain = nn.Conv2d(enter, leave, kernel, padding=self._padding)
        plain.load_state_dict({"weight": self.weight, "bias": self.bias})
        return plain


def write_out(net: nn.Module) -> nn.Module:
    """Replace every symmetric convolution of a network, in place, by the equivalent ordinary one.

    A part that computes with its parameters before it uses them has a `write_out` of its own.
    """
    if (own := getattr(net, "write_out", None)) is not None:
        own()
    for name, part in net.named_children():
        if isinstance(part, SymmetricConv2d):
            setattr(net, name, part.written_out())
        else:
            write_out(part)
    return net


def read_back(net: nn.Module, written: Mapping[str, Tensor]) -> list[str]:
    """Set a network's weights to those of its copy that was written out, by name, and return the names that lack.

    A part that computes with its parameters before it uses them has a `read_back` of its own.
    """
    given = dict(written)
    for name, part in net.named_modules():
        if (own := getattr(part, "read_back", None)) is not None:
            own(given)
        if isinstance(part, SymmetricConv2d) and {f"{name}.weight", f"{name}.bias"} <= given.keys():
            part.assign(given[f"{name}.weight"], given[f"{name}.bias"])
            given |= {f"{name}.{free}": getattr(part, free).detach() for free in ("weight_free", "bias_free")}
    state = net.state_dict()
    lacking = [name for name in state if name not in given]
    if not lacking:
        net.load_state_dict({name: given[name].reshape(value.shape) for name, value in state.items()})
    return lacking


def symmetries(group: Group) -> list[Callable[[NDArray[np.generic]], NDArray[np.generic]]]:
    """Return each symmetry as a function on the last two axes of an array."""
    return [partial(_move, turns=turns, mirrored=mirrored) for turns, mirrored in _ELEMENTS[group]]


def moved_scans(scans: NDArray[np.float32], number: int) -> NDArray[np.float32]:
    """Return scans (..., 3, rows, cols) after symmetry `number` of p4m, axes and all: 0-3 turns, 4-7 mirror images."""
    channels = vectors("p4m")
    placed = _move(scans, *_ELEMENTS["p4m"][number])[..., channels.index[number], :, :]
    return placed * channels.sign[number].astype(np.float32)[:, None, None]


def _move(maps: NDArray[Any], turns: int, mirrored: bool) -> NDArray[Any]:
    return np.rot90(maps[..., ::-1] if mirrored else maps, turns, axes=(-2, -1))


@lru_cache
def _moved_places(group: Group, side: int) -> NDArray[np.int64]:
    """Return the source of each pixel of a `side` x `side` map under each symmetry, (symmetries, side * side)."""
    places = np.arange(side * side).reshape(side, side)
    return np.array([_move(places, *element).ravel() for element in _ELEMENTS[group]], dtype=np.int64)
