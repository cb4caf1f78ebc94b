"""The report: one self-contained HTML page with tables, curves, pictures and the calibration of the uncertainty."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kalux
from kalux.evaluation.benchmark import page, pictures, svg
from kalux.evaluation.benchmark.jobs import Job
from kalux.evaluation.benchmark.results import PSNR, Metric, Results
from kalux.evaluation.benchmark.sequences import Sequence as Recorded
from kalux.evaluation.benchmark.store import Store
from kalux.evaluation.benchmark.svg import Axis, Series
from kalux.evaluation.calibration import ONE_SIGMA
from kalux.wording import how_many

_FRAME, _REFERENCE = "frame", "reference"
_SMALL: Final = 320
"""Pictures narrower than this are enlarged pixel by pixel."""

_PARTS: Final = {"all": "all", "up_to_white": "up to white", "beyond_white": "beyond white"}


def make_report(results: Results, store: Store) -> str:
    """The page.

    Parameters
    ----------
    results
        What the jobs found.
    store
        Where their pictures are.

    Raises
    ------
    FormatError
        If the pictures of a job are damaged.
    """
    plan = results.plan
    shown = [sequence for sequence in plan.sequences if results.of_sequence(sequence)]
    links = [("table", "Table 1"), ("calibration", "Uncertainty"), ("camera", "Camera model")]
    links += [(f"s-{sequence.name}", sequence.title) for sequence in shown]
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f"<title>{escape(plan.title)}</title>",
        f"<style>{page.STYLE}{page.STYLE_OF_PICTURES}</style>{page.WITHOUT_SCRIPT}</head><body>",
        f"<header><h1>{escape(plan.title)}</h1>",
        f'<p class="soft">kalux benchmark, version {escape(kalux.__version__)}: '
        f"{how_many(len(plan.sequences), 'sequence')}, "
        f"{how_many(len(plan.methods), 'method')}, {how_many(_images(results), 'image')} compared.</p>",
        "<nav>"
        + "".join(f'<a href="#{escape(i)}">{escape(text)}</a>' for i, text in links)
        + "</nav></header><main>",
        _table_1(results),
        _failures(results),
        _calibration(results),
        _camera(results),
        *(_sequence(results, store, sequence) for sequence in shown),
        _made(results),
        f"</main><script>{page.SCRIPT}</script></body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _images(results: Results) -> int:
    return sum(
        max((len(r["scores"]["per_image"]) for r in results.of_sequence(s).values()), default=0)
        for s in results.plan.sequences
    )


# Table 1.


def _table_1(results: Results) -> str:
    groups = results.groups()
    head = ['<tr><th class="corner" rowspan="2">method</th>']
    below = []
    for group, sequences in groups.items():
        span = len(sequences) + _has_mean(sequences)
        head.append(f'<th class="group" scope="colgroup" colspan="{span}">{escape(group)}</th>')
        below += [f'<th scope="col">{escape(sequence.title)}</th>' for sequence in sequences]
        below += ['<th scope="col">mean</th>'] * _has_mean(sequences)
    bodies = [_metric_rows(results, groups, metric, len(below)) for metric in results.shown()]
    return (
        '<section id="table"><h2>Table 1: all methods on all sequences</h2>'
        '<p class="soft">Means over images. Best of a column: bold, underlined. ↓ lower is better, ↑ higher.</p>'
        f'<div class="wide"><table><thead>{"".join(head)}</tr><tr>{"".join(below)}</tr></thead>'
        f"{''.join(bodies)}</table></div>{_metric_notes(results)}</section>"
    )


def _has_mean(sequences: Sequence[Recorded]) -> int:
    return int(len(sequences) > 1)


def _metric_rows(results: Results, groups: dict[str, list[Recorded]], metric: Metric, columns: int) -> str:
    methods = results.plan.methods
    cells: dict[str, list[str]] = {method: [] for method in methods}
    for sequences in groups.values():
        for sequence in sequences:
            values = {m: results.mean(sequence, m, metric.name) for m in methods}
            failed = {m for m in methods if (sequence.name, m) in results.failures}
            _column(cells, results, metric, values, failed, "")
        if _has_mean(sequences):
            values = {m: results.group_mean(sequences, m, metric.name) for m in methods}
            _column(cells, results, metric, values, set(), "mean")
    rows = (
        f'<tr><th scope="row">{escape(results.label(method))}</th>{"".join(row)}</tr>'
        for method, row in cells.items()
    )
    head = _subhead(_metric_head(metric), columns)
    return f"<tbody>{head}{''.join(rows)}</tbody>"


def _column(
    cells: dict[str, list[str]],
    results: Results,
    metric: Metric,
    values: dict[str, float | None],
    failed: set[str],
    kind: str,
) -> None:
    best = results.best(metric, values)
    for method, value in values.items():
        kinds = " ".join(
            [kind, *(["best"] if method in best else []), *(["failed"] if method in failed else [])]
        )
        text = "failed" if method in failed else metric.shown(value)
        cells[method].append(f'<td class="{kinds.strip()}">{text}</td>')


def _metric_head(metric: Metric) -> str:
    arrow = "↓" if metric.lower_is_better else "↑"
    return escape(f"{metric.label} {metric.unit}".strip()) + f" {arrow}"


def _metric_notes(results: Results) -> str:
    quality = " Q: HDR-VDP 3.0.6, an intensity of 1 shown as 255 cd/m²."
    perceptual = (
        " LPIPS v0.1, AlexNet: of intensities over the data range with the sRGB curve, not clipped; masked pixels as "
        "in the reference."
    )
    shown = {metric.name for metric in results.shown()}
    return (
        '<p class="soft">MSE of linear intensity. 1 is white: a saturated pixel at the median exposure (ground truth), '
        "or the 99.5th percentile of all frames (held-out frames). SSIM of Wang et al., 11 × 11 Gaussian windows. "
        "log-MSE of log(I + 0.02). Nothing is clipped. A dash: the method looks at the very frames it would be "
        "compared with."
        f"{quality if 'q' in shown else ''}{perceptual if 'lpips' in shown else ''}</p>"
    )


def _failures(results: Results) -> str:
    if not results.failures:
        return ""
    rows = "".join(
        f"<li><code>{escape('/'.join(name))}</code>: {escape(failed.message)}</li>"
        for name, failed in results.failures.items()
    )
    return f"<section><h3>Failed</h3><ul>{rows}</ul></section>"


# The calibration of the uncertainty.


def _calibrated(results: Results) -> list[tuple[Recorded, str, dict[str, Any]]]:
    return [
        (sequence, method, record["calibration"])
        for sequence in results.plan.sequences
        for method, record in results.of_sequence(sequence).items()
        if record["calibration"] is not None
    ]


def _calibration(results: Results) -> str:
    found = _calibrated(results)
    if not found:
        return ""
    with_highlights = any(calibration["beyond_white"] is not None for _, _, calibration in found)
    parts = _PARTS if with_highlights else {"all": "all"}
    bodies = [
        _calibration_rows(results, sequence, [(m, c) for s, m, c in found if s == sequence], parts)
        for sequence in dict.fromkeys(sequence for sequence, _, _ in found)
    ]
    span = len(parts)
    below = "".join(f'<th scope="col">{text}</th>' for text in parts.values())
    return (
        '<section id="calibration"><h2>Does the uncertainty tell the truth?</h2>'
        f"<p>Of a calibrated method, {100 * ONE_SIGMA:.1f} % of the errors lie within one standard deviation σ that it "
        "gives, and z = error / σ has an rms of 1. More than that within σ: too cautious. An rms of z above 1: too "
        "sure, or a few errors that are far larger than expected.</p>"
        '<p class="soft">Errors and σ are of log(I + I<sub>0</sub>) with the method’s own I<sub>0</sub>. Ground truth: '
        "all compared pixels count, also those that are clipped in the frames; “beyond white” are these. Held-out "
        "frames: pixels that are clipped in the frame itself do not count; the variance is the mean over the exposure "
        "and, as the error is that of both, the frame’s own. Median z: of |z|, over that of Gaussian errors; below the "
        "rms where a few pixels have most of the error.</p>"
        '<div class="wide"><table><thead><tr><th class="corner" rowspan="2">method</th>'
        '<th rowspan="2">pixels</th>'
        f'<th class="group" colspan="{span}">errors within 1 σ, %</th><th class="group" colspan="{span}">rms z</th>'
        '<th rowspan="2">median z</th>'
        f'<th rowspan="2">rms error</th><th rowspan="2">rms σ</th></tr><tr>{below}{below}</tr></thead>'
        f"{''.join(bodies)}</table></div></section>"
    )


def _calibration_rows(
    results: Results,
    sequence: Recorded,
    found: list[tuple[str, dict[str, Any]]],
    parts: dict[str, str],
) -> str:
    rows = [_subhead(escape(sequence.title), 2 * len(parts) + 4)]
    for method, calibration in found:
        chosen = [calibration[part] for part in parts]
        if calibration["beyond_white"] is None:  # then what is up to white is all
            chosen[1:] = [None] * (len(parts) - 1)
        shares = ("–" if part is None else f"{100 * part['one_sigma']:.1f}" for part in chosen)
        spreads = ("–" if part is None else f"{part['rms_z']:.2f}" for part in chosen)
        whole = calibration["all"]
        last = f"{whole['median_z']:.2f}", f"{whole['rms_error']:.3f}", f"{whole['rms_sigma']:.3f}"
        cells = "".join(f"<td>{text}</td>" for text in (f"{whole['pixels']:,}", *shares, *spreads, *last))
        rows.append(f'<tr><th scope="row">{escape(results.label(method))}</th>{cells}</tr>')
    return f"<tbody>{''.join(rows)}</tbody>"


def _subhead(text: str, columns: int) -> str:
    """The first row of a table's part."""
    head = f'<th class="metric corner" scope="rowgroup">{text}</th>'
    return f'<tr>{head}<td colspan="{columns}"></td></tr>'


