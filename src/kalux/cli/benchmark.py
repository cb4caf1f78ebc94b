"""``kalux benchmark``: many sequences by many methods, one table and one report."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.metrics import add_metrics, lpips_files, lpips_weights, named_methods
from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.recordings import add_exposure, check_stamp
from kalux.cli.terminal import error_line, say

if TYPE_CHECKING:
    from kalux.evaluation.benchmark.jobs import Job, Outcome
    from kalux.evaluation.benchmark.results import Plan, Results
    from kalux.evaluation.benchmark.runners import Outcomes
    from kalux.evaluation.benchmark.store import Store

_DESCRIPTION = """\
Compare methods on many recordings: each with its ground truth or, where it has none, with frames held out.
Writes results.csv, results.json, results.tex and report.html to the folder OUT. Run again after an interrupt
or an error, the same command does only what is missing. Needs the extra kalux[evaluation].

SET is a recording, a folder with recordings, or a TOML file that lists sequences (docs/benchmark.md).
methods: as of kalux evaluate; without --methods hold, mean (where images lie between frames), edi, cf,
iccv2021, default, smooth. In the name of a file or folder {sequence} stands for the name of the sequence."""

_EXAMPLES = """\
examples:
  kalux benchmark recordings/ -o results
  kalux benchmark pan.mat night_drive.aedat4 --methods hold,cf,default --hdrvdp -o results
  kalux benchmark paper.toml --hdrvdp --processes 8 -o results
  kalux benchmark paper.toml --dask tcp://10.0.0.5:8786 -o results

a TOML file:
  title = "My sequences"
  [[sequence]]
  path = "slider_depth"                # relative to the file
  exposure = 10000                     # us; also: name, title, group, stamp, white, response, calibration
  [[sequence]]
  path = "pan.mat"
  truth = "pan_hdr.npz"                # or hold_out_frames = 2, or ahdr = {low = 10, high = 90}"""

CSV, JSON, LATEX, REPORT = "results.csv", "results.json", "results.tex", "report.html"
_LISTED: Final = 6


def add_command(commands: Any) -> None:
    """Add ``benchmark`` to the parser."""
    parser: Parser = commands.add_parser(
        "benchmark",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux benchmark SET... -o OUT [flags]",
    )
    group = parser.add_argument_group("sequences")
    group.add_argument("sets", nargs="+", metavar="SET", help="recordings, folders of them, TOML files")
    add_exposure(group)
    group.add_argument(
        "--white", type=number, metavar="LEVEL", help="value of a saturated pixel, if not stored"
    )
    group.add_argument(
        "--response",
        default="auto",
        help="of the cameras: linear, srgb, gamma:EXPONENT (default: what the recording states, else linear)",
    )
    group.add_argument(
        "--hold-out-frames",
        type=whole,
        metavar="N",
        help="hold out every N-th frame even where there is truth",
    )
    group = parser.add_argument_group("what is computed")
    add_metrics(group)
    group = parser.add_argument_group("where")
    one = group.add_mutually_exclusive_group()
    one.add_argument(
        "--processes", type=whole, metavar="N", help="of this machine (default: as many as it has cores)"
    )
    one.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster whose workers see the recordings"
    )
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="folder")
    group.add_argument("--overwrite", action="store_true", help="run all again, also what is done")
    group.add_argument("--quiet", action="store_true", help="no progress")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.evaluation.benchmark import store as stores
    from kalux.evaluation.benchmark.results import Results, make_plan
    from kalux.evaluation.benchmark.sequences import Options, gather
    from kalux.evaluation.scores import require_dependencies

    check_stamp(options)
    if options.processes is not None and options.processes < 1:
        raise UsageError(f"--processes {options.processes}: at least 1 is needed")
    require_dependencies()
    common = Options(
        exposure=options.exposure,
        stamp=options.stamp or "start",
        white=options.white,
        response=options.response,
        hold_out_frames=options.hold_out_frames,
    )
    lpips_weights(options)  # what is wrong with them is told before the work
    names = named_methods(options)
    plan = make_plan(
        gather(options.sets, common, methods_of_files=names is None),
        names,
        hdr_vdp=options.hdrvdp,
        lpips=lpips_files(options),
    )
    _check_apart(options.out, plan)
    stores.prepare(options.out)
    store = stores.Store(options.out)
    records = (
        {} if options.overwrite else {job: r for job in plan.jobs if (r := store.record(job)) is not None}
    )
    missing = [job for job in plan.jobs if job not in records]
    if records and not options.quiet:
        error_line(f"{len(records)} of {len(plan.jobs)} jobs are done already, in {options.out}")
    if not (options.overwrite or options.quiet):
        _tell_of_others(store, missing, options.out)
    failed = _work(plan, store, missing, options)
    done = {
        job: record for job in plan.jobs if (record := store.record(job)) is not None and job not in failed
    }
    results = Results(
        plan,
        {(job.sequence.name, job.method): record for job, record in done.items()},
        {**plan.failures, **{(job.sequence.name, job.method): outcome for job, outcome in failed.items()}},
    )
    _write(options.out, results, store)
    for line in table(results):
        say(line)
    say("wrote " + ", ".join(str(options.out / name) for name in (CSV, JSON, LATEX, REPORT)))
    _raise_failures(results, options.out)


