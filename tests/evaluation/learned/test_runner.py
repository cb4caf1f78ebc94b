"""Networks over recordings: windows, state, reading at any time."""

from __future__ import annotations

import dataclasses
from itertools import islice, pairwise

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")

import kalux  # noqa: E402
from kalux import Recording  # noqa: E402
from kalux.errors import InputError  # noqa: E402
from kalux.evaluation.learned.runner import fit_scale, images, network_images, step, toned, window_edges  # noqa: E402
from kalux.evaluation.learned.voxels import normalise, voxel_grid  # noqa: E402
from kalux.evaluation.learned.weights import load_network  # noqa: E402
from random_networks import CASES, save  # noqa: E402

from builders import frame, moving_blocks, pixel_events  # noqa: E402

anywhere = pytest.mark.filterwarnings(
    "ignore:arrays"
)  # events before and after all frames, of which it is told


def recording_of(middles, times, size=(3, 4)):
    shots = [frame(100, t - 5, t + 5, size) for t in middles]
    return Recording.from_arrays(
        pixel_events(times, [i % 3 > 0 for i in range(len(times))]), shots, sensor_size=size
    )


def edges(recording, number, window=None):
    return list(islice(window_edges(recording, window), number))


@pytest.fixture
def weights(tmp_path):
    def of(name):
        return save(CASES[name], tmp_path / "weights.pth")

    return of


@anywhere
def test_windows_end_with_the_frames_and_go_on_on_both_sides():
    assert edges(recording_of([1000, 1100, 1210], [950]), 6) == [895, 1000, 1100, 1210, 1315, 1420]
    assert edges(recording_of([1000, 1100, 1200], [790]), 5) == [700, 800, 900, 1000, 1100]
    assert edges(recording_of([1000, 1100, 1200], [1000]), 3) == [900, 1000, 1100]


@anywhere
def test_windows_begin_just_before_the_first_event():
    assert edges(recording_of([1000, 1100, 1200], [1101]), 3) == [1100, 1200, 1300]
    assert edges(recording_of([1000, 1100, 1200], [5000]), 3) == [1200, 1300, 1400]
    assert edges(recording_of([1000, 1100, 1200], [1150]), 4, window=30) == [1149, 1179, 1209, 1239]


@anywhere
def test_windows_need_events_and_two_frames_or_a_length():
    with pytest.raises(InputError, match="has no events"):
        edges(recording_of([100, 200], []), 1)
    with pytest.raises(InputError, match=r"has 1 frame,.*window=40000"):
        edges(recording_of([100], [5]), 1)
    assert edges(recording_of([100], [5]), 2, window=10) == [4, 14]


@pytest.mark.parametrize("name", CASES)
def test_images_at_frames_come_from_the_windows_between_them(name, weights):
    """Step by step by hand; another order of reading, or more reads, changes nothing."""
    simulation, case = moving_blocks(size=(30, 41)), CASES[name]
    recording, path = simulation.recording(), weights(name)
    network, normalised = load_network(case.name, path), case.name in ("e2vid", "firenet")
    tone = "robust" if case.name == "e2vid" else "none"
    ends = edges(recording, 6)
    state, expected = None, []
    for start, end in pairwise(ends):
        t = simulation.events["t"]
        grid = voxel_grid(simulation.events[(t > start) & (t <= end)], (30, 41))
        image, state = step(network, normalise(grid) if normalised else grid, state)
        expected.append(toned(image, tone))
    found = list(images(recording, np.array(ends[1:]), name=case.name, path=path))
    assert np.array_equal(found, expected)
    assert found[0].dtype == np.float32
    assert len({image.tobytes() for image in found}) == len(found)
    some = list(images(recording, np.array([ends[2], ends[2] + 7_000, ends[5]]), name=case.name, path=path))
    assert np.array_equal(some[0], expected[1])
    assert np.array_equal(some[2], expected[4])


def test_chunks_do_not_matter(weights):
    simulation, path = moving_blocks(), weights("firenet")
    whole, times = simulation.recording(), simulation.truth_times()[:5]

    def pieces():
        return (simulation.events[i : i + 997] for i in range(0, len(simulation.events), 997))

    cut = Recording(dataclasses.replace(whole.source, events=pieces))
    found = [list(images(r, times, name="firenet", path=path)) for r in (whole, cut)]
    assert np.array_equal(found[0], found[1])