def _calibration_charts(results: Results, records: dict[str, dict[str, Any]]) -> str:
    coverage, by_sigma = [], []
    for method, record in records.items():
        calibration = record["calibration"]
        if calibration is None:
            continue
        whole = calibration["all"]
        label, style = results.label(method), _style(results, method)
        shares = whole["coverage"]
        coverage.append(Series(label, style, list(zip(shares["nominal"], shares["observed"], strict=True))))
        classes = whole["by_sigma"]
        by_sigma.append(Series(label, style, list(zip(classes["sigma"], classes["rms_error"], strict=True))))
    if not coverage:
        return ""
    unit = Axis("share of errors expected in a band", limits=(0.0, 1.0))
    first = svg.chart("Reliability", unit, Axis("share observed", limits=(0.0, 1.0)), coverage, diagonal=True)
    second = svg.chart(
        "Error by uncertainty",
        Axis("σ that the method gives", log=True),
        Axis("rms error of these pixels", log=True),
        by_sigma,
        diagonal=True,
    )
    return (
        f"<h3>Calibration of the uncertainty</h3>{_legend(results, [m for m in records if records[m]['calibration']])}"
        f'<div class="charts"><figure>{first}<figcaption>Reliability: bands around the estimate, as wide as Gaussian '
        "errors would need, and how many errors they hold. Dotted: calibrated. Below it the method is too sure."
        f"</figcaption></figure><figure>{second}<figcaption>Pixels sorted by the σ that the method gives: their rms "
        "error, of log(I + I<sub>0</sub>). Dotted: calibrated. Classes of at least 100 pixels."
        "</figcaption></figure></div>"
    )


