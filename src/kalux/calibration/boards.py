"""A blinking board before two cameras: where its corners are in event images and in frames, and the rig that follows.

Where a screen switches a board on and off, its white squares make events at every switch and its black ones none: an
image of the number of events in some time shows the board. The number grows with the logarithm of the brightness; it is
exponentiated, or white squares would look too large (corners, symmetric under a turn by 180 degrees, would stay where
they are even so). The rig is held still before the board, moved, held still again: in every pause both cameras see the
board in one pose, and no common clock finer than a pause is needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.rig import Lens, Rig
from kalux.errors import InputError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.wording import how_many

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

LEAST_VIEWS: Final = 6
"""Below it focal length and pose cannot be told apart reliably; 15 to 30 are recommended."""

_STILL: Final = 0.7
"""Pixels that corners may move between two frames of a view. Event images of a moving board are smeared."""

_CONTRAST: Final = 10.0
"""Brightness of the board's white over that of its black, about, which is what the most events of a pixel stand for."""

_TRIES: Final = 4  # frames of a view in which the board is looked for: the brightest, where it is lit
_OUTLIER: Final = 3.0  # times the median error of the views: not the board, or it moved
_SHARP: Final = 1.0  # pixel: a view with a larger error is one of these, if there are others


@dataclass(frozen=True)
class Board:
    """A checkerboard, or a ChArUco board.

    Attributes
    ----------
    columns, rows
        Of inner corners.
    square
        Side of a square, m.
    dictionary
        Name of the ArUco dictionary of a ChArUco board, as in OpenCV without its prefix: ``"5X5_100"``. None: a
        checkerboard.
    marker
        Side of a marker, m.

    Raises
    ------
    InputError
        If it cannot be such a board.
    """

    columns: int
    rows: int
    square: float
    dictionary: str | None = None
    marker: float | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise InputError(f"board: {self.columns}x{self.rows} inner corners are too few; 3x3 at least")
        if not self.square > 0:
            raise InputError(f"board: the squares are {self.square} m wide; a positive width is needed")
        if self.dictionary is not None:
            if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
                raise InputError(
                    f"board: OpenCV has no ArUco dictionary DICT_{self.dictionary}; e.g. 5X5_100"
                )
            if self.marker is None or not 0 < self.marker < self.square:
                raise InputError("board: a ChArUco board needs markers smaller than its squares")

    def points(self) -> Array:
        """(columns * rows, 3) m: the corners on the board, row by row."""
        y, x = np.mgrid[: self.rows, : self.columns].astype(np.float64)
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * self.square

    def find(self, picture: Picture) -> Corners | None:
        """The board's corners in a picture, None where it is not seen (a checkerboard: as a whole)."""
        return _find_squares(self, picture) if self.dictionary is None else _find_charuco(self, picture)


class Corners(NamedTuple):
    """Corners found: their numbers (N,), ascending, and pixels (N, 2)."""

    ids: NDArray[np.int64]
    pixels: Array


class View(NamedTuple):
    """The board in one pose, seen by both cameras.

    Attributes
    ----------
    start, end
        us: the events that were counted.
    events, frames
        Its corners in the event image and in the frame.
    event_image, frame_image
        The pictures, uint8.
    """

    start: int
    end: int
    events: Corners
    frames: Corners
    event_image: Picture
    frame_image: Picture


class RigCalibration(NamedTuple):
    """A calibrated rig and what it rests on.

    Attributes
    ----------
    rig
        With the numbers below in ``about``.
    views
        Those used.
    dropped
        How many more were found, but did not agree, or show too little of the board.
    """

    rig: Rig
    views: tuple[View, ...]
    dropped: int


def _find_squares(board: Board, picture: Picture) -> Corners | None:
    # Small squares are found better in a larger picture, and some boards only by a longer search.
    scale = 2 if picture.shape[1] < 500 else 1
    large = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    for flags in (cv2.CALIB_CB_ACCURACY, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE):
        found, corners = cv2.findChessboardCornersSB(large, (board.columns, board.rows), flags=flags)
        if found:  # half a pixel lies between the corners of both pictures and the centres of their pixels
            pixels = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
            return Corners(np.arange(len(pixels)), pixels)
    return None


