"""The sequences of a benchmark: recordings, folders of recordings, and TOML files that list them."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import kalux
from kalux.calibration.values import Calibration, load_calibration
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr, check_originals
from kalux.errors import FormatError, InputError
from kalux.evaluation.specs import relocated
from kalux.evaluation.truth import TRUTH_SUFFIX, truth_file, with_name_of_its_own
from kalux.frames import Stamp
from kalux.models.camera import named_responses
from kalux.readers import READERS, numpy_files
from kalux.recording import Recording, check_stated
from kalux.settings import AUTO, CameraSettings, read_toml

EVERY: Final = 2
"""Every second frame is held out where there is no ground truth."""


@dataclass(frozen=True, kw_only=True)
class ArtificialHdr:
    """An artificial camera that the frames of a recording are seen by, as `kalux ahdr` makes it.

    The artificial recording is never stored: its frames are made as they are read, wherever a job runs.

    Attributes
    ----------
    low, high
        Levels of the real camera, of 255, up to which it sees black and from which it sees white.
    black
        Level of the real camera, of 255, that is black.
    saturation
        Level of the real camera, of 255, from which it is saturated and no truth.

    Raises
    ------
    InputError
        If the levels are not in order, or not possible.
    """

    low: float
    high: float
    black: float = 0.0
    saturation: float = 255 * CameraSettings.usual_saturation

    def __post_init__(self) -> None:
        check_originals(self.camera, self.black / 255, self.saturation / 255)

    @property
    def camera(self) -> ArtificialCamera:
        """The artificial camera."""
        return ArtificialCamera(self.low / 255, self.high / 255)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is said of a sequence beside its path.

    Attributes
    ----------
    exposure
        us, of recordings that store none.
    stamp
        What a frame's time marks, with ``exposure``.
    white
        The value of a saturated pixel, where the recording does not state it, as of `kalux.open`.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    truth
        File of reference images. Default: those beside the recording, or its own.
    hold_out_frames
        Every n-th frame is held out, even where there is truth; at least 2.
    ahdr
        The recording is made artificial HDR; the original frames are the truth, with ``hold_out_frames`` those that
        are held out.
    calibration
        Files of `kalux calibrate`, for all filters. What they say of the camera does not hold for an artificial one.

    Raises
    ------
    InputError
        If a value is not possible.
    """

    exposure: int | None = None
    stamp: Stamp = "start"
    white: float | None = None
    response: str = AUTO
    truth: Path | None = None
    hold_out_frames: int | None = None
    ahdr: ArtificialHdr | None = None
    calibration: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        check_stated(self.exposure, self.stamp, self.white)
        named_responses(self.response)
        if self.hold_out_frames is not None and self.hold_out_frames < 2:
            raise InputError(
                f"held-out frames: every is {self.hold_out_frames}; at least 2 is needed, or leave it out"
            )


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """One column of the benchmark.

    Attributes
    ----------
    name
        Names its files: letters, digits, dots, dashes, underscores.
    path
        Of the recording; absolute, it may end in ``?choice``.
    options
        See `Options`.
    title
        For the report.
    group
        Sequences of a group have a common mean. Default: by what they are compared with.
    """

    name: str
    path: Path
    options: Options
    title: str
    group: str | None = None

    def open(self) -> Recording:
        """Open the recording; the exposure is used where it stores none.

        Raises
        ------
        KaluxError
            As of `kalux.open`.
        """
        options = self.options
        recording = kalux.open(self.path, white=options.white)
        if not recording.exposure_known and options.exposure is not None:
            recording = kalux.open(
                self.path, exposure=options.exposure, stamp=options.stamp, white=options.white
            )
        if options.ahdr is None:
            return recording
        return artificial_hdr(
            recording,
            options.ahdr.camera,
            response=self._camera_response(),
            black=options.ahdr.black / 255,
            saturation=options.ahdr.saturation / 255,
            every=options.hold_out_frames,
        )

    @property
    def response(self) -> str:
        """Of the camera whose frames methods see, as in `kalux.settings.CameraSettings`."""
        # An artificial recording states that of its camera.
        return AUTO if self.options.ahdr is not None else self._camera_response()

    @property
    def black_level(self) -> float | None:
        """That of a calibration, a share of white; None: as found."""
        known = None if self.calibration is None else self.calibration.settings.get("camera", {})
        return None if known is None else known.get("black_level")

    @property
    def calibration(self) -> Calibration | None:
        """What was measured of the sensor; None: nothing.

        Raises
        ------
        KaluxError
            As of `kalux.calibration.values.load_calibration`.
        """
        if not self.options.calibration:
            return None
        known = load_calibration(*self.options.calibration)
        if self.options.ahdr is None:
            return known
        kept = {group: values for group, values in known.settings.items() if group != "camera"}
        return dataclasses.replace(known, settings=kept)

    def _camera_response(self) -> str:
        if self.options.response != AUTO or not self.options.calibration:
            return self.options.response
        known = load_calibration(*self.options.calibration).settings.get("camera", {})
        return str(known.get("response", AUTO))

    def truth_file(self) -> Path | None:
        """The file of reference images that is named, or lies beside the recording; None: there is none."""
        if self.options.hold_out_frames is not None or self.options.ahdr is not None:
            return None
        return truth_file(self.path, self.options.truth)

    def files(self) -> list[Path]:
        """All files that the scores depend on, in order."""
        path = Path(str(self.path).partition("?")[0]) if not self.path.exists() else self.path
        truth = self.truth_file()
        maps = (file.with_suffix(".npz") for file in self.options.calibration)
        return [
            *files_under(path),
            *([] if truth is None else [truth]),
            *self.options.calibration,
            *(file for file in maps if file.is_file()),
        ]


