"""Table 1 of the report: all methods on all sequences."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from kalux.evaluation.benchmark.report_parts import metric_head, subhead
from kalux.evaluation.benchmark.results import Metric, Results
from kalux.evaluation.benchmark.sequences import Sequence as Recorded


def table_1(results: Results) -> str:
    """The means of all metrics, by groups of sequences."""
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
    head = subhead(metric_head(metric), columns)
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
