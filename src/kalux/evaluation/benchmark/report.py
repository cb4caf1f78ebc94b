"""The report: one self-contained HTML page with tables, curves, pictures and the calibration of the uncertainty."""

from __future__ import annotations

import json
from html import escape

import kalux
from kalux.evaluation.benchmark import page
from kalux.evaluation.benchmark.report_camera import camera_section
from kalux.evaluation.benchmark.report_sequence import sequence_section
from kalux.evaluation.benchmark.report_table import table_1
from kalux.evaluation.benchmark.report_uncertainty import calibration_section
from kalux.evaluation.benchmark.results import Results
from kalux.evaluation.benchmark.store import Store
from kalux.wording import how_many


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
        table_1(results),
        _failures(results),
        calibration_section(results),
        camera_section(results),
        *(sequence_section(results, store, sequence) for sequence in shown),
        _made(results),
        f"</main><script>{page.SCRIPT}</script></body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _images(results: Results) -> int:
    return sum(
        max((len(r["scores"]["per_image"]) for r in results.of_sequence(s).values()), default=0)
        for s in results.plan.sequences
    )


def _failures(results: Results) -> str:
    if not results.failures:
        return ""
    rows = "".join(
        f"<li><code>{escape('/'.join(name))}</code>: {escape(failed.message)}</li>"
        for name, failed in results.failures.items()
    )
    return f"<section><h3>Failed</h3><ul>{rows}</ul></section>"


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