# Figure 2.


def _camera(results: Results) -> str:
    models: dict[str, tuple[dict[str, Any], set[str], set[str]]] = {}
    for sequence in results.plan.sequences:
        for method, record in results.of_sequence(sequence).items():
            if (camera := record["camera"]) is not None:
                _, methods, titles = models.setdefault(json.dumps(camera), (camera, set(), set()))
                methods.add(results.label(method))
                titles.add(sequence.title)
    if not models:
        return ""
    weights, covariances, legend = [], [], []
    for style, (camera, methods, titles) in enumerate(models.values()):
        levels = [255 * level for level in camera["response"]]
        weights.append(Series(camera["source"], style, list(zip(levels, camera["weight"], strict=True))))
        covariances.append(
            Series(camera["source"], style, list(zip(levels, camera["covariance"], strict=True)))
        )
        used = f"{'; '.join(sorted(methods))} on {'; '.join(sorted(titles))}"
        legend.append(
            f"<li>{svg.sample(style)}<span>{escape(camera['source'])}"
            f' <span class="soft">({escape(used)})</span></span></li>'
        )
    x = Axis("camera response, 8-bit levels", limits=(0.0, 255.0))
    first = svg.chart("Weighting function", x, Axis("weight fʷ", limits=(0.0, 1.05)), weights)
    second = svg.chart("Image covariance function", x, Axis("covariance R̄ / σᵢₘ²", log=True), covariances)
    return (
        '<section id="camera"><h2>The camera model in use (Figure 2 of the paper)</h2>'
        f'<ul class="legend">{"".join(legend)}</ul>'
        f'<div class="charts"><figure>{first}<figcaption>(a) Weighting function, equation (5). Where kalux’s default '
        "takes a pixel as clipped it has no weight.</figcaption></figure>"
        f"<figure>{second}<figcaption>(b) Covariance of the frame’s noise, equation (6); it ends where a pixel counts "
        "as clipped, or is capped by the paper’s floor of "
        "f<sup>w</sup>.</figcaption></figure></div></section>"
    )


