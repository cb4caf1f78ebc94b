"""What several sections of the report have in common."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from kalux.evaluation.benchmark import svg
from kalux.evaluation.benchmark.results import Metric, Results


def metric_head(metric: Metric) -> str:
    """A metric with its unit, and which way is better."""
    arrow = "↓" if metric.lower_is_better else "↑"
    return escape(f"{metric.label} {metric.unit}".strip()) + f" {arrow}"


def subhead(text: str, columns: int) -> str:
    """The first row of a table's part."""
    head = f'<th class="metric corner" scope="rowgroup">{text}</th>'
    return f'<tr>{head}<td colspan="{columns}"></td></tr>'


def legend(results: Results, methods: Iterable[str]) -> str:
    """Methods with the samples of their lines."""
    entries = (f"<li>{svg.sample(style_of(results, m))}{escape(results.label(m))}</li>" for m in methods)
    return f'<ul class="legend">{"".join(entries)}</ul>'


def style_of(results: Results, method: str) -> int:
    """Number of the line of a method, the same in all charts."""
    return results.plan.methods.index(method)
