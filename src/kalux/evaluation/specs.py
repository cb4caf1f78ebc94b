"""Methods by a text that any process can read: a name of `kalux.evaluation.baselines`, or one from outside.

From outside are networks with their weights, and folders of images.

::

    firenet:weights.pth                  a network of `kalux.evaluation.learned`, windows of events from frame to frame
    firenet:weights.pth?window=40000     windows of 40 ms
    firenet:weights.pth?scaled           gain and offset fitted to the recording's frames
    theirs=results/run3                  a folder of images with timestamps.csv; in tables it is "theirs"
    folder:results/run3                  the same, in tables it is "run3"
    theirs=results/run3?tolerance=5000   an image serves times up to 5 ms away
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

from kalux.calibration.values import Calibration
from kalux.errors import InputError, MissingDependencyError
from kalux.evaluation import folder_method
from kalux.evaluation.baselines import OPTIONAL, Planner, methods
from kalux.evaluation.learned.catalogue import NETWORKS, checksums
from kalux.evaluation.method import Image, Method, Times
from kalux.recording import Recording
from kalux.settings import AUTO
from kalux.wording import how_many

FORMS: Final = "NETWORK:WEIGHTS (" + ", ".join(NETWORKS) + "), NAME=FOLDER or folder:FOLDER of images"
"""For messages."""

_OPTION: Final = r"[a-z]+(?:=\d+)?"
_SPEC: Final = re.compile(
    rf"(?P<name>[^:=?]+)(?P<kind>[:=])(?P<path>.+?)(?:\?(?P<options>{_OPTION}(?:&{_OPTION})*))?"
)


def chosen_methods(
    names: Iterable[str] | None = None,
    *,
    response: str = AUTO,
    held_out: bool = False,
    calibration: Calibration | None = None,
    planner: Planner | None = None,
) -> list[Method]:
    """Methods by name, in that order.

    Parameters
    ----------
    names
        Of `kalux.evaluation.baselines.methods`, or a text as above: a network with its weights, a folder of images.
        Default: all of the former that can be compared, without `OPTIONAL`.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    held_out
        Whether all that is compared lies between the frames that methods are given: frames are held out, or ground
        truth is nowhere else.
    calibration
        What was measured of the sensor, for all filters.
    planner
        Of the same calibration, to share its plans. Default: a new one.

    Raises
    ------
    InputError
        If a name is unknown or not distinct, the method needs frames to be held out, or its weights or images are
        missing.
    MissingDependencyError
        If the method is a network, and PyTorch is not installed.
    """
    known = methods(response, calibration, planner)
    if names is None:
        names = [n for n, m in known.items() if n not in OPTIONAL and (held_out or not m.needs_held_out)]
    names = list(names)
    check_distinct(names)
    chosen = []
    for name in names:
        method = known.get(name) or outside_method(name, response=response)
        if method is None:
            raise InputError(f"there is no method {name!r}; known are {', '.join(known)}, and {FORMS}")
        if method.needs_held_out and not held_out:
            raise InputError(
                f"method {name!r} looks at the frames around an image, which is a comparison only where frames "
                "are held out, or all ground truth lies between frames"
            )
        chosen.append(method)
    if not chosen:
        raise InputError(f"no method is given; known are {', '.join(known)}")
    return chosen


def check_distinct(names: Iterable[str]) -> None:
    """Require that methods can be told apart in tables.

    Raises
    ------
    InputError
        If one is named twice, or two folders have one name.
    """
    found: dict[str, str] = {}
    for name in names:
        match = _SPEC.fullmatch(name)
        label = match["name"].strip() if match is not None and match["kind"] == "=" else name
        if label in found:
            other = f"{found[label]!r} is there already; " if found[label] != name else "is given twice; "
            raise InputError(
                f"method {name!r}: {other}give each once, and folders names that differ: NAME=FOLDER"
            )
        found[label] = name


def spec_path(spec: str) -> Path | None:
    """The file or folder that a method's text names; None: it names none."""
    match = _SPEC.fullmatch(spec)
    return None if match is None else Path(match["path"])


def relocated(spec: str, folder: Path) -> str:
    """The same text, its file or folder absolute; relative ones are relative to ``folder``."""
    match = _SPEC.fullmatch(spec)
    if match is None:
        return spec
    return f"{spec[: match.start('path')]}{(folder / match['path']).absolute()}{spec[match.end('path') :]}"


