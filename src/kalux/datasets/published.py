"""Published sets of recordings with events and frames, as they are downloaded: what they are, and a loader.

Nothing is downloaded: licences are accepted on the sets' own pages. Where a page's licence could not be read when this
was written, it says "see the page".
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from kalux.errors import InputError, KaluxError, did_you_mean
from kalux.frames import Stamp
from kalux.recording import Recording
from kalux.recording import open as open_recording

_SEE: Final = "see the page"


@dataclass(frozen=True, kw_only=True)
class PublishedSet:
    """What is known of a published set.

    Attributes
    ----------
    name, title
        As in commands, and in words.
    source
        The paper.
    page
        Where it is described and downloaded.
    licence
        As stated there.
    layout
        What is expected in its folder, in words.
    reads
        What kalux reads of it, and what it does not.
    files
        Patterns of the names of files that are a sequence each.
    marks
        Files, relative to a folder, all of which make that folder a sequence.
    wanted
        Files, relative to such a folder, that belong to it.
    opens
        What of such a folder is opened; empty: the folder.
    beside
        Patterns of the names of files that belong to the set and are no sequences.
    sequences
        Names of all sequences, where they are known.
    """

    name: str
    title: str
    source: str
    page: str
    licence: str
    layout: str
    reads: str
    files: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()
    opens: str = ""
    beside: tuple[str, ...] = ("*.txt", "*.md", "*.yaml", "*.yml", "*.pdf", "*.json")
    sequences: tuple[str, ...] = field(default=())


_DAVIS: Final = (
    "boxes_6dof boxes_rotation boxes_translation calibration dynamic_6dof dynamic_rotation dynamic_translation "
    "hdr_boxes hdr_poster office_spiral office_zigzag outdoors_running outdoors_walking poster_6dof poster_rotation "
    "poster_translation shapes_6dof shapes_rotation shapes_translation slider_close slider_depth slider_far "
    "slider_hdr_close slider_hdr_far urban simulation_3planes simulation_3walls"
)
_HQF: Final = (
    "bike_bay_hdr boxes desk desk_fast desk_hand_only desk_slow engineering_posters high_texture_plants "
    "poster_pillar_1 poster_pillar_2 reflective_materials slow_and_fast_desk slow_hand still_life"
)

SETS: Final[tuple[PublishedSet, ...]] = (
    PublishedSet(
        name="hdr",
        title="HDR Hybrid Event-Frame Dataset",
        source="Wang, Ng, Scheerlinck, Mahony, ICCV 2021",
        page="https://github.com/ziweiWWANG/AKF",
        licence="academic use only (the page's notes; the code there is GPL-3.0)",
        layout="a .mat (v7.3) per sequence: events, image, time_image, exposure, HDR_mat, e.g. tree3.mat",
        reads="events, grey frames, exposures, f_Q, ct, and HDR_mat as ground truth, masked where not registered",
        files=("*.mat",),
    ),
    PublishedSet(
        name="ahdr",
        title="AHDR Hybrid Event-Frame Dataset",
        source="Wang, Ng, Scheerlinck, Mahony, ICCV 2021",
        page="https://github.com/ziweiWWANG/AKF",
        licence="academic use only (the page's notes; the code there is GPL-3.0)",
        layout="a .mat per sequence (mountain, lake) with img_color, and s_curve_30.mat to s_curve_115.mat",
        reads="a sequence once it has the grey `image` that the page's notes make of img_color",
        files=("*.mat",),
        beside=("s_curve*.mat", "*.md", "*.txt"),
    ),
    PublishedSet(
        name="acd",
        title="Datasets of the complementary filter (ACD)",
        source="Scheerlinck, Barnes, Mahony, ACCV 2018",
        page="https://github.com/cedric-scheerlinck/dvs_image_reconstruction",
        licence=f"{_SEE} (the code there is MIT)",
        layout="a ROS bag per sequence; the AKF authors' page has parts of them as .mat",
        reads="events and grey frames (needs kalux[ros]); .mat parts with exposures",
        files=("*.bag", "*.mat"),
    ),
    PublishedSet(
        name="ced",
        title="CED: Color Event Camera Dataset",
        source="Scheerlinck et al., CVPRW 2019",
        page="https://rpg.ifi.uzh.ch/CED.html",
        licence=_SEE,
        layout="zips (CED_simple.zip ...) of ROS bags: unpack them; events, image_raw (a mosaic) and image_color",
        reads="events (needs kalux[ros]); frames as far as kalux reads colour: docs/formats.md",
        files=("*.bag",),
    ),
    PublishedSet(
        name="ijrr",
        title="The Event-Camera Dataset and Simulator (DAVIS 240C; also called ECD)",
        source="Mueggler, Rebecq, Gallego, Delbruck, Scaramuzza, IJRR 2017",
        page="https://rpg.ifi.uzh.ch/davis_data.html",
        licence=_SEE,
        layout="per sequence a folder or zip of text (events.txt, images.txt, images/, calib.txt ...), or a ROS bag",
        reads="events and frames; exposure times are not in it: give --exposure and --stamp",
        files=("*.zip", "*.bag"),
        marks=("events.txt",),
        wanted=("images.txt", "images", "calib.txt"),
        sequences=tuple(_DAVIS.split()),
    ),
    PublishedSet(
        name="hqf",
        title="High Quality Frames (HQF)",
        source="Stoffregen et al., ECCV 2020",
        page="https://timostoff.github.io/20ecnn",
        licence=_SEE,
        layout="a ROS bag per sequence, or the HDF5 made of it by event_cnn_minimal",
        reads="events and frames; exposure times are not in it: give --exposure and --stamp",
        files=("*.bag", "*.h5", "*.hdf5"),
        sequences=tuple(_HQF.split()),
    ),
    PublishedSet(
        name="dsec",
        title="DSEC: A Stereo Event Camera Dataset for Driving Scenarios",
        source="Gehrig, Aarents, Gehrig, Scaramuzza, RA-L 2021",
        page="https://dsec.ifi.uzh.ch/",
        licence=f"{_SEE} (its code is MIT)",
        layout="per sequence a folder: events/left/events.h5, rectify_map.h5, images/left/rectified/*.png ...",
        reads="events; the frames are in colour and of another camera: warp and join them (docs/formats.md)",
        marks=("events/left/events.h5",),
        wanted=("events/left/rectify_map.h5", "images/left/rectified", "images/left/exposure_timestamps.txt"),
        opens="events/left/events.h5",
    ),
    PublishedSet(
        name="mvsec",
        title="MVSEC: The Multi Vehicle Stereo Event Camera Dataset",
        source="Zhu et al., RA-L 2018",
        page="https://daniilidis-group.github.io/mvsec/",
        licence=_SEE,
        layout="per sequence ..._data.hdf5 or ..._data.bag, and ..._gt with poses and depth",
        reads="events and frames of the left DAVIS 346; exposure times are not in it: give --exposure and --stamp",
        files=("*_data.hdf5", "*_data.bag"),
        beside=("*_gt.hdf5", "*_gt.bag", "*.txt", "*.md", "*.yaml", "*.zip"),
    ),
    PublishedSet(
        name="hs-ergb",
        title="HS-ERGB: High Speed Event and RGB dataset (Time Lens)",
        source="Tulyakov, Gehrig et al., CVPR 2021",
        page="https://github.com/uzh-rpg/rpg_timelens",
        licence="evaluation only (TimeLens Evaluation License, on the page)",
        layout="close/test and far/test with a folder per sequence: events_aligned/*.npz, images_corrected/*.png",
        reads="events and frames in colour; exposure times are not in it: give --exposure and --stamp",
        marks=("images_corrected/timestamp.txt",),
        wanted=("events_aligned",),
    ),
    PublishedSet(
        name="bs-ergb",
        title="BS-ERGB: Beam Splitter Event and RGB dataset (Time Lens++)",
        source="Tulyakov, Bochicchio et al., CVPR 2022",
        page="https://github.com/uzh-rpg/timelens-pp",
        licence="evaluation only (Time Lens++ Evaluation License, on the page)",
        layout="1_TEST, 2_VALIDATION, 3_TRAINING with a folder per sequence: events/*.npz, images/*.png",
        reads="events and frames in colour; exposure times are not in it: give --exposure and --stamp",
        marks=("images/timestamp.txt",),
        wanted=("events",),
    ),
)
"""All sets that are known, in the order in which they are listed."""


def published_set(name: str) -> PublishedSet:
    """The set of a name.

    Raises
    ------
    InputError
        If there is none.
    """
    for published in SETS:
        if published.name == name.lower():
            return published
    known = [published.name for published in SETS]
    raise InputError(f"there is no set {name!r}{did_you_mean(name, known)}; known are {', '.join(known)}")


@dataclass(frozen=True)
class Contents:
    """What a folder holds of a set.

    Attributes
    ----------
    found
        (name, path) of every sequence, sorted.
    missing
        Sequences of the set that are not there, where all are known.
    incomplete
        Name of a sequence and the files that it lacks.
    unknown
        Files that belong to no sequence, relative to the folder.
    """

    found: tuple[tuple[str, Path], ...]
    missing: tuple[str, ...]
    incomplete: dict[str, tuple[str, ...]]
    unknown: tuple[str, ...]


def contents(name: str, folder: str | Path) -> Contents:
    """Look for the sequences of a set in a folder and the folders in it, without opening them.

    Raises
    ------
    InputError
        If there is no such set or folder.
    """
    published, folder = published_set(name), Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that {published.name} was downloaded to")
    folders = [path for path in (folder, *sorted(folder.rglob("*"))) if _is_sequence(published, path)]
    paths = [(_name(path, folder), path / published.opens) for path in folders]
    unknown = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or any(path.is_relative_to(inside) for inside in folders):
            continue
        beside = any(fnmatch.fnmatch(path.name.lower(), pattern) for pattern in published.beside)
        named = not published.sequences or path.stem.lower() in published.sequences
        if not beside and named and any(fnmatch.fnmatch(path.name.lower(), p) for p in published.files):
            paths.append((_name(path, folder), path))
        elif not beside:
            unknown.append(str(path.relative_to(folder)))
    found = tuple(sorted(paths))
    stems = {Path(name).name.lower() for name, _ in found}
    missing = tuple(s for s in published.sequences if s not in stems)
    lacking = {_name(p, folder): tuple(w for w in published.wanted if not (p / w).exists()) for p in folders}
    return Contents(found, missing, {n: files for n, files in lacking.items() if files}, tuple(unknown))


def _is_sequence(published: PublishedSet, path: Path) -> bool:
    return (
        bool(published.marks) and path.is_dir() and all((path / mark).is_file() for mark in published.marks)
    )


def _name(path: Path, folder: Path) -> str:
    """Relative to the folder, without a suffix; the folder's own name for itself."""
    relative = path.relative_to(folder)
    if not relative.parts:
        return path.resolve().name
    return str(relative if path.is_dir() else relative.with_suffix(""))