def _find_charuco(board: Board, picture: Picture) -> Corners | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    charuco = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square, board.marker or 0.0, dictionary
    )
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(picture)
    if ids is None or len(ids) < 6:
        return None
    order = np.argsort(ids.ravel())
    return Corners(ids.ravel()[order].astype(np.int64), np.asarray(corners, np.float64).reshape(-1, 2)[order])


# --- views ------------------------------------------------------------------------------------------------


def event_images(
    chunks: Iterable[EventArray], sensor_size: tuple[int, int], window: int
) -> Iterator[tuple[int, int, Picture]]:
    """Pictures of the number of events per pixel in one window (us) after the other, with their start and end.

    Hot pixels are taken off by a median of 3 x 3; white is the 99th percentile, and the picture linear.
    """
    counts = np.zeros(sensor_size, np.float32)
    start: int | None = None
    for chunk in chunks:
        first = 0
        while first < len(chunk):
            if start is None:
                start = int(chunk["t"][0])
            last = int(chunk["t"].searchsorted(start + window))
            np.add.at(counts, (chunk["y"][first:last], chunk["x"][first:last]), 1.0)
            first = last
            if first < len(chunk):
                yield start, start + window, _as_picture(counts)
                counts[:] = 0
                # Windows without events are passed over.
                start += (int(chunk["t"][first]) - start) // window * window
    if start is not None:
        yield start, start + window, _as_picture(counts)


def _as_picture(counts: NDArray[np.float32]) -> Picture:
    quiet = cv2.medianBlur(counts, 3)
    share = np.minimum(quiet / max(float(np.percentile(quiet, 99)), 1.0), 1.0)
    return np.asarray((_CONTRAST**share - 1) * (255 / (_CONTRAST - 1)), np.uint8)


def frame_picture(frame: Frame) -> Picture:
    """A frame in 8 bits, the mean of its channels, with white at its brightest."""
    image = np.asarray(frame.image, np.float32)
    grey = image if image.ndim == 2 else image.mean(axis=2)
    return np.asarray(np.clip(grey * (255 / max(float(grey.max()), 1e-9)), 0, 255), np.uint8)


def find_views(
    board: Board,
    images: Iterable[tuple[int, int, Picture]],
    frames: Iterable[Frame],
) -> Iterator[View]:
    """Every time in which both cameras see the board, and it stands still.

    Parameters
    ----------
    board
        What is looked for.
    images
        From `event_images`.
    frames
        In time order; clocks may differ by less than a quarter of a window.
    """
    remaining = iter(frames)
    held: list[Frame] = []
    following = next(remaining, None)
    for start, end, picture in images:
        margin = (end - start) // 4
        held = [frame for frame in held if frame.middle >= start + margin]
        while following is not None and following.middle <= end - margin:
            if following.middle >= start + margin:
                held.append(following)
            following = next(remaining, None)
        if not held:
            continue
        seen = board.find(picture)
        if seen is None:
            continue
        found = _seen_in_frames(board, held)
        if found is not None:
            corners, frame = found
            yield View(start, end, *_same_order(board, seen, corners), picture, frame_picture(frame))


def _seen_in_frames(board: Board, frames: list[Frame]) -> tuple[Corners, Frame] | None:
    """The board in the two brightest frames that show it, which must agree: the mean, and one of the frames."""
    brightest = sorted(frames, key=lambda frame: -float(frame.image.mean()))[:_TRIES]
    first: tuple[Corners, Frame] | None = None
    for frame in brightest:
        corners = board.find(frame_picture(frame))
        if corners is None:
            continue
        if first is None:
            first = corners, frame
            continue
        one, two = _common(first[0], corners)
        if len(one) < 6 or float(np.abs(one - two).max()) > _STILL:
            return None
        shared = np.intersect1d(first[0].ids, corners.ids)
        return Corners(shared, (one + two) / 2), first[1]
    return None


