"""LPIPS, with random weights: those of AlexNet cannot be had here."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")

from kalux.errors import FormatError, InputError, MissingDependencyError  # noqa: E402
from kalux.evaluation import lpips as module  # noqa: E402
from kalux.evaluation.lpips import load_lpips, lpips  # noqa: E402
from random_networks import ALEXNET, write_lpips  # noqa: E402


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_lpips(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def weights(files):
    return load_lpips(*files)


def pictures(seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((2, 64, 70))


def test_equation_1_by_modules_and_loops(weights):
    """Equation 1 of the paper, written with PyTorch's layers and NumPy."""
    layers = []
    for number, shape in ALEXNET.items():
        layer = torch.nn.Conv2d(
            shape[1], shape[0], shape[2], *((4, 2) if number == 0 else (1, shape[2] // 2))
        )
        layer.weight.data = weights.backbone[f"features.{number}.weight"]
        layer.bias.data = weights.backbone[f"features.{number}.bias"]
        layers.append((number, layer))

    def features(picture):
        colour = np.repeat(2 * picture[None] - 1, 3, 0)
        mean, deviation = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
        x = torch.from_numpy((colour - mean[:, None, None]) / deviation[:, None, None]).float()[None]
        for number, layer in layers:
            x = torch.nn.MaxPool2d(3, 2)(x) if number in (3, 6) else x
            x = torch.relu(layer(x))
            y = x.detach().numpy()[0].astype(float)
            yield y / np.sqrt((y**2).sum(0))

    test, reference = pictures()
    expected = 0.0
    for linear, a, b in zip(weights.calibration, features(test), features(reference), strict=True):
        for i in range(a.shape[1]):
            for j in range(a.shape[2]):
                difference = (a[:, i, j] - b[:, i, j]) ** 2
                expected += linear.numpy().ravel() @ difference / (a.shape[1] * a.shape[2])
    assert lpips(test, reference, data_range=1.0, weights=weights) == pytest.approx(expected, rel=1e-5)


def test_a_distance(weights):
    test, reference = pictures()
    found = lpips(test, reference, data_range=1.0, weights=weights)
    assert found > 0
    assert lpips(reference, test, data_range=1.0, weights=weights) == pytest.approx(found)
    assert lpips(test, test, data_range=1.0, weights=weights) == 0
    assert lpips(7 * test, 7 * reference, data_range=7.0, weights=weights) == pytest.approx(found, rel=1e-4)
    near = lpips(0.9 * reference + 0.1 * test, reference, data_range=1.0, weights=weights)
    assert near < found


@pytest.mark.parametrize(
    ("test", "data_range", "told"),
    [
        (np.zeros((64, 64)), 0.0, "data_range is 0.0"),
        (np.zeros((63, 64)), 1.0, "at least 64"),
        (np.full((64, 64), np.nan), 1.0, "not finite"),
    ],
)
def test_what_cannot_be_compared(test, data_range, told, weights):
    with pytest.raises(InputError, match=told):
        lpips(
            test,
            np.zeros_like(test, float) if "finite" in told else test,
            data_range=data_range,
            weights=weights,
        )


def test_missing_and_wrong_weights_are_told(files, tmp_path, monkeypatch):
    backbone, calibration = files
    with pytest.raises(InputError, match=r"none\.pth: no such file.*download\.pytorch\.org"):
        load_lpips(tmp_path / "none.pth", calibration)
    with pytest.raises(InputError, match=r"none\.pth: no such file"):
        load_lpips(backbone, tmp_path / "none.pth")
    with pytest.raises(FormatError, match="not the weights of AlexNet"):
        load_lpips(calibration, calibration)
    with pytest.raises(FormatError, match="not the weights of LPIPS"):
        load_lpips(backbone, backbone)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"kalux\[learned\]"):
        load_lpips(backbone, calibration)


def test_the_calibration_of_the_installed_package_is_found(files, tmp_path, monkeypatch):
    """A package of this name with the file where the real one has it."""
    place = tmp_path / "lpips" / "weights" / "v0.1"
    place.mkdir(parents=True)
    (tmp_path / "lpips" / "__init__.py").write_text("raise ImportError('needs torchvision')")
    (place / "alex.pth").write_bytes(files[1].read_bytes())
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert module._installed_calibration() == place / "alex.pth"
    assert len(load_lpips(files[0]).calibration) == 5