def test_threads_do_not_matter_and_stay_as_they_were(weights):
    simulation, path = moving_blocks(size=(64, 80)), weights("e2vid")
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            times = simulation.truth_times()[:3]
            found.append(list(images(simulation.recording(), times, name="e2vid", path=path)))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(found[0], found[1])


def test_a_read_between_frames_sees_the_events_until_then_and_at_least_a_third_of_a_window(weights):
    recording, path = (
        recording_of([1000, 1300, 1600, 1900], [990, 1150, 1399, 1401, 1550]),
        weights("firenet+"),
    )
    network = load_network("firenet+", path)
    events = recording.source.events

    def grid(start, end):
        found = np.concatenate(list(events()))
        return voxel_grid(found[(found["t"] > start) & (found["t"] <= end)], (3, 4))

    _, first = step(network, grid(700, 1000), None)
    _, second = step(network, grid(1000, 1300), first)
    expected = [step(network, grid(1000, 1399), first)[0], step(network, grid(1300, 1400), second)[0]]
    found = images(recording, np.array([1399, 1400]), name="firenet+", path=path)
    assert np.array_equal(list(found), [toned(image, "none") for image in expected])


def test_before_all_events_and_long_after_them(weights):
    recording, path = recording_of([1000, 1100], [1050]), weights("firenet")
    found = list(images(recording, np.array([0, 1000, 9000]), name="firenet", path=path))
    assert np.array_equal(found[0], found[1])
    assert np.isfinite(found).all()


def test_padding_is_cropped():
    """A network that gives back its input, at a size that is no multiple."""

    class Same(torch.nn.Module):
        multiple = 8

        def forward(self, grid, state):
            assert grid.shape[-2:] == (16, 24)
            return grid[:, :1], state

    grid = np.random.default_rng(0).normal(size=(5, 11, 18)).astype(np.float32)
    assert np.array_equal(step(Same(), grid, None)[0], grid[0])


def test_images_are_clipped_and_e2vid_s_are_stretched():
    image = np.linspace(-1, 3, 401, dtype=np.float32).reshape(1, -1)
    plain, robust = toned(image, "none"), toned(image, "robust")
    assert (plain.min(), plain.max()) == (0, 1)
    assert plain[0, 150] == pytest.approx(0.5)
    assert robust[0, [4, 200, 396]] == pytest.approx([0, 0.5, 1], abs=1e-6)
    assert not toned(np.full((2, 2), 0.7), "robust").any()


def test_scaled_images_are_nearest_to_the_frames(weights):
    """Least squares by NumPy over all frames at once."""
    simulation, path = moving_blocks(), weights("firenet")
    recording, network = simulation.recording(), load_network("firenet", path)
    middles = np.array([f.middle for f in recording.frames()])
    made = np.stack(list(network_images(recording, middles, "firenet", network, None))).astype(float)
    frames = np.stack([f.normalised() for f in recording.frames()])
    expected = np.polyfit(made.ravel(), frames.ravel(), 1)
    assert fit_scale(recording, "firenet", network, None, "linear") == pytest.approx(expected, rel=1e-6)
    scaled = list(images(recording, middles[:2], name="firenet", path=path, scaled=True))
    assert scaled == pytest.approx(np.maximum(np.polyval(expected, made[:2]), 0), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "file", "correlation"),
    [("firenet", "firenet.pth", 0.6), ("firenet+", "firenet_plus.pth", 0.5)],
)
def test_real_weights_show_the_scene(name, file, correlation, shared_data):
    """The desk of slider_depth after 0.6 s: measured 0.62 and 0.54 at frame 16."""
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    shot = next(islice(recording.frames(), 16, None))
    image = next(images(recording, np.array([shot.middle]), name=name, path=shared_data / "weights" / file))
    assert np.corrcoef(image.ravel(), shot.normalised().ravel())[0, 1] > correlation
    assert 0 <= image.min() < image.max() <= 1