def files_under(path: Path) -> list[Path]:
    """A file, or all files of a folder, in order."""
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


@dataclass(frozen=True)
class Benchmark:
    """What is to be compared.

    Attributes
    ----------
    title
        Of the report.
    sequences
        In the order of the columns; names differ.
    methods
        Names as `kalux.evaluation.specs.chosen_methods` takes them; None: all that are compared by default.
    folder
        That files and folders in the names of methods are relative to.
    """

    title: str
    sequences: tuple[Sequence, ...]
    methods: tuple[str, ...] | None = None
    folder: Path = Path()


def gather(
    sets: Iterable[str | Path], options: Options | None = None, *, methods_of_files: bool = True
) -> Benchmark:
    """The sequences of recordings, of folders of recordings and of TOML files.

    Parameters
    ----------
    sets
        Paths. What a TOML file says, holds for its sequences.
    options
        For all sequences that are not from a TOML file.
    methods_of_files
        Whether the methods that TOML files list are wanted, for all sequences; else they may differ.

    Raises
    ------
    InputError
        If something is missing, no recording, or a TOML file is wrong; if two TOML files list other methods.
    """
    common = options or Options()
    found: list[Sequence] = []
    listings: list[Benchmark] = []
    for given in sets:
        path = with_name_of_its_own(Path(given).absolute())
        if path.suffix.lower() == ".toml":
            listed = load(path)
            listings.append(listed)
            found += listed.sequences
        else:
            found += [_sequence(path, common) for path in _recordings(path)]
    if not found:
        raise InputError("benchmark: no sequence is given; give recordings, folders of them, or a TOML file")
    titles = dict.fromkeys(listed.title for listed in listings)
    chosen = _common_methods(listings) if methods_of_files else None
    return Benchmark(
        ", ".join(titles) or "Benchmark",
        _unique(found),
        None if chosen is None else chosen.methods,
        Path() if chosen is None else chosen.folder,
    )


def _common_methods(listings: list[Benchmark]) -> Benchmark | None:
    """One of the TOML files that list methods, which all list the same; None: none does."""
    listing = [listed for listed in listings if listed.methods is not None]
    for other in listing[1:]:
        if _absolute_methods(other) != _absolute_methods(listing[0]):
            raise InputError(
                f"benchmark: {listing[0].title!r} lists the methods {_joined(listing[0])}, {other.title!r} lists "
                f"{_joined(other)}; list the same, or give --methods"
            )
    return listing[0] if listing else None


def _absolute_methods(listed: Benchmark) -> list[str]:
    """The methods of a TOML file, as they are the same for files in other folders."""
    return [relocated(name, listed.folder) for name in listed.methods or ()]


def _joined(listed: Benchmark) -> str:
    return ", ".join(listed.methods or ())


def load(path: Path) -> Benchmark:
    """Read a TOML file: ``title``, ``methods``, and tables ``[[sequence]]``, see docs/benchmark.md.

    Raises
    ------
    InputError
        If it cannot be read, is no TOML, or says something unknown; names the sequence.
    """
    values = read_toml(path)
    _check_keys(f"{path}", values, _FILE_KEYS)
    entries = values.get("sequence", [])
    if not entries:
        raise InputError(f"{path}: lists no sequence; add a table [[sequence]] with a path")
    sequences = [_listed(f"{path}: sequence {i}", path.parent, entry) for i, entry in enumerate(entries, 1)]
    methods = values.get("methods")
    if methods is not None and not (methods and all(isinstance(name, str) for name in methods)):
        raise InputError(f"{path}: methods is {methods!r}; a list of names is needed")
    return Benchmark(
        values.get("title", path.stem),
        _unique(sequences),
        None if methods is None else tuple(methods),
        path.parent,
    )


_Kinds = Mapping[str, tuple[type, ...]]

_NUMBER: Final = (int, float)
_FILE_KEYS: Final[_Kinds] = {"title": (str,), "methods": (list,), "sequence": (list,)}
_SEQUENCE_KEYS: Final[_Kinds] = {
    "path": (str,),
    "name": (str,),
    "title": (str,),
    "group": (str,),
    "exposure": (int,),
    "stamp": (str,),
    "white": _NUMBER,
    "response": (str,),
    "truth": (str,),
    "hold_out_frames": (int,),
    "ahdr": (dict,),
    "calibration": (str, list),
}
_AHDR_KEYS: Final[_Kinds] = {
    "cut": _NUMBER,
    "low": _NUMBER,
    "high": _NUMBER,
    "black": _NUMBER,
    "saturation": _NUMBER,
}


