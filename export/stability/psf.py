"""Tactile PSF and its gradients: reach, strength and perceptual region over decades, all or no pixels touching."""

from collections.abc import Iterator
from typing import Final, get_args

import numpy as np
import torch

from export.stability.case import Case, refused, timed
from firmware_bridge.pad_geometry import USPA44
from train.networks.tpsf_net import Form, degrade
from train.physics.tpsf import Kernel, Plateau, spread, tpsf

PART: Final = "tPSF"
BETAS_MM: Final = (1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3)
ALPHAS: Final = (0.0, 1e-6, 1.0, 1e6)
GAMMAS: Final = (1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3)
_SIDE_PX: Final = 40
_PIXEL_MM: Final = USPA44.pixel_pitch_mm(_SIDE_PX // USPA44.rows)
_DOUBLE: Final = 1e-5


def cases(_quick: bool = False) -> Iterator[Case]:
    """Yield all cases."""
    square = torch.zeros(1, _SIDE_PX, _SIDE_PX)
    square[:, 12:28, 12:28] = 1
    for kernel in get_args(Kernel):
        for beta_mm in BETAS_MM:
            yield _press(kernel, "response", f"beta {beta_mm:g} mm", square, 1.0, beta_mm)
        for alpha in ALPHAS:
            yield _press(kernel, "response", f"alpha {alpha:g}", square, alpha, 1.0)
        for plateau in get_args(Plateau):
            whole = _press(kernel, plateau, "the whole face touches", torch.ones_like(square), 1.0, 1.0)
            yield whole
            level = tpsf(torch.ones_like(square), torch.ones(1), torch.ones(1), _PIXEL_MM, kernel, plateau)
            empty = float((level <= 0).float().mean())
            yield Case(PART, f"{kernel}, {plateau}", "the whole face touches", "pixels at zero", empty, 0.0)
            yield _press(kernel, plateau, "nothing touches", torch.zeros_like(square), 1.0, 1.0)
    for form in get_args(Form):
        for gamma in GAMMAS:
            yield _degrade(form, gamma, square)
    for beta in (0.0, -1.0, float("nan")):
        yield refused(
            PART, "beta", f"{beta:g} mm", lambda beta=beta: spread(square, torch.tensor([beta]), _PIXEL_MM), ValueError
        )


def _press(kernel: Kernel, plateau: Plateau, severity: str, depth: torch.Tensor, alpha: float, beta_mm: float) -> Case:
    """Return the case of finite values and gradients, compared with float64."""
    found = {}
    run_ms = 0.0
    for dtype in (torch.float32, torch.float64):
        a = torch.tensor([alpha], dtype=dtype, requires_grad=True)
        b = torch.tensor([beta_mm], dtype=dtype, requires_grad=True)
        pattern, ms = timed(lambda a=a, b=b, dtype=dtype: tpsf(depth.to(dtype), a, b, _PIXEL_MM, kernel, plateau))
        run_ms = ms if dtype is torch.float32 else run_ms
        slopes = torch.autograd.grad(pattern.sum(), (a, b))
        found[dtype] = (pattern.detach().double(), torch.cat(slopes).double())
    (pattern, slopes), (true, _) = found[torch.float32], found[torch.float64]
    finite = bool(torch.isfinite(pattern).all() and torch.isfinite(slopes).all())
    apart = float((pattern - true).abs().max() / true.abs().max().clamp_min(torch.finfo(torch.float32).tiny))
    name = f"{kernel}, {plateau}"
    return Case(PART, name, severity, "float32 to float64, slopes finite", apart if finite else np.nan, _DOUBLE, run_ms)


def _degrade(form: Form, gamma: float, depth: torch.Tensor) -> Case:
    found = {}
    run_ms = 0.0
    for dtype in (torch.float32, torch.float64):
        g = torch.tensor(gamma, dtype=dtype, requires_grad=True)
        z, ms = timed(lambda g=g, dtype=dtype: degrade(depth.to(dtype), g, USPA44, form))
        run_ms = ms if dtype is torch.float32 else run_ms
        (slope,) = torch.autograd.grad(z.sum(), g)
        found[dtype] = (z.detach().double(), slope)
    (z, slope), (true, _) = found[torch.float32], found[torch.float64]
    finite = bool(torch.isfinite(z).all() and torch.isfinite(slope))
    apart = float((z - true).abs().max() / true.abs().max().clamp_min(torch.finfo(torch.float32).tiny))
    return Case(
        PART,
        f"degradation, {form}",
        f"gamma {gamma:g}",
        "float32 to float64, slope finite",
        apart if finite else np.nan,
        _DOUBLE,
        run_ms,
    )
