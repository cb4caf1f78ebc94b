"""A sequence in the report: its scores, curves over time, and pictures as in Figures 5 and 6 of the paper."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.evaluation.benchmark import pictures, svg
from kalux.evaluation.benchmark.jobs import Job
from kalux.evaluation.benchmark.report_parts import legend, metric_head, style_of
from kalux.evaluation.benchmark.report_uncertainty import calibration_charts
from kalux.evaluation.benchmark.results import PSNR, Metric, Results
from kalux.evaluation.benchmark.sequences import Sequence as Recorded
from kalux.evaluation.benchmark.store import Store
from kalux.evaluation.benchmark.svg import Axis, Series
from kalux.wording import how_many

_FRAME, _REFERENCE = "frame", "reference"
_SMALL: Final = 320
"""Pictures narrower than this are enlarged pixel by pixel."""


def sequence_section(results: Results, store: Store, sequence: Recorded) -> str:
    """All about a sequence."""
    records = results.of_sequence(sequence)
    first = next(iter(records.values()))
    return "\n".join(
        (
            f'<section id="s-{escape(sequence.name)}"><h2>{escape(sequence.title)}</h2>',
            f"<p>{escape(_sentence(first['scores']['protocol']))}</p>",
            f'<p class="soft"><code>{escape(Path(first["sequence"]["path"]).name)}</code></p>',
            _score_table(results, records),
            _curves(results, records),
            _pictures(results, store, sequence),
            calibration_charts(results, records),
            "</section>",
        )
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _score_table(results: Results, records: dict[str, dict[str, Any]]) -> str:
    metrics = [*results.shown(), PSNR]
    best = {
        metric.name: results.best(metric, {m: r["scores"]["means"][metric.name] for m, r in records.items()})
        for metric in metrics
    }
    rows = []
    for method, record in records.items():
        means = record["scores"]["means"]
        cells = "".join(
            f'<td class="{"best" if method in best[m.name] else ""}">{m.shown(means[m.name])}</td>'
            for m in metrics
        )
        seconds = record["seconds"]["images"]
        rows.append(
            f'<tr><th scope="row">{escape(results.label(method))}</th>{cells}<td>{seconds:.1f}</td></tr>'
        )
    head = "".join(f'<th scope="col">{metric_head(metric)}</th>' for metric in metrics)
    first = next(iter(records.values()))["scores"]
    said = [
        f"{how_many(len(first['per_image']), 'image')}, {how_many(first['pixels'], 'pixel')}; "
        f"data range {first['data_range']:.4g}"
    ]
    everywhere = [
        text
        for text in first["adjustments"]
        if "negative" not in text and all(text in r["scores"]["adjustments"] for r in records.values())
    ]
    said += everywhere
    said += [
        f"{results.label(method)}: {text}"
        for method, record in records.items()
        for text in record["scores"]["adjustments"]
        if text not in everywhere and "negative" not in text
    ]
    said.append("s: seconds to make the images, on one thread")
    return (
        f'<p class="soft">{escape("; ".join(said))}.</p>'
        '<div class="wide"><table><thead><tr><th class="corner">method</th>'
        f'{head}<th scope="col">s</th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _curves(results: Results, records: dict[str, dict[str, Any]]) -> str:
    start = min(r["scores"]["per_image"][0]["t"] for r in records.values())

    def lines(metric: Metric) -> list[Series]:
        return [
            Series(
                results.label(method),
                style_of(results, method),
                [
                    (
                        1e-6 * (image["t"] - start),
                        None if image[metric.name] is None else metric.factor * image[metric.name],
                    )
                    for image in record["scores"]["per_image"]
                ],
            )
            for method, record in records.items()
        ]

    figures = []
    for metric in results.shown():
        label = f"{metric.label} {metric.unit}".strip()
        drawn = svg.chart(
            f"{label} over time", Axis("time, s"), Axis(label, log=metric.lower_is_better), lines(metric)
        )
        if drawn:
            figures.append(f"<figure>{drawn}</figure>")
    return f'<h3>Error over time</h3>{legend(results, records)}<div class="charts">{"".join(figures)}</div>'


def _pictures(results: Results, store: Store, sequence: Recorded) -> str:
    records = results.of_sequence(sequence)
    jobs = {
        job.method: job for job in results.plan.jobs if job.sequence == sequence and job.method in records
    }
    arrays = {method: store.pictures(jobs[method]) for method in records}
    first = next(iter(arrays.values()))
    start = next(iter(records.values()))["scores"]["per_image"][0]["t"]
    seconds = [f"{1e-6 * (int(t) - start):.2f} s" for t in first["times"]]
    names = {_FRAME: "camera frame", **{m: results.label(m) for m in records}, _REFERENCE: "reference"}
    number = sequence.name
    moments = [
        _moment(results, jobs, arrays, names, k, hidden=k != len(seconds) // 2) for k in range(len(seconds))
    ]
    middle = len(seconds) // 2
    radios = "".join(
        f'<label><input type="radio" name="t-{escape(number)}" value="{k}"{" checked" if k == middle else ""}>'
        f" {text}</label>"
        for k, text in enumerate(seconds)
    )
    return (
        f"<div data-moments><h3>Pictures</h3><fieldset><legend>Time</legend>{radios}</fieldset>"
        f"{_compare(names, first)}{''.join(moments)}</div>"
    )


def _compare(names: dict[str, str], arrays: dict[str, NDArray[Any]]) -> str:
    """The slider; the script fills in its pictures."""
    methods = [name for name in names if name not in (_FRAME, _REFERENCE)]

    def choice(label: str, chosen: str) -> str:
        options = "".join(
            f'<option value="{escape(name)}"{" selected" if name == chosen else ""}>{escape(text)}</option>'
            for name, text in names.items()
        )
        return f'<label>{label} <select aria-label="{label} picture">{options}</select></label>'

    height, width = arrays[_REFERENCE].shape[1:]
    blank = f'width="{width}" height="{height}" alt=""'
    sharp = "small " if width < _SMALL else ""
    return (
        '<figure class="compare" hidden>'
        f'<div class="choice">{choice("left", _FRAME)}{choice("right", methods[-1])}</div>'
        f'<div class="stage"><img class="{sharp}" {blank}><img class="{sharp}over" {blank}>'
        '<div class="edge"></div></div>'
        '<input type="range" min="0" max="100" value="50" aria-label="where the left picture ends">'
        "<figcaption>Drag, or use the arrow keys on the slider. All pictures have the reference’s tone curve."
        "</figcaption></figure>"
    )


def _moment(
    results: Results,
    jobs: dict[str, Job],
    arrays: dict[str, dict[str, NDArray[Any]]],
    names: dict[str, str],
    k: int,
    *,
    hidden: bool,
) -> str:
    first = next(iter(arrays.values()))
    reference = first[_REFERENCE][k]
    images = {_FRAME: first[_FRAME][k], **{m: a["test"][k] for m, a in arrays.items()}, _REFERENCE: reference}
    width = reference.shape[1]
    uris = pictures.shown(images, reference)
    mse = {m: _mse_at(results.records[jobs[m].sequence.name, m], int(first["times"][k])) for m in arrays}
    shots = [
        _figure(uri, names[name], f"MSE × 100: {100 * mse[name]:.3f}" if name in mse else "", width, name)
        for name, uri in uris.items()
    ]
    maps = [
        uri
        for m, a in arrays.items()
        for uri in _maps(a, k, reference, names[m], _log_offset(results, jobs[m]), width)
    ]
    return (
        f'<div class="moment"{" hidden" if hidden else ""}><div class="pictures">{"".join(shots)}</div>'
        f"<h3>Error and uncertainty</h3>{_colour_key()}"
        f'<div class="pictures">{"".join(maps)}</div></div>'
    )


def _maps(
    arrays: dict[str, NDArray[Any]],
    k: int,
    reference: NDArray[Any],
    title: str,
    log_offset: float,
    width: int,
) -> Iterable[str]:
    """The error of a picture and, where the method has it, its uncertainty."""
    test = arrays["test"][k]
    yield _figure(pictures.error_map(test, reference), title, "error", width)
    if "variance" in arrays:
        yield _figure(
            pictures.uncertainty_map(arrays["variance"][k], test, log_offset), title, "uncertainty σ", width
        )


def _log_offset(results: Results, job: Job) -> float:
    calibration = results.records[job.sequence.name, job.method]["calibration"]
    return float(calibration["log_offset"]) if calibration is not None else 0.0


def _mse_at(record: dict[str, Any], t: int) -> float:
    return next(float(image["mse"]) for image in record["scores"]["per_image"] if image["t"] == t)


def _figure(uri: str, title: str, text: str, width: int, name: str = "") -> str:
    marked = f' data-name="{escape(name)}"' if name else ""
    said = f"{title}, {text}" if text else title
    return (
        f'<figure><img src="{uri}" alt="{escape(said)}"{marked}{_pixelated(width)}>'
        f"<figcaption><b>{escape(title)}</b>{' ' + escape(text) if text else ''}</figcaption></figure>"
    )


def _pixelated(width: int) -> str:
    return ' class="small"' if width < _SMALL else ""


def _colour_key() -> str:
    low, high = pictures.MAP_LIMITS
    ticks = "".join(f"<span>{value:.2g}</span>" for value in np.geomspace(low, high, 5))
    return (
        f'<div class="key"><div class="bar" style="background:{pictures.gradient()}"></div>'
        f'<div class="ticks">{ticks}</div><p class="soft">Of log(I + 0.02), the lighter the larger: absolute error, '
        "and the standard deviation that the method gives for it. Equal colours of both are what a calibrated method "
        "would show on average.</p></div>"
    )