def outside_method(spec: str, *, response: str = "linear") -> Method | None:
    """The method that a text names; None if it has no such form. ``response`` is the camera's, for ``?scaled``.

    Raises
    ------
    InputError
        If weights or images are missing, or the option is unknown.
    FormatError
        If the weights do not fit the network, or the folder's list cannot be read.
    MissingDependencyError
        If the method is a network, and PyTorch is not installed.
    """
    if spec in NETWORKS:
        raise InputError(
            f"method {spec!r} needs its weights: {spec}:FILE; the authors publish them at {NETWORKS[spec].home}"
        )
    match = _SPEC.fullmatch(spec)
    if match is None:
        return None
    name, path = match["name"].strip(), Path(match["path"])
    options = match["options"]
    is_folder = match["kind"] == "=" or name == "folder"
    if options is None and "?" in match["path"] and (is_folder or name in NETWORKS) and not path.exists():
        raise InputError(
            f"method {spec!r}: there is no {path}, and what follows ? is no option; those of a folder are "
            "?tolerance=US, of a network ?window=US and ?scaled, joined by &, US in digits"
        )
    if match["kind"] == ":" and name in NETWORKS:
        return _network(
            spec, name, path, response, **_read_options(spec, options, {"window": "=US", "scaled": ""})
        )
    if not is_folder:
        return None
    label = name if match["kind"] == "=" else path.resolve().name
    return _folder(label, path, **_read_options(spec, options, {"tolerance": "=US"}))


def _read_options(spec: str, text: str | None, known: dict[str, str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for part in text.split("&") if text else []:
        key, equals, value = part.partition("=")
        if key not in known or bool(equals) != bool(known[key]) or (equals and int(value) < 1):
            forms = ", ".join(f"?{name}{form}" for name, form in known.items())
            raise InputError(f"method {spec!r}: the options here are {forms}; US is at least 1")
        options[key] = int(value) if equals else True
    return options


def _network(
    spec: str, name: str, path: Path, response: str, *, window: int | None = None, scaled: bool = False
) -> Method:
    published, found = NETWORKS[name], checksums(name, path)
    others = [other for other, entry in NETWORKS.items() if entry.blob == found.blob and other != name]
    if others:
        raise InputError(
            f"{path}: these are the weights of {NETWORKS[others[0]].label}; give {others[0]}:{path}"
        )
    if importlib.util.find_spec("torch") is None:
        raise MissingDependencyError(f"method {spec!r} needs PyTorch; pip install 'kalux[learned]'")
    from kalux.evaluation.learned import weights

    weights.load_network(name, path)
    known = (
        "as EVREAL distributes them" if found.blob == published.blob else "not those that EVREAL distributes"
    )
    windows = "from frame to frame" if window is None else f"of {window} us"
    stretched = (
        ", 1st to 99th percentile of each image stretched to 0 to 1" if published.tone == "robust" else ""
    )
    scale = "then gain and offset fitted to the given frames" if scaled else "not scaled to frames"
    return Method(
        f"{published.label}, scaled" if scaled else published.label,
        partial(_network_images, name=name, path=path, window=window, scaled=scaled, response=response),
        notes=(
            f"events only, windows {windows}; relative intensity{stretched}, clipped to 0 to 1, {scale}",
            f"weights {path.name}, SHA-256 {found.sha256[:16]}, {known}",
        ),
    )


def _network_images(recording: Recording, times: Times, **chosen: Any) -> Iterator[Image]:
    from kalux.evaluation.learned import runner

    return runner.images(recording, times, **chosen)


def _folder(label: str, folder: Path, tolerance: int = folder_method.TOLERANCE) -> Method:
    _, files = folder_method.listed(folder)
    linear = all(file.suffix.lower() in (".exr", ".npy") for file in files)
    taken = "linear" if linear else "display values 0 to 1 taken as intensity"
    images = partial(folder_method.images, folder=folder, tolerance=tolerance)
    return Method(
        label,
        images,
        notes=(f"{how_many(len(files), 'image')} of {folder}, {taken}; up to {tolerance} us away",),
    )
