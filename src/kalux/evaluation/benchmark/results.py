"""From sequences and methods to jobs, and from their outcomes to tables: `results.csv`, `results.json`."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

import kalux
from kalux.errors import InputError, KaluxError
from kalux.evaluation.benchmark.jobs import (
    GROUPS,
    Failed,
    Job,
    make_job,
    truth_lies_between,
    uses_held_out,
)
from kalux.evaluation.benchmark.sequences import Benchmark, Sequence
from kalux.evaluation.scores import METRICS, UNCERTAINTY
from kalux.evaluation.specs import check_distinct, chosen_methods, relocated

DEFAULT_METHODS: Final = ("hold", "mean", "edi", "cf", "iccv2021", "default", "smooth")
"""Two that use frames only, two that use events as well, the paper, and kalux."""


class Metric(NamedTuple):
    """How a metric is shown.

    Attributes
    ----------
    name
        As in `kalux.evaluation.scores.METRICS`.
    label, unit
        For tables.
    factor
        Shown is the value times this.
    digits
        After the point.
    lower_is_better
        Whether it is an error.
    """

    name: str
    label: str
    unit: str
    factor: float
    digits: int
    lower_is_better: bool

    def shown(self, value: float | None) -> str:
        """The value in a table."""
        return "–" if value is None else f"{self.factor * value:.{self.digits}f}"


SHOWN: Final = (
    Metric("mse", "MSE", "× 100", 100.0, 3, True),
    Metric("ssim", "SSIM", "", 1.0, 3, False),
    Metric("log_mse", "log-MSE", "× 100", 100.0, 2, True),
    Metric("q", "HDR-VDP Q", "", 1.0, 2, False),
    Metric("lpips", "LPIPS", "", 1.0, 3, True),
)
OPTIONAL: Final = ("q", "lpips")
"""Metrics that are computed only if they are asked for."""

PSNR: Final = Metric("psnr", "PSNR", "dB", 1.0, 2, False)


@dataclass(frozen=True)
class Plan:
    """All jobs of a benchmark.

    Attributes
    ----------
    title
        Of the report.
    sequences, methods
        Columns and rows.
    jobs
        Those that can be tried.
    failures
        (sequence, method) names of those that cannot, and why.
    """

    title: str
    sequences: tuple[Sequence, ...]
    methods: tuple[str, ...]
    jobs: tuple[Job, ...]
    failures: dict[tuple[str, str], Failed]


def make_plan(
    benchmark: Benchmark,
    methods: Iterable[str] | None = None,
    *,
    hdr_vdp: bool = False,
    lpips: tuple[Path, ...] = (),
) -> Plan:
    """The jobs of a benchmark: every method on every sequence where it is a fair comparison.

    Parameters
    ----------
    benchmark
        From `kalux.evaluation.benchmark.sequences.gather`.
    methods
        Names; they win over those of the benchmark. Default: `DEFAULT_METHODS`. In the name of a file or folder
        ``{sequence}`` stands for that of the sequence.
    hdr_vdp
        Whether Q is computed.
    lpips
        Files of weights, as of `kalux.evaluation.lpips.load_lpips`; empty: LPIPS is not computed.

    Raises
    ------
    InputError
        If there is no such method, none is named, or two cannot be told apart.
    """
    chosen = benchmark.methods if methods is None else tuple(methods)
    if chosen is not None and not chosen:
        raise InputError("benchmark: no method is given; name some, or leave the list out")
    folder = (benchmark.folder if methods is None else Path()).absolute()
    names = tuple(dict.fromkeys(DEFAULT_METHODS if chosen is None else chosen))
    check_distinct(names)
    fair_only_between = {
        name
        for name in names
        if "{sequence}" not in name
        and chosen_methods([relocated(name, folder)], held_out=True)[0].needs_held_out
    }
    jobs: list[Job] = []
    failures: dict[tuple[str, str], Failed] = {}
    for sequence in benchmark.sequences:
        try:
            held_out = uses_held_out(sequence)
            between = not held_out and bool(fair_only_between) and truth_lies_between(sequence)
            wanted = [name for name in names if held_out or between or name not in fair_only_between]
        except KaluxError as error:
            failures.update({(sequence.name, name): _failed(error) for name in names})
            continue
        for name in wanted:
            try:
                jobs.append(
                    make_job(
                        sequence,
                        name,
                        held_out=held_out,
                        hdr_vdp=hdr_vdp,
                        folder=folder,
                        lpips=lpips,
                        between=between,
                    )
                )
            except KaluxError as error:
                failures[sequence.name, name] = _failed(error)
    return Plan(benchmark.title, benchmark.sequences, names, tuple(jobs), failures)


def _failed(error: KaluxError) -> Failed:
    return Failed(" ".join(str(error).split()), is_bug=False)


@dataclass(frozen=True)
class Results:
    """What a benchmark found.

    Attributes
    ----------
    plan
        What was to be done.
    records
        By (sequence, method) names, what a job found; docs/benchmark.md lists its keys.
    failures
        By the same, why there is nothing.
    """

    plan: Plan
    records: dict[tuple[str, str], dict[str, Any]]
    failures: dict[tuple[str, str], Failed]

    def label(self, method: str) -> str:
        """A method's label."""
        found = (record["method"]["label"] for (_, name), record in self.records.items() if name == method)
        return str(next(found, method))

    def of_sequence(self, sequence: Sequence) -> dict[str, dict[str, Any]]:
        """The records of a sequence by method, in the order of the methods."""
        found = ((name, self.records.get((sequence.name, name))) for name in self.plan.methods)
        return {name: record for name, record in found if record is not None}

    def mean(self, sequence: Sequence, method: str, metric: str) -> float | None:
        """A mean score over the images of a sequence."""
        record = self.records.get((sequence.name, method))
        return None if record is None else record["scores"]["means"].get(metric)

    def group_mean(self, sequences: Iterable[Sequence], method: str, metric: str) -> float | None:
        """The mean over sequences; None unless all have it."""
        values = [self.mean(sequence, method, metric) for sequence in sequences]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known and len(known) == len(values) else None

    def groups(self) -> dict[str, list[Sequence]]:
        """The sequences by group, in order of appearance."""
        found: dict[str, list[Sequence]] = {}
        for sequence in self.plan.sequences:
            found.setdefault(self._group(sequence), []).append(sequence)
        return found

    def shown(self) -> list[Metric]:
        """The metrics that were computed."""
        means = [record["scores"]["means"] for record in self.records.values()]
        asked = {name for name in OPTIONAL if any(mean.get(name) is not None for mean in means)}
        return [metric for metric in SHOWN if metric.name not in OPTIONAL or metric.name in asked]

    def best(self, metric: Metric, values: dict[str, float | None]) -> set[str]:
        """The methods whose value is best, to the digits that are shown; none if there is but one."""
        known = {name: round(v * metric.factor, metric.digits) for name, v in values.items() if v is not None}
        if len(known) < 2:
            return set()
        best = min(known.values()) if metric.lower_is_better else max(known.values())
        return {name for name, value in known.items() if value == best}

    def _group(self, sequence: Sequence) -> str:
        records = self.of_sequence(sequence).values()
        return next((str(r["sequence"]["group"]) for r in records), sequence.group or GROUPS[True])