def _common(one: Corners, other: Corners) -> tuple[Array, Array]:
    """Pixels of the corners that both have."""
    _, i, j = np.intersect1d(one.ids, other.ids, return_indices=True)
    return one.pixels[i], other.pixels[j]


def _same_order(board: Board, events: Corners, frames: Corners) -> tuple[Corners, Corners]:
    """A checkerboard may be found from either end: the order in which its first row points the same way in both."""
    if board.dictionary is not None:
        return events, frames
    ahead = [c.pixels[board.columns - 1] - c.pixels[0] for c in (events, frames)]
    if float(ahead[0] @ ahead[1]) < 0:
        events = Corners(events.ids, events.pixels[::-1])
    return events, frames


# --- calibration ------------------------------------------------------------------------------------------


def calibrate_rig(
    board: Board,
    views: Iterable[View],
    *,
    events_size: tuple[int, int],
    frames_size: tuple[int, int],
    most_views: int = 60,
) -> RigCalibration:
    """Intrinsics of both cameras (k1, k2, p1, p2; k3 = 0, which boards seldom determine) and their pose.

    Each camera by itself first (Zhang 2000), then all together, by which the frames, whose corners are sharper, make
    the event camera's lens better known. Views that fix no pose of the board are dropped before; those with more than
    three times the median error are dropped then, and all is done again.

    Parameters
    ----------
    board
        That of the views.
    views
        From `find_views`; if there are more than ``most_views``, evenly chosen ones are used.
    events_size, frames_size
        (height, width) of both cameras.

    Raises
    ------
    InputError
        If there are fewer than 6 views.
    """
    given = list(views)
    found = [view for view in given if _fixes_poses(board, view)]
    useless = len(given) - len(found)
    if len(found) > most_views:
        found = [found[i] for i in np.linspace(0, len(found) - 1, most_views).round().astype(int)]
    _require(found)
    sizes = (events_size, frames_size)
    kept = found
    for _ in range(2):
        lenses, errors = zip(*(_lens(board, kept, sizes[c], c) for c in (0, 1)), strict=True)
        worst = np.max(errors, axis=0)
        good = worst <= max(_OUTLIER * float(np.median(worst)), _SHARP)
        if good.all():
            break
        kept = [view for view, ok in zip(kept, good, strict=True) if ok]
        _require(kept)
    joint, rotation, translation, rms = _joint(board, kept, lenses)
    about = {
        "views": len(kept),
        "rms_events_px": _rms(errors[0]),
        "rms_frames_px": _rms(errors[1]),
        "rms_rig_px": round(rms, 4),
        "coverage_events": coverage([v.events.pixels for v in kept], events_size),
        "coverage_frames": coverage([v.frames.pixels for v in kept], frames_size),
        "board": f"{board.columns}x{board.rows} inner corners, squares of {1e3 * board.square:g} mm",
    }
    return RigCalibration(
        Rig(joint[0], joint[1], rotation, translation, about), tuple(kept), useless + len(found) - len(kept)
    )


def _fixes_poses(board: Board, view: View) -> bool:
    """Whether either camera's corners fix its pose, and those that both see the pose between them."""
    seen = view.events.ids, view.frames.ids
    return all(_fix_a_homography(board.points()[ids]) for ids in (*seen, np.intersect1d(*seen)))


def _fix_a_homography(points: Array) -> bool:
    """Whether four of the points of a plane lie so that no three are on a line: where no line holds all but one."""
    if len(points) < 4:
        return False
    others = (np.delete(points, k, axis=0) for k in range(len(points)))
    return all(np.linalg.matrix_rank(some - some[0]) == 2 for some in others)


def _require(views: list[View]) -> None:
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"both cameras saw the whole board, still, in {how_many(len(views), 'place')} only; "
            f"{LEAST_VIEWS} are the least, 15 to 30 are good: hold the rig still for a second in each, tilt the board, "
            "fill both images"
        )


