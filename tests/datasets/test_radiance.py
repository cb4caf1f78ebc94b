"""Files of radiance: they give back what was written, and damage is told."""

from __future__ import annotations

import io

import numpy as np
import pytest

from kalux.datasets.hdr import hdr_reference
from kalux.datasets.radiance import encode_radiance, read_radiance
from kalux.errors import FormatError
from kalux.models.camera import Response
from photographs import photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


@pytest.mark.parametrize("suffix", [".exr", ".npz"])
def test_files_give_back_what_was_written(scene, tmp_path, suffix):
    found = hdr_reference(photographs(scene), response=Response.srgb(), aligned=False)
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(encode_radiance(found, suffix))
    again = read_radiance(path)
    assert np.array_equal(again.radiance, found.radiance)
    assert np.array_equal(again.valid, found.valid)


def _zip_of(at, value):
    """The bytes of an .npz of 20 x 30, one of them replaced."""
    file = io.BytesIO()
    np.savez_compressed(file, radiance=np.arange(600.0).reshape(20, 30))
    data = bytearray(file.getvalue())
    data[at] = value
    return bytes(data)


@pytest.mark.parametrize("data", [b"PK\x03\x04 cut off", _zip_of(70, 255), _zip_of(-6, 255)])
def test_damaged_radiance(tmp_path, data):
    (tmp_path / "r.npz").write_bytes(data)
    with pytest.raises(FormatError, match=r"r\.npz: not an \.npz with the array radiance, or damaged"):
        read_radiance(tmp_path / "r.npz")


def test_validity_must_fit_the_radiance(tmp_path):
    np.savez(tmp_path / "r.npz", radiance=np.ones((20, 30)), valid=np.ones((20, 31), bool))
    with pytest.raises(FormatError, match=r"valid is \(20, 31\), the radiance \(20, 30\)"):
        read_radiance(tmp_path / "r.npz")