def _check_apart(out: Path, plan: Plan) -> None:
    """Refuse to write into a folder that is read: what jobs depend on would change with every run."""
    from kalux.cli.output import lies_in
    from kalux.evaluation.benchmark.jobs import method_text
    from kalux.evaluation.specs import spec_path

    methods = (spec_path(method_text(job.method, job.sequence.name, job.folder)) for job in plan.jobs)
    for place in (*(sequence.path for sequence in plan.sequences), *methods):
        if place is not None and place.is_dir() and lies_in(out, place):
            raise UsageError(f"{out}: lies in {place}, an input; choose another place for the output")


def _tell_of_others(store: Store, missing: list[Job], out: Path) -> None:
    """Say how many jobs another kalux has done, which are not mixed with those of this one."""
    from kalux.wording import how_many

    others = [version for job in missing if (version := store.other_kalux(job)) is not None]
    if others:
        versions = ", ".join(sorted({*others}))
        error_line(
            f"{how_many(len(others), 'job')} in {out} {'was' if len(others) == 1 else 'were'} done by another version "
            f"or other code of kalux ({versions}), and {'is' if len(others) == 1 else 'are'} done again"
        )


def _work(plan: Plan, store: Store, jobs: list[Job], options: argparse.Namespace) -> dict[Job, Any]:
    """Run jobs and keep what they find; returns the failures."""
    from kalux.cli.progress import Progress
    from kalux.evaluation.benchmark.jobs import Failed

    failed: dict[Job, Failed] = {}
    left = dict.fromkeys(jobs)
    if not jobs:
        return failed
    # Elsewhere than on a terminal, the line of every job is enough.
    no_bar = options.quiet or not sys.stderr.isatty()
    try:
        with (
            Progress("benchmark", images=len(jobs), quiet=no_bar, unit="jobs") as progress,
            contextlib.closing(_outcomes(jobs, options)) as outcomes,
        ):
            for job, outcome in outcomes:
                if isinstance(outcome, Failed):
                    failed[job] = outcome
                else:
                    store.save(job, outcome)
                del left[job]
                progress.add(images=1)
                if not options.quiet:
                    _print_outcome(len(jobs) - len(left), len(jobs), progress.seconds, job, outcome)
    except KeyboardInterrupt as interrupt:
        interrupt.add_note(_interrupted(plan, list(left), options.out))
        raise
    return failed


def _outcomes(jobs: list[Job], options: argparse.Namespace) -> Outcomes:
    from kalux.evaluation.benchmark import runners
    from kalux.threads import cores

    if options.dask is not None:
        return runners.on_dask(jobs, options.dask)
    return runners.in_processes(jobs, options.processes or cores())


def _print_outcome(number: int, total: int, seconds: float, job: Job, outcome: Outcome) -> None:
    from kalux.cli.progress import clock
    from kalux.evaluation.benchmark.jobs import Failed

    found = "failed" if isinstance(outcome, Failed) else f"{outcome.record['seconds']['all']:.1f} s"
    rest = f", {clock(seconds / number * (total - number))} left" if number < total else ""
    why = f": {outcome.message}" if isinstance(outcome, Failed) else ""
    with contextlib.suppress(OSError):
        print(f"kalux: {number}/{total} {job.name}: {found}{rest}{why}", file=sys.stderr, flush=True)


def _interrupted(plan: Plan, left: list[Job], out: Path) -> str:
    done = len(plan.jobs) - len(left)
    return (
        f"{done} of {len(plan.jobs)} jobs are finished and kept in {out}; missing: "
        f"{_some(job.name for job in left)}; the same command goes on from here"
    )


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    more = len(listed) - _LISTED
    return ", ".join(listed[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def _write(out: Path, results: Results, store: Store) -> None:
    from kalux.evaluation.benchmark.report import make_report
    from kalux.evaluation.benchmark.report_latex import latex_table
    from kalux.evaluation.benchmark.results import as_csv, as_json
    from kalux.writers.files import save

    for name, text in (
        (CSV, as_csv(results)),
        (JSON, as_json(results)),
        (LATEX, latex_table(results)),
        (REPORT, make_report(results, store)),
    ):
        save(out / name, text)


def _raise_failures(results: Results, out: Path) -> None:
    """Raise what failed, if anything did, as one line."""
    from kalux.errors import InputError, InternalError

    if not results.failures:
        return
    total = len(results.plan.jobs) + len(results.plan.failures)
    first = next(iter(results.failures.items()))
    others = f"the others are in {out}, " if len(results.failures) < total else ""
    text = (
        f"{len(results.failures)} of {total} jobs failed: {_some('/'.join(n) for n in results.failures)}; {others}"
        f"the same command tries again. {'/'.join(first[0])}: {first[1].message}"
    )
    raise (InternalError if any(f.is_bug for f in results.failures.values()) else InputError)(text)


def table(results: Results) -> list[str]:
    """A row per sequence and method, as of ``kalux evaluate``."""
    from kalux.evaluation.benchmark.results import PSNR

    metrics = [*results.shown(), PSNR]
    wide = max([len(s.name) for s in results.plan.sequences] + [8])
    heads = [f"{m.label} {m.unit}".replace("×", "x").replace("x ", "x").strip() for m in metrics]
    lines = [f"{'sequence':<{wide}}  {'method':<24}" + "".join(f"{head:>15}" for head in heads)]
    for sequence in results.plan.sequences:
        for name in results.of_sequence(sequence):
            values = (metric.shown(results.mean(sequence, name, metric.name)) for metric in metrics)
            lines.append(
                f"{sequence.name:<{wide}}  {results.label(name):<24}"
                + "".join(f"{value:>15}" for value in values)
            )
    return lines
