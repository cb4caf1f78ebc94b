"""Table 1 for a paper in LaTeX: a tabular of the package booktabs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import kalux
from kalux.evaluation.benchmark.results import Metric, Results
from kalux.evaluation.benchmark.sequences import Sequence

_ESCAPED: Final = str.maketrans(
    {
        **{character: f"\\{character}" for character in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "×": r"$\times$",
        "–": "--",
        # Without \usepackage[T1]{fontenc} these would be other characters.
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "[": "{[}",  # at the beginning of a row, this and the star would belong to the end of the one before
        "*": "{*}",
    }
)


class _Column(NamedTuple):
    """What a column shows: a sequence, or the mean over several."""

    group: str
    title: str
    sequences: list[Sequence]


def latex_table(results: Results) -> str:
    """The means of all metrics over images, as of the report's Table 1; the best of a column is bold.

    Lines of text, of which the first are comments that say what they need and what is shown.
    """
    columns = list(_columns(results))
    lines = [
        f"% kalux {kalux.__version__}: means over images, best of a column bold; needs \\usepackage{{booktabs}}",
        f"\\begin{{tabular}}{{l{'r' * len(columns)}}}",
        "\\toprule",
        *_group_lines(columns),
        _row(["method", *(_escaped(column.title) for column in columns)]),
    ]
    for metric in results.shown():
        arrow = "downarrow" if metric.lower_is_better else "uparrow"
        head = f"{_escaped(f'{metric.label} {metric.unit}'.strip())} $\\{arrow}$"
        lines += ["\\midrule", f"\\multicolumn{{{len(columns) + 1}}}{{l}}{{{head}}} \\\\"]
        shown = [_cells(results, metric, column) for column in columns]
        for method in results.plan.methods:
            lines.append(_row([_escaped(results.label(method)), *(cells[method] for cells in shown)]))
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def _columns(results: Results) -> Iterator[_Column]:
    for group, sequences in results.groups().items():
        yield from (_Column(group, sequence.title, [sequence]) for sequence in sequences)
        if len(sequences) > 1:
            yield _Column(group, "mean", sequences)


def _group_lines(columns: list[_Column]) -> list[str]:
    """The groups over their columns, with a rule under each."""
    heads, rules, first = [""], "", 2
    for group in dict.fromkeys(column.group for column in columns):
        count = sum(column.group == group for column in columns)
        heads.append(f"\\multicolumn{{{count}}}{{c}}{{{_escaped(group)}}}")
        rules += f"\\cmidrule(lr){{{first}-{first + count - 1}}}"
        first += count
    return [_row(heads), rules]


def _cells(results: Results, metric: Metric, column: _Column) -> dict[str, str]:
    """By method."""
    values = {m: results.group_mean(column.sequences, m, metric.name) for m in results.plan.methods}
    best = results.best(metric, values)
    cells = {}
    for method, value in values.items():
        failed = len(column.sequences) == 1 and (column.sequences[0].name, method) in results.failures
        text = "failed" if failed else _escaped(metric.shown(value))
        cells[method] = f"\\textbf{{{text}}}" if method in best else text
    return cells


def _row(cells: list[str]) -> str:
    return " & ".join(cells) + " \\\\"


def _escaped(text: str) -> str:
    return text.translate(_ESCAPED)