def _check_keys(where: str, values: Any, keys: _Kinds) -> None:
    if not isinstance(values, dict):
        raise InputError(f"{where} is {values!r}; a table is needed")
    for key, value in values.items():
        if key not in keys:
            raise InputError(f"{where}: unknown key {key!r}; known are {', '.join(keys)}")
        if not isinstance(value, keys[key]) or isinstance(value, bool):
            needed = " or ".join(kind.__name__ for kind in keys[key])
            raise InputError(f"{where}: {key} is {value!r}; {needed} is needed")


def _listed(where: str, folder: Path, entry: Any) -> Sequence:
    _check_keys(where, entry, _SEQUENCE_KEYS)
    if "path" not in entry:
        raise InputError(f"{where}: has no path")
    names = {field.name for field in dataclasses.fields(Options)}
    options = {key: value for key, value in entry.items() if key in names}
    if "truth" in options:
        if "hold_out_frames" in options:
            raise InputError(f"{where}: truth and hold_out_frames exclude each other; give one")
        if "ahdr" in options:
            raise InputError(
                f"{where}: truth and ahdr exclude each other; the originals are the truth of ahdr"
            )
        options["truth"] = (folder / options["truth"]).absolute()
    if "ahdr" in options:
        options["ahdr"] = _artificial(f"{where}: ahdr", options["ahdr"])
    if "calibration" in options:
        files = (
            options["calibration"] if isinstance(options["calibration"], list) else [options["calibration"]]
        )
        if not files or not all(isinstance(file, str) for file in files):
            raise InputError(f"{where}: calibration is {files!r}; files of kalux calibrate are needed")
        options["calibration"] = tuple((folder / file).absolute() for file in files)
    path = with_name_of_its_own((folder / entry["path"]).absolute())
    try:
        plain = _sequence(path, Options(**options))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return dataclasses.replace(
        plain,
        name=_file_name(entry["name"]) if "name" in entry else plain.name,
        title=entry.get("title", entry.get("name", plain.title)),
        group=entry.get("group"),
    )


def _artificial(where: str, values: Any) -> ArtificialHdr:
    _check_keys(where, values, _AHDR_KEYS)
    if "cut" in values:
        if "low" in values or "high" in values:
            raise InputError(f"{where}: cut is for both ends; give it, or low and high")
        values = {**values, "low": values["cut"], "high": 255 - values["cut"]}
        del values["cut"]
    elif not {"low", "high"} & values.keys():
        raise InputError(f"{where}: says no level; give cut, or low and high, of 255")
    try:
        return ArtificialHdr(**{"low": 0.0, "high": 255.0, **values})
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _sequence(path: Path, options: Options) -> Sequence:
    title = path.name if path.is_dir() else path.stem
    return Sequence(name=_file_name(title), path=path, options=options, title=title)


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "-", text).strip(".-") or "sequence"


def _recordings(path: Path) -> list[Path]:
    """A recording itself, or those in a folder."""
    if not path.is_dir() or _is_recording(path):
        return [path]
    inside = sorted(p for p in path.iterdir() if not p.name.endswith(TRUTH_SUFFIX))
    found = [p for p in inside if not p.name.startswith(".") and _is_recording(p) and not _is_other_numpy(p)]
    if not found:
        raise InputError(f"{path}: neither a recording nor a folder with recordings that kalux knows")
    return found


def _is_other_numpy(path: Path) -> bool:
    """Whether it is a NumPy file that holds no events: truth, maps of a calibration, images."""
    if path.is_dir() or not numpy_files.recognises(path):
        return False
    try:
        numpy_files.find_events(path)
    except FormatError:
        return True
    return False


def _is_recording(path: Path) -> bool:
    try:
        return any(reader.recognises(path) for reader in READERS)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _unique(sequences: list[Sequence]) -> tuple[Sequence, ...]:
    """Tell sequences of the same name apart by their folders, then by numbers."""
    counts = Counter(s.name.lower() for s in sequences)
    taken: set[str] = set()
    named = []
    for sequence in sequences:
        if counts[sequence.name.lower()] > 1:
            parent = sequence.path.parent.name
            sequence = dataclasses.replace(
                sequence,
                name=_file_name(f"{parent}-{sequence.name}"),
                title=f"{parent}/{sequence.title}",
            )
        name, title, number = sequence.name, sequence.title, 1
        while sequence.name.lower() in taken:
            number += 1
            sequence = dataclasses.replace(sequence, name=f"{name}-{number}", title=f"{title} ({number})")
        taken.add(sequence.name.lower())
        named.append(sequence)
    return tuple(named)
