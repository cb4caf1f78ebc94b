"""The calibration of the uncertainty in the report: does the variance that methods give tell the truth?"""

from __future__ import annotations

from html import escape
from typing import Any, Final

from kalux.evaluation.benchmark import svg
from kalux.evaluation.benchmark.report_parts import legend, style_of, subhead
from kalux.evaluation.benchmark.results import Results
from kalux.evaluation.benchmark.sequences import Sequence as Recorded
from kalux.evaluation.benchmark.svg import Axis, Series
from kalux.evaluation.calibration import ONE_SIGMA

_PARTS: Final = {"all": "all", "up_to_white": "up to white", "beyond_white": "beyond white"}


def _calibrated(results: Results) -> list[tuple[Recorded, str, dict[str, Any]]]:
    return [
        (sequence, method, record["calibration"])
        for sequence in results.plan.sequences
        for method, record in results.of_sequence(sequence).items()
        if record["calibration"] is not None
    ]


def calibration_section(results: Results) -> str:
    """How many errors lie within the standard deviations that methods give; empty where none gives any."""
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
    rows = [subhead(escape(sequence.title), 2 * len(parts) + 4)]
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


def calibration_charts(results: Results, records: dict[str, dict[str, Any]]) -> str:
    """Reliability, and error by uncertainty, of the methods on one sequence; empty where none gives any."""
    coverage, by_sigma = [], []
    for method, record in records.items():
        calibration = record["calibration"]
        if calibration is None:
            continue
        whole = calibration["all"]
        label, style = results.label(method), style_of(results, method)
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
        f"<h3>Calibration of the uncertainty</h3>{legend(results, [m for m in records if records[m]['calibration']])}"
        f'<div class="charts"><figure>{first}<figcaption>Reliability: bands around the estimate, as wide as Gaussian '
        "errors would need, and how many errors they hold. Dotted: calibrated. Below it the method is too sure."
        f"</figcaption></figure><figure>{second}<figcaption>Pixels sorted by the σ that the method gives: their rms "
        "error, of log(I + I<sub>0</sub>). Dotted: calibrated. Classes of at least 100 pixels."
        "</figcaption></figure></div>"
    )