def _rms(errors: Array) -> float:
    return round(float(np.sqrt(np.mean(np.square(errors)))), 4)


def _single(points: Array) -> NDArray[np.float32]:
    return np.ascontiguousarray(points, np.float32)


def _lens(board: Board, views: list[View], size: tuple[int, int], camera: int) -> tuple[Lens, Array]:
    """A camera by itself, and the error of every view, pixels."""
    world = board.points()
    seen = [(view.events, view.frames)[camera] for view in views]
    _, matrix, distortion, *_, errors = cv2.calibrateCameraExtended(
        [_single(world[c.ids]) for c in seen],
        [_single(c.pixels) for c in seen],
        size[::-1],
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )
    lens = Lens(size, np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel()[:5])
    return lens, np.asarray(errors, np.float64).ravel()


def _joint(
    board: Board, views: list[View], lenses: tuple[Lens, ...]
) -> tuple[tuple[Lens, Lens], Array, Array, float]:
    """Both lenses, rotation, translation and rms error in pixels, from first guesses of the lenses."""
    world = board.points()
    shared = [np.intersect1d(view.events.ids, view.frames.ids) for view in views]
    pairs = [_common(view.events, view.frames) for view in views]
    found = cv2.stereoCalibrate(
        [_single(world[ids]) for ids in shared],
        [_single(events) for events, _ in pairs],
        [_single(frames) for _, frames in pairs],
        lenses[0].matrix.copy(),
        lenses[0].distortion.copy(),
        lenses[1].matrix.copy(),
        lenses[1].distortion.copy(),
        lenses[0].sensor_size[::-1],
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-9),
    )
    rms, *intrinsics = found[:5]
    rotation, translation = found[5:7]
    both = [
        Lens(lens.sensor_size, np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel()[:5])
        for lens, matrix, distortion in zip(lenses, intrinsics[::2], intrinsics[1::2], strict=True)
    ]
    pose = np.asarray(rotation, np.float64), np.asarray(translation, np.float64).ravel()
    return (both[0], both[1]), *pose, float(rms)


def coverage(corners: Iterable[Array], size: tuple[int, int], cells: tuple[int, int] = (6, 8)) -> float:
    """Share of ``cells`` (rows, columns) of an image that hold a corner of any view, 0 to 1."""
    seen = np.zeros(cells, bool)
    for pixels in corners:
        place = (pixels[:, ::-1] / np.array(size) * np.array(cells)).astype(int)
        seen[tuple(np.clip(place, 0, np.array(cells) - 1).T)] = True
    return round(float(seen.mean()), 3)


def contact_sheet(views: Iterable[View], *, most: int = 24, width: int = 1920) -> NDArray[Any]:
    """Event images beside frames, with the corners found in them: (H, W, 3) uint8, BGR."""
    chosen = list(views)
    if len(chosen) > most:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, most).round().astype(int)]
    columns = min(4, len(chosen))
    cell = width // (2 * columns)
    tiles = [
        np.hstack([_marked(v.event_image, v.events, cell), _marked(v.frame_image, v.frames, cell)])
        for v in chosen
    ]
    height = max(tile.shape[0] for tile in tiles)
    tiles = [np.pad(tile, ((0, height - tile.shape[0] + 4), (0, 4), (0, 0))) for tile in tiles]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def _marked(picture: Picture, corners: Corners, width: int) -> NDArray[Any]:
    scale = width / picture.shape[1]
    size = (width, round(picture.shape[0] * scale))
    out = cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    points = np.rint(((corners.pixels + 0.5) * scale - 0.5) * 16).astype(int)
    for k, (x, y) in enumerate(points):
        colour = (0, 80, 255) if k == 0 else (80, 255, 80)
        cv2.circle(out, (int(x), int(y)), 3 * 16, colour, 1, cv2.LINE_AA, 4)
    return np.asarray(out)
