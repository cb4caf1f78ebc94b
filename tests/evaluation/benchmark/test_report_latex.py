"""The table in LaTeX: the numbers of the results, escaped, with as many cells in all rows."""

from __future__ import annotations

import dataclasses
import re

import pytest

from kalux.evaluation.benchmark.jobs import Failed, run_job
from kalux.evaluation.benchmark.report_latex import latex_table
from kalux.evaluation.benchmark.results import Results, make_plan
from kalux.evaluation.benchmark.sequences import Benchmark


@pytest.fixture(scope="module")
def results(lasting_set):
    sequences = (
        dataclasses.replace(lasting_set.with_truth, title="50 % & more_{x}", group="A^2"),
        dataclasses.replace(lasting_set.without, name="c", title="c~", group="A^2"),
        dataclasses.replace(lasting_set.without, title="alone \\ $"),
    )
    plan = make_plan(Benchmark("Title", sequences), ["hold", "mean", "cf"])
    failed = {("b", "cf"): Failed("no", is_bug=False)}
    records = {(job.sequence.name, job.method): run_job(job).record for job in plan.jobs}
    return Results(plan, {key: record for key, record in records.items() if key not in failed}, failed)


def rows(table, method):
    return [line.removesuffix(" \\\\").split(" & ") for line in table.splitlines() if line.startswith(method)]


def test_every_row_has_a_cell_for_every_column(results):
    table = latex_table(results)
    assert "\\begin{tabular}{lrrrr}\n\\toprule\n" in table
    groups, rules = table.splitlines()[3:5]
    assert (
        groups == " & \\multicolumn{3}{c}{A\\textasciicircum{}2} & \\multicolumn{1}{c}{Held-out frames} \\\\"
    )
    assert rules == "\\cmidrule(lr){2-4}\\cmidrule(lr){5-5}"
    for line in table.splitlines():
        if line.endswith("\\\\") and "multicolumn" not in line:
            assert len(re.findall(r"(?<!\\)&", line)) == 4, line
    assert table.endswith("\\bottomrule\n\\end{tabular}\n")


def test_titles_are_escaped(results):
    titles = r"method & 50 \% \& more\_\{x\} & c\textasciitilde{} & mean & alone \textbackslash{} \$ \\"
    assert titles in latex_table(results).splitlines()


def test_a_name_at_the_beginning_of_a_row_is_no_argument_of_the_row_before(results):
    """LaTeX takes ``[new]`` and ``*`` after a line's end for its own; ``<`` it prints as an exclamation mark."""
    (first, record), *_ = results.records.items()
    named = {**record, "method": {**record["method"], "label": "[new] < *old*"}}
    table = latex_table(dataclasses.replace(results, records={first: named}))
    assert rows(table, "{[}new] \\textless{} {*}old{*}")


def test_numbers_are_those_of_the_results_and_the_best_is_bold(results):
    table, (metric, *_) = latex_table(results), results.shown()
    assert "MSE $\\times$ 100 $\\downarrow$" in table
    assert "SSIM $\\uparrow$" in table
    a, c, b = results.plan.sequences
    hold, mean, cf = (rows(table, results.label(method))[0] for method in ("hold", "mean", "cf"))
    for cells, method in ((hold, "hold"), (mean, "mean"), (cf, "cf")):
        for cell, sequences in zip(cells[1:], ([a], [c], [a, c], [b]), strict=True):
            value = metric.shown(results.group_mean(sequences, method, metric.name)).replace("–", "--")
            bold = re.fullmatch(r"\\textbf\{(.*)\}", cell)
            assert (bold[1] if bold else cell) in (value, "failed")
    assert cf[4] == "failed"
    assert mean[1] == mean[3] == "--"
    for column in (1, 2, 3, 4):
        known = {row[column] for row in (hold, mean, cf)} - {"--", "failed"}
        best = min(known, key=lambda cell: float(cell.removeprefix("\\textbf{").removesuffix("}")))
        assert best.startswith("\\textbf{") == (len(known) > 1)
        assert sum(cell.startswith("\\textbf{") for cell in known) == (len(known) > 1)
