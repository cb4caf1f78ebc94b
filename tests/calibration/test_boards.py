"""A blinking board: corners in event images and frames, and the calibration of both cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux import Frame
from kalux.calibration.boards import (
    Board,
    Corners,
    View,
    calibrate_rig,
    contact_sheet,
    coverage,
    event_images,
    find_views,
    frame_picture,
)
from kalux.calibration.registration import Registration
from kalux.errors import InputError
from rigs import DISTANCE, SQUARE, board_recording, misplaced, small_rig

from builders import events

BOARD = Board(6, 5, SQUARE)
SIZES = {"events_size": (120, 160), "frames_size": (240, 320)}


@pytest.fixture(scope="module")
def views():
    seen = board_recording()
    images = event_images([seen.events], (120, 160), 300_000)
    return list(find_views(BOARD, images, seen.frames))


@pytest.fixture(scope="module")
def calibrated(views):
    return calibrate_rig(BOARD, views, **SIZES)


def test_both_cameras_see_the_board_in_nearly_every_pose(views):
    assert len(views) >= 8
    for view in views:
        assert len(view.events.ids) == len(view.frames.ids) == 30
        ahead = [c.pixels[5] - c.pixels[0] for c in (view.events, view.frames)]
        assert ahead[0] @ ahead[1] > 0


def test_the_rig_is_found(calibrated):
    """To half a pixel of the event camera at 20 m, with ten poses before 160 x 120 pixels."""
    rig, truth = calibrated.rig, small_rig()
    off = misplaced(Registration.of_rig(rig, DISTANCE), Registration.of_rig(truth, DISTANCE))
    assert off.mean() < 0.5
    assert rig.angle == pytest.approx(3, abs=0.4)
    assert rig.baseline == pytest.approx(0.04, abs=0.003)
    for one, other in ((rig.events, truth.events), (rig.frames, truth.frames)):
        assert one.matrix[0, 0] == pytest.approx(other.matrix[0, 0], rel=0.02)
    assert rig.about["rms_events_px"] < 0.25
    assert rig.about["rms_frames_px"] < 0.15
    assert 0.3 < rig.about["coverage_events"] <= 1


def test_a_view_that_does_not_agree_is_dropped(views):
    wrong = views[0]._replace(
        frames=Corners(views[0].frames.ids, views[0].frames.pixels * [1.0, 1.3] + [0.0, -20.0])
    )
    found = calibrate_rig(BOARD, [wrong, *views[1:]], **SIZES)
    assert found.dropped == 1
    assert len(found.views) == len(views) - 1


CHARUCO = Board(9, 6, 0.03, "5X5_100", 0.022)
ALL = range(54)


def projected(seed, events=ALL, frames=ALL):
    """A view of the ChArUco board by the small rig; of either camera some corners, 0.05 pixels off."""
    rng, rig = np.random.default_rng(seed), small_rig()
    turn, place = rng.uniform(-0.5, 0.5, 3), np.array([-0.13, -0.09, 0.55]) + rng.uniform(-0.03, 0.03, 3)
    world = CHARUCO.points() @ cv2.Rodrigues(turn)[0].T + place
    corners = []
    for lens, seen, points in (
        (rig.events, events, world),
        (rig.frames, frames, world @ rig.rotation.T + rig.translation),
    ):
        pixels = lens.pixels(points[:, :2] / points[:, 2:]) + rng.normal(0, 0.05, (54, 2))
        corners.append(Corners(np.array(seen), pixels[list(seen)]))
    blank = np.zeros((4, 4), np.uint8)
    return View(seed, seed + 1, *corners, blank, blank)


@pytest.mark.parametrize(
    ("events", "frames"),
    [
        (range(18), range(36, 54)),
        (range(20), range(18, 54)),
        (range(21), range(18, 54)),
        (range(9), ALL),
        (ALL, range(6)),
        (ALL, [*range(6), 20]),
        (ALL, range(0, 54, 10)),
    ],
    ids=["none", "two", "three", "a row", "a row of frames", "one beside a row", "a diagonal"],
)
def test_a_view_of_too_little_of_the_board_is_dropped(events, frames):
    good = [projected(seed) for seed in range(8)]
    found = calibrate_rig(CHARUCO, [projected(20, events, frames), *good], **SIZES)
    assert (len(found.views), found.dropped) == (8, 1)
    assert found.rig.baseline == pytest.approx(0.04, abs=0.003)


def test_a_view_of_a_part_of_the_board_is_used():
    good = [projected(seed) for seed in range(8)]
    found = calibrate_rig(CHARUCO, [projected(20, [0, 1, 9, 10, 11, 12], ALL), *good], **SIZES)
    assert (len(found.views), found.dropped) == (9, 0)


def test_a_board_that_moves_within_a_view_is_none(views):
    """The same pose for the events, but frames that shift from one to the next."""
    seen = board_recording()
    moved = [
        Frame(np.roll(f.image, 3 * (k % 5), axis=1), f.exposure_start, f.exposure_end)
        for k, f in enumerate(seen.frames)
    ]
    images = event_images([seen.events], (120, 160), 300_000)
    assert len(list(find_views(BOARD, images, moved))) < len(views) / 2


def test_too_few_views(views):
    with pytest.raises(InputError, match="in 3 places only; 6 are the least"):
        calibrate_rig(BOARD, views[:3], **SIZES)


def test_event_images_are_windows_of_counts():
    """Hot pixels are gone, windows without events passed over."""
    rows = [(t, x, y, 1) for t in range(0, 900, 100) for y in (2, 3, 4) for x in (2, 3, 4)]
    rows += [(t, 7, 7, 1) for t in range(0, 1000, 10)]
    rows += [(5_000 + t, 1, 1, 0) for t in range(5)]
    array = events(*sorted(rows))
    found = list(event_images([array[:50], array[50:]], (9, 9), 1000))
    assert [(start, end) for start, end, _ in found] == [(0, 1000), (5_000, 6_000)]
    first = found[0][2]
    assert first[3, 3] == 255
    assert first[7, 7] == 0
    assert list(event_images([], (9, 9), 1000)) == []


def test_a_charuco_board_is_found_even_in_part():
    board = Board(6, 4, 0.03, "4X4_50", 0.022)
    drawn = cv2.aruco.CharucoBoard(
        (7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    ).generateImage((560, 400))
    whole = board.find(np.pad(drawn, 30, constant_values=255))
    assert whole.ids.tolist() == list(range(24))
    np.testing.assert_allclose(np.diff(whole.pixels[:6], axis=0), [[80, 0]] * 5, atol=0.5)
    part = board.find(np.pad(drawn, 30, constant_values=255)[:, 160:])
    assert 6 <= len(part.ids) < 24
    np.testing.assert_allclose(part.pixels + np.array([160, 0]), whole.pixels[part.ids], atol=0.5)
    assert board.find(np.zeros((100, 100), np.uint8)) is None


def test_coverage_is_the_share_of_cells():
    assert coverage([np.array([[0.0, 0.0], [159.9, 119.9]])], (120, 160), (2, 4)) == 0.25


def test_the_sheet_shows_all_views(calibrated):
    sheet = contact_sheet(calibrated.views, width=800)
    assert sheet.dtype == np.uint8
    assert sheet.shape[2] == 3
    green = (sheet[:, :, 1].astype(int) - sheet[:, :, 0]) > 60
    assert green.sum() > 30 * len(calibrated.views)


def test_colour_frames_are_looked_at_in_grey():
    image = np.zeros((4, 5, 3), np.uint16)
    image[1, 2] = (100, 200, 300)
    assert frame_picture(Frame(image, 0, 1))[1, 2] == 255


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ((2, 5, 0.03), "too few"),
        ((6, 5, 0.0), "positive width"),
        ((6, 5, 0.03, "9X9_1", 0.02), "no ArUco dictionary"),
        ((6, 5, 0.03, "4X4_50", 0.04), "smaller than its squares"),
        ((6, 5, 0.03, "4X4_50"), "smaller than its squares"),
    ],
)
def test_what_is_no_board(options, told):
    with pytest.raises(InputError, match=told):
        Board(*options)
