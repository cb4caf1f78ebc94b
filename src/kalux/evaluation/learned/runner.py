"""Networks over recordings: windows of events, state from window to window, images at any time.

The networks were trained on the events between frames, and EVREAL evaluates them so: a window ends at the middle of
each frame, and its image is that of this time. Between two such times an image is made of a shorter or longer window,
of at least a third and less than four thirds, from the state before it: reading changes nothing, and an image does not
depend on which others are wanted. Only the times of frames are used, never their pixels.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from kalux.errors import InputError
from kalux.evaluation.baselines import EventWindow
from kalux.evaluation.exposures import linear_frame
from kalux.evaluation.learned.catalogue import NETWORKS, Tone
from kalux.evaluation.learned.networks import Network
from kalux.evaluation.learned.voxels import normalise, voxel_grid
from kalux.evaluation.learned.weights import load_network
from kalux.evaluation.method import Image, Times
from kalux.recording import Recording, reference_exposure
from kalux.wording import how_many

SHARE_OF_WINDOW: Final = 3
"""An image comes from at least one third of a window. At a half, the reads across the exposure of a frame that is held
out half-way between two others would come from windows of different kinds."""

ROBUST_PERCENTILES: Final = (1.0, 99.0)
"""As EVREAL stretches E2VID's images."""


def images(
    recording: Recording,
    times: Times,
    *,
    name: str,
    path: Path,
    window: int | None = None,
    scaled: bool = False,
    response: str = "linear",
) -> Iterator[Image]:
    """Images of a network at given times.

    Parameters
    ----------
    recording
        Its events, and the times of its frames.
    times
        (N,) int64 us, ascending.
    name
        Of `kalux.evaluation.learned.catalogue.NETWORKS`.
    path
        Its weights.
    window
        us; None: from frame to frame.
    scaled
        Whether intensity is scaled to that of the recording's frames, with one gain and one offset for all images.
    response
        Of the camera, as in `kalux.settings.CameraSettings`; for ``scaled``.

    Yields
    ------
    numpy.ndarray
        (H, W) float32, 0 to 1. What the networks take for intensity is that of their training: values of a camera's
        frames, 1 = white. It is clipped to this range, as in the published programs. Events do not tell the scale, so a
        dark recording gives images as bright as any other; ``scaled`` images are linear, 1 = a saturated pixel at the
        recording's median exposure, at least 0.

    Raises
    ------
    InputError
        If there are no events, or fewer than two frames and no window is given.
    FormatError
        If the weights cannot be used.
    """
    network = load_network(name, path)
    gain, offset = fit_scale(recording, name, network, window, response) if scaled else (1.0, 0.0)
    for image in network_images(recording, times, name, network, window):
        yield np.maximum(gain * image + offset, 0.0, dtype=np.float32) if scaled else image


def fit_scale(
    recording: Recording, name: str, network: Network, window: int | None, response: str
) -> tuple[float, float]:
    """Gain and offset that bring a network's images nearest to the recording's frames, by least squares."""
    reference = reference_exposure(recording)
    middles = np.array([frame.middle for frame in recording.frames()], np.int64)
    moments = np.zeros(5)
    made = network_images(recording, middles, name, network, window)
    for frame, image in zip(recording.frames(), made, strict=True):
        x, y = image.astype(np.float64).ravel(), linear_frame(frame, reference, response).ravel()
        moments += np.array([x.size, x.sum(), y.sum(), (x * x).sum(), (x * y).sum()])
    pixels, x_sum, y_sum, xx, xy = moments
    spread = pixels * xx - x_sum**2
    gain = float((pixels * xy - x_sum * y_sum) / spread) if spread > 0 else 0.0
    return gain, float((y_sum - gain * x_sum) / pixels)


def network_images(
    recording: Recording, times: Times, name: str, network: Network, window: int | None
) -> Iterator[Image]:
    """As `images`, not scaled."""
    published = NETWORKS[name]
    events = EventWindow(recording.events())
    windows = pairwise(window_edges(recording, window))
    current, following, state = next(windows), next(windows), None

    def grid(start: int, end: int) -> NDArray[np.float32]:
        found = voxel_grid(events.between(start, end), recording.sensor_size, network.bins)
        return normalise(found) if published.normalised else found

    for t in times.tolist():
        while SHARE_OF_WINDOW * (t - current[1]) >= following[1] - following[0]:
            _, state = step(network, grid(*current), state)
            current, following = following, next(windows)
        image, _ = step(network, grid(current[0], t), state)
        yield toned(image, published.tone)


def step(network: Network, grid: NDArray[np.float32], state: Any) -> tuple[NDArray[np.float32], Any]:
    """One window through a network: (bins, H, W) and its state to the image (H, W) and the following state.

    Around the grid are zeros where the network needs multiples of a size, as in EVREAL.
    """
    height, width = grid.shape[1:]
    top, bottom = _margins(height, network.multiple)
    left, right = _margins(width, network.multiple)
    padded = np.pad(grid, ((0, 0), (top, bottom), (left, right)))
    with torch.inference_mode(), _one_thread():
        image, following = network(torch.from_numpy(padded)[None], state)
    found: NDArray[np.float32] = image[0, 0, top : top + height, left : left + width].numpy()
    return found, following


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch sums in another order with another number of threads, and images would depend on the machine's load."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _margins(size: int, multiple: int) -> tuple[int, int]:
    missing = -size % multiple
    return (missing + 1) // 2, missing // 2


def window_edges(recording: Recording, window: int | None = None) -> Iterator[int]:
    """Where windows of events end, us, without end; the first lies before the first event.

    From frame to frame these are the middles of the exposures, continued on both sides at their median distance.

    Raises
    ------
    InputError
        If there are no events, or fewer than two frames and no window is given.
    """
    first = next((int(chunk["t"][0]) for chunk in recording.events()), None)
    if first is None:
        raise InputError(f"{recording.source.path}: has no events, of which the networks make their images")
    if window is not None:
        return count(first - 1, window)
    middles = [frame.middle for frame in recording.frames()]
    if len(middles) < 2:
        raise InputError(
            f"{recording.source.path}: has {how_many(len(middles), 'frame')}, so there is no window of events "
            "from frame to frame; give one in us: NAME:FILE?window=40000"
        )
    distance = round(float(np.median(np.diff(middles))))
    passed = bisect_left(middles, first)
    lead = 0 if passed else (middles[0] - first) // distance + 1
    return chain(
        range(middles[0] - lead * distance, middles[0], distance),
        middles[max(passed - 1, 0) :],
        count(middles[-1] + distance, distance),
    )


def toned(image: NDArray[Any], tone: Tone) -> Image:
    """An image of 0 to 1, perhaps stretched before."""
    if tone == "robust":
        low, high = np.percentile(image, ROBUST_PERCENTILES)
        image = (image - low) / max(high - low, np.finfo(np.float32).eps)
    clipped: Image = np.clip(image, 0.0, 1.0).astype(np.float32)
    return clipped