def sequences(
    name: str, folder: str | Path, *, exposure: int | None = None, stamp: Stamp = "start"
) -> Iterator[tuple[str, Recording]]:
    """Open every sequence of a set in turn.

    Parameters
    ----------
    name
        Of the set, as `kalux datasets` lists it.
    folder
        Where it was downloaded to.
    exposure, stamp
        As for `kalux.open`.

    Raises
    ------
    InputError
        If there is no such set or folder, no sequence in it, or one cannot be opened.
    """
    found = contents(name, folder).found
    if not found:
        published = published_set(name)
        raise InputError(
            f"{folder}: no sequence of {published.name} is in it; expected is {published.layout}"
        )
    for sequence, path in found:
        yield sequence, open_recording(path, exposure=exposure, stamp=stamp)


@dataclass(frozen=True)
class SequenceCheck:
    """What was found of a sequence.

    Attributes
    ----------
    name, path
        As in `Contents`.
    events, frames
        Their numbers; 0 where it could not be opened.
    sensor_size
        (height, width); None where it could not be opened.
    truth
        Number of reference images.
    lacks
        Files that are missing, and what `Source.missing` says.
    error
        Why it cannot be opened or read; empty if it can.
    """

    name: str
    path: Path
    events: int = 0
    frames: int = 0
    sensor_size: tuple[int, int] | None = None
    truth: int = 0
    lacks: tuple[str, ...] = ()
    error: str = ""


def check_sequence(
    name: str, path: Path, lacking: tuple[str, ...] = (), *, whole: bool = False
) -> SequenceCheck:
    """Open a sequence, and read its first events and frame, or all of it.

    Errors of the sequence are returned, not raised.

    Parameters
    ----------
    name, path
        As in `Contents.found`.
    lacking
        Files that are known to be missing.
    whole
        Whether every event, frame and reference image is read and checked.
    """
    try:
        recording = open_recording(path)
        events, frames = recording.events(), recording.stamped_frames()
        for stream in (events, frames):
            for _ in stream:
                if not whole:
                    break
        truth = recording.ground_truth() if whole or recording.source.ground_truth is not None else None
        return SequenceCheck(
            name,
            path,
            len(events),
            len(frames),
            recording.sensor_size,
            0 if truth is None else len(truth.times),
            (*(f"no {file}" for file in lacking), *recording.source.missing),
        )
    except KaluxError as error:
        return SequenceCheck(name, path, lacks=tuple(f"no {file}" for file in lacking), error=str(error))
