"""LPIPS: the distance of two pictures in the features of AlexNet, calibrated by people's judgements.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR 2018), equation 1, version
0.1 as the authors' package `lpips` computes it. It needs PyTorch and two files of weights that do not ship with kalux:
those of AlexNet that torchvision publishes (``alexnet-owt-7be5be79.pth`` at download.pytorch.org/models), and the
authors' calibration (``weights/v0.1/alex.pth`` in the package `lpips`; found by itself where that is installed).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kalux.errors import FormatError, InputError, MissingDependencyError
from kalux.evaluation.pairs import Array, checked_pair

SMALLEST_SIDE: Final = 64
"""Pixels. From fewer, less than four features are left at the last layer."""

_HOME: Final = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
_EPSILON: Final = 1e-10  # of the authors, so that features that are all 0 have a direction
_SHIFT: Final = (-0.030, -0.088, -0.188)  # red, green, blue, in units of -1 to 1
_SCALE: Final = (0.458, 0.448, 0.450)


class _Layer(NamedTuple):
    """A convolution of AlexNet: its name, and what precedes it."""

    name: str
    stride: int
    padding: int
    pooled: bool


_LAYERS: Final = (
    _Layer("features.0", 4, 2, pooled=False),
    _Layer("features.3", 1, 2, pooled=True),
    _Layer("features.6", 1, 1, pooled=True),
    _Layer("features.8", 1, 1, pooled=False),
    _Layer("features.10", 1, 1, pooled=False),
)
_SHAPES: Final[Mapping[str, tuple[int, ...]]] = {
    "features.0.weight": (64, 3, 11, 11),
    "features.3.weight": (192, 64, 5, 5),
    "features.6.weight": (384, 192, 3, 3),
    "features.8.weight": (256, 384, 3, 3),
    "features.10.weight": (256, 256, 3, 3),
}


@dataclass(frozen=True, eq=False)
class LpipsWeights:
    """What `lpips` needs, from `load_lpips`: tensors of AlexNet's convolutions, and of the calibration."""

    backbone: Mapping[str, Any]
    calibration: tuple[Any, ...]


def load_lpips(backbone: Path, calibration: Path | None = None) -> LpipsWeights:
    """Weights for `lpips`; nothing in the files is executed.

    Parameters
    ----------
    backbone
        torchvision's AlexNet, trained on ImageNet.
    calibration
        The authors' ``v0.1/alex.pth``. Default: that of the package `lpips`.

    Raises
    ------
    MissingDependencyError
        If PyTorch is not installed, or no calibration is given and the package `lpips` is not installed.
    InputError
        If a file is missing.
    FormatError
        If a file cannot be read, or does not hold these weights.
    """
    if importlib.util.find_spec("torch") is None:
        raise MissingDependencyError("LPIPS needs PyTorch; pip install 'kalux[learned]'")
    from kalux.evaluation.learned.weights import read_checkpoint

    if not backbone.is_file():
        raise InputError(
            f"{backbone}: no such file; LPIPS needs the weights of AlexNet, published at {_HOME}"
        )
    found = read_checkpoint(backbone).tensors
    shapes = {
        **_SHAPES,
        **{f"{name.removesuffix('weight')}bias": shape[:1] for name, shape in _SHAPES.items()},
    }
    _check(backbone, "AlexNet", shapes, {name: value for name, value in found.items() if name in shapes})
    given = calibration or _installed_calibration()
    if not given.is_file():
        raise InputError(
            f"{given}: no such file; LPIPS needs the authors' v0.1/alex.pth, in the package lpips"
        )
    names = {f"lin{i}.model.1.weight": (1, shape[0], 1, 1) for i, shape in enumerate(_SHAPES.values())}
    calibrated = read_checkpoint(given).tensors
    _check(given, "LPIPS v0.1 for AlexNet", names, calibrated)
    return LpipsWeights(
        {name: found[name].float() for name in shapes}, tuple(calibrated[name].float() for name in names)
    )


def lpips(test: ArrayLike, reference: ArrayLike, *, data_range: float, weights: LpipsWeights) -> float:
    """Perceptual distance of two grey pictures; 0: equal, about 1: unlike.

    Parameters
    ----------
    test, reference
        (H, W), at least 64 x 64. The metric was calibrated with pictures for display, so these should be such, too: it
        tells what tone curve they have no less than what they show.
    data_range
        The value that is white; 0 is black. Values beyond are taken as they are.
    weights
        From `load_lpips`.

    Raises
    ------
    InputError
        If the pictures differ in shape, are too small, or are not finite; or data_range is not positive.
    """
    first, second, _ = checked_pair(test, reference)
    if first.ndim != 2 or min(first.shape) < SMALLEST_SIDE:
        raise InputError(f"LPIPS: pictures {first.shape}; (H, W), at least {SMALLEST_SIDE} each, is needed")
    if not data_range > 0:
        raise InputError(f"LPIPS: data_range is {data_range}; it must be positive")
    import torch

    with torch.inference_mode():
        pairs = zip(
            _features(first / data_range, weights), _features(second / data_range, weights), strict=True
        )
        return sum(
            float((linear * (one - other) ** 2).sum(1).mean())
            for linear, (one, other) in zip(weights.calibration, pairs, strict=True)
        )


def _features(picture: Array, weights: LpipsWeights) -> list[Any]:
    """Of every layer (1, channels, h, w), with length 1 over the channels."""
    import torch
    from torch.nn import functional

    grey = torch.from_numpy((2 * picture - 1).astype(np.float32))
    shift, scale = (torch.tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
    x = ((grey - shift) / scale)[None]
    found = []
    for layer in _LAYERS:
        x = functional.max_pool2d(x, 3, 2) if layer.pooled else x
        kernel, bias = (weights.backbone[f"{layer.name}.{part}"] for part in ("weight", "bias"))
        x = functional.relu(functional.conv2d(x, kernel, bias, layer.stride, layer.padding))
        found.append(x / (x.square().sum(1, keepdim=True).sqrt() + _EPSILON))
    return found


def _check(path: Path, what: str, shapes: Mapping[str, tuple[int, ...]], found: Mapping[str, Any]) -> None:
    wrong = [name for name, shape in shapes.items() if name not in found or tuple(found[name].shape) != shape]
    if wrong or len(found) != len(shapes):
        raise FormatError(
            f"{path}: not the weights of {what}: {len(wrong)} of {len(shapes)} tensors are missing or of another shape"
            + (f", the first is {wrong[0]}" if wrong else "")
        )


def _installed_calibration() -> Path:
    """Where the package `lpips` has its weights, without importing it: it needs torchvision."""
    spec = importlib.util.find_spec("lpips")
    if spec is None or spec.origin is None:
        raise MissingDependencyError(
            "LPIPS: no calibration is given and the package lpips is not installed; give its weights/v0.1/alex.pth, or "
            "pip install lpips"
        )
    return Path(spec.origin).parent / "weights" / "v0.1" / "alex.pth"