def as_csv(results: Results) -> str:
    """Tidy: a row per sequence, method and metric; ``psnr`` of equal images is empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("sequence", "method", "metric", "value"))
    table.writerows(_rows(results))
    return text.getvalue()


def _rows(results: Results) -> Iterator[tuple[str, str, str, float | str]]:
    for job in results.plan.jobs:
        record = results.records.get((job.sequence.name, job.method))
        if record is None:
            continue
        means = record["scores"]["means"]
        values = {name: means[name] for name in METRICS if name not in OPTIONAL or means[name] is not None}
        calibration = record["calibration"]
        if calibration is not None:
            values |= {name: calibration["all"][name] for name in UNCERTAINTY}
        values["seconds"] = record["seconds"]["images"]
        for name, value in values.items():
            yield job.sequence.name, job.method, name, "" if value is None else value


def as_json(results: Results) -> str:
    """The records of all jobs, and the failures."""
    failures = [
        {"sequence": sequence, "method": method, "error": failed.message}
        for (sequence, method), failed in results.failures.items()
    ]
    jobs = [r for job in results.plan.jobs if (r := results.records.get((job.sequence.name, job.method)))]
    whole = {
        "kalux": kalux.__version__,
        "title": results.plan.title,
        "sequences": [sequence.name for sequence in results.plan.sequences],
        "methods": list(results.plan.methods),
        "jobs": jobs,
        "failures": failures,
    }
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"
