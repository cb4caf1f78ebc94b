"""The sequences of a benchmark: recordings, folders of recordings, and TOML files that list them."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import kalux
from kalux.errors import InputError
from kalux.frames import Stamp
from kalux.readers import READERS
from kalux.recording import Recording

TRUTH_SUFFIX: Final = "_gt.npz"
"""Reference images beside a recording: ``pan_gt.npz`` beside ``pan.mat``."""

EVERY: Final = 2
"""Every second frame is held out where there is no ground truth."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is said of a sequence beside its path.

    Attributes
    ----------
    exposure
        us, of recordings that store none.
    stamp
        What a frame's time marks, with ``exposure``.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    truth
        File of reference images. Default: those beside the recording, or its own.
    hold_out_frames
        Every n-th frame is held out, even where there is truth.
    """

    exposure: int | None = None
    stamp: Stamp = "start"
    response: str = "linear"
    truth: Path | None = None
    hold_out_frames: int | None = None


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
        recording = kalux.open(self.path)
        if recording.exposure_known or self.options.exposure is None:
            return recording
        return kalux.open(self.path, exposure=self.options.exposure, stamp=self.options.stamp)

    def truth_file(self) -> Path | None:
        """The file of reference images that is named, or lies beside the recording; None: there is none."""
        if self.options.hold_out_frames is not None:
            return None
        return self.options.truth or truth_beside(self.path)

    def files(self) -> list[Path]:
        """All files that the scores depend on, in order."""
        path = Path(str(self.path).partition("?")[0]) if not self.path.exists() else self.path
        truth = self.truth_file()
        return [*files_under(path), *([] if truth is None else [truth])]


def truth_beside(path: Path) -> Path | None:
    """``X_gt.npz`` beside ``X.mat``, if it is there."""
    beside = path.with_name(path.stem + TRUTH_SUFFIX)
    return beside if beside.is_file() else None


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
        Names as `kalux.evaluation.baselines.chosen_methods` takes them; None: all that are compared by default.
    """

    title: str
    sequences: tuple[Sequence, ...]
    methods: tuple[str, ...] | None = None


def gather(sets: Iterable[str | Path], options: Options | None = None) -> Benchmark:
    """The sequences of recordings, of folders of recordings and of TOML files.

    Parameters
    ----------
    sets
        Paths. What a TOML file says, holds for its sequences.
    options
        For all sequences that are not from a TOML file.

    Raises
    ------
    InputError
        If something is missing, no recording, or a TOML file is wrong.
    """
    common = options or Options()
    found: list[Sequence] = []
    titles, methods = [], []
    for given in sets:
        path = Path(given).absolute()
        if path.suffix.lower() == ".toml":
            listed = load(path)
            titles.append(listed.title)
            methods.append(listed.methods)
            found += listed.sequences
        else:
            found += [_sequence(path, common) for path in _recordings(path)]
    if not found:
        raise InputError("benchmark: no sequence is given; give recordings, folders of them, or a TOML file")
    title = titles[0] if len(titles) == 1 else "Benchmark"
    return Benchmark(title, _unique(found), methods[0] if len(methods) == 1 else None)


def load(path: Path) -> Benchmark:
    """Read a TOML file: ``title``, ``methods``, and tables ``[[sequence]]``, see docs/benchmark.md.

    Raises
    ------
    InputError
        If it cannot be read, is no TOML, or says something unknown; names the sequence.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    _check_keys(f"{path}", values, _FILE_KEYS)
    entries = values.get("sequence", [])
    if not entries:
        raise InputError(f"{path}: lists no sequence; add a table [[sequence]] with a path")
    sequences = [_listed(f"{path}: sequence {i}", path.parent, entry) for i, entry in enumerate(entries, 1)]
    methods = values.get("methods")
    if methods is not None and not all(isinstance(name, str) for name in methods):
        raise InputError(f"{path}: methods is {methods!r}; a list of names is needed")
    return Benchmark(
        values.get("title", path.stem), _unique(sequences), None if methods is None else tuple(methods)
    )


_FILE_KEYS: Final[dict[str, type]] = {"title": str, "methods": list, "sequence": list}
_SEQUENCE_KEYS: Final[dict[str, type]] = {
    "path": str,
    "name": str,
    "title": str,
    "group": str,
    "exposure": int,
    "stamp": str,
    "response": str,
    "truth": str,
    "hold_out_frames": int,
}


def _check_keys(where: str, values: Any, keys: dict[str, type]) -> None:
    if not isinstance(values, dict):
        raise InputError(f"{where} is {values!r}; a table is needed")
    for key, value in values.items():
        if key not in keys:
            raise InputError(f"{where}: unknown key {key!r}; known are {', '.join(keys)}")
        if not isinstance(value, keys[key]) or isinstance(value, bool):
            raise InputError(f"{where}: {key} is {value!r}; {keys[key].__name__} is needed")


def _listed(where: str, folder: Path, entry: Any) -> Sequence:
    _check_keys(where, entry, _SEQUENCE_KEYS)
    if "path" not in entry:
        raise InputError(f"{where}: has no path")
    names = {field.name for field in dataclasses.fields(Options)}
    options = {key: value for key, value in entry.items() if key in names}
    if "truth" in options:
        if "hold_out_frames" in options:
            raise InputError(f"{where}: truth and hold_out_frames exclude each other; give one")
        options["truth"] = (folder / options["truth"]).absolute()
    path = (folder / entry["path"]).absolute()
    plain = _sequence(path, Options(**options))
    return dataclasses.replace(
        plain,
        name=_file_name(entry["name"]) if "name" in entry else plain.name,
        title=entry.get("title", entry.get("name", plain.title)),
        group=entry.get("group"),
    )


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
    found = [p for p in inside if not p.name.startswith(".") and _is_recording(p)]
    if not found:
        raise InputError(f"{path}: neither a recording nor a folder with recordings that kalux knows")
    return found


def _is_recording(path: Path) -> bool:
    try:
        return any(reader.recognises(path) for reader in READERS)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _unique(sequences: list[Sequence]) -> tuple[Sequence, ...]:
    """Tell sequences of the same name apart by their folders, then by numbers."""
    counts = Counter(s.name.lower() for s in sequences)
    seen: Counter[str] = Counter()
    named = []
    for sequence in sequences:
        if counts[sequence.name.lower()] > 1:
            parent = sequence.path.parent.name
            sequence = dataclasses.replace(
                sequence,
                name=_file_name(f"{parent}-{sequence.name}"),
                title=f"{parent}/{sequence.title}",
            )
        seen[sequence.name.lower()] += 1
        if seen[sequence.name.lower()] > 1:
            number = seen[sequence.name.lower()]
            sequence = dataclasses.replace(
                sequence, name=f"{sequence.name}-{number}", title=f"{sequence.title} ({number})"
            )
        named.append(sequence)
    return tuple(named)