# A sequence.


def _sequence(results: Results, store: Store, sequence: Recorded) -> str:
    records = results.of_sequence(sequence)
    first = next(iter(records.values()))
    return "\n".join(
        (
            f'<section id="s-{escape(sequence.name)}"><h2>{escape(sequence.title)}</h2>',
            f"<p>{escape(_sentence(first['scores']['protocol']))}</p>",
            f'<p class="soft"><code>{escape(Path(first["sequence"]["path"]).name)}</code></p>',
            _scores(results, records),
            _curves(results, records),
            _pictures(results, store, sequence),
            _calibration_charts(results, records),
            "</section>",
        )
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _scores(results: Results, records: dict[str, dict[str, Any]]) -> str:
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
    head = "".join(f'<th scope="col">{_metric_head(metric)}</th>' for metric in metrics)
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
                _style(results, method),
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
    return f'<h3>Error over time</h3>{_legend(results, records)}<div class="charts">{"".join(figures)}</div>'


def _legend(results: Results, methods: Iterable[str]) -> str:
    entries = (f"<li>{svg.sample(_style(results, m))}{escape(results.label(m))}</li>" for m in methods)
    return f'<ul class="legend">{"".join(entries)}</ul>'


def _style(results: Results, method: str) -> int:
    return results.plan.methods.index(method)


# Figures 5 and 6.


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


# How it was made.


def _made(results: Results) -> str:
    seen: dict[str, dict[str, str]] = {}
    for record in results.records.values():
        seen.setdefault(json.dumps(record["versions"], sort_keys=True), record["versions"])
    lines = [", ".join(f"{name} {version}" for name, version in v.items()) for v in seen.values()]
    return (
        "<section><h2>How this was made</h2><p>By <code>kalux benchmark</code>. The files <code>results.csv</code> and "
        "<code>results.json</code> beside this page hold all numbers, with the settings of every method and the scores "
        f"of every image.</p>{''.join(f'<p class=soft>{escape(line)}</p>' for line in lines)}</section>"
    )
