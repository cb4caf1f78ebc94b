"""Results: which jobs, means, the best, tidy tables."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

import numpy as np
import pytest

import kalux
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.errors import InputError
from kalux.evaluation.benchmark.jobs import Failed, Finished, run_job
from kalux.evaluation.benchmark.results import PSNR, SHOWN, Results, as_csv, as_json, make_plan
from kalux.evaluation.benchmark.sequences import Benchmark
from kalux.writers import hdf5


def planned(small_set, methods=None, sequences=None):
    benchmark = Benchmark("Title", sequences or (small_set.with_truth, small_set.without))
    return make_plan(benchmark, methods)


@pytest.fixture(scope="module")
def results(lasting_set):
    plan = planned(lasting_set, ["hold", "mean", "default"])
    records = {(job.sequence.name, job.method): run_job(job).record for job in plan.jobs}
    return Results(plan, records, {})


def test_the_neighbours_are_compared_only_where_frames_are_held_out(small_set):
    plan = planned(small_set)
    assert plan.methods == ("hold", "mean", "edi", "cf", "iccv2021", "default", "smooth")
    assert [job.method for job in plan.jobs if job.sequence.name == "a"] == [
        name for name in plan.methods if name != "mean"
    ]
    assert [job.held_out for job in plan.jobs] == [False] * 6 + [True] * 7
    assert "mean" in [job.method for job in plan.jobs if job.sequence.name == "b"]


def test_the_neighbours_are_compared_with_truth_between_frames(small_set):
    """That of a recording of artificial HDR whose held-out frames are the truth, as a file."""
    made = artificial_hdr(kalux.open(small_set.without.path), ArtificialCamera.with_cut(30), every=2)
    hdf5.write(
        small_set.without.path,
        sensor_size=made.sensor_size,
        events=list(made.events()),
        frames=list(made.frames()),
        ground_truth=made.ground_truth(),
        response=made.response,
    )
    plan = planned(small_set, ["hold", "mean"])
    assert [(job.name, job.held_out) for job in plan.jobs] == [
        ("a/hold", False),
        ("b/hold", False),
        ("b/mean", False),
    ]
    assert isinstance(run_job(plan.jobs[-1]), Finished)
    assert isinstance(run_job(dataclasses.replace(plan.jobs[-1], between=False)), Failed)


def test_truth_that_is_not_compared_may_lie_in_frames(small_set):
    """Masked altogether, or before the middle of the first exposure, where `kalux evaluate` leaves it out, too."""
    first, second = list(kalux.open(small_set.with_truth.path).frames())[:2]
    times = [first.exposure_start + 1, (first.exposure_end + second.exposure_start) // 2, second.middle]
    images = np.full((3, *first.image.shape), 0.5, np.float32)
    file, compared = small_set.folder / "a_gt.npz", np.array([True, True, False])
    mask = np.broadcast_to(compared[:, None, None], images.shape)
    np.savez(file, times_us=times, gt=images, mask=mask)
    assert "a/mean" in [job.name for job in planned(small_set).jobs]
    np.savez(file, times_us=times, gt=images)
    assert "a/mean" not in [job.name for job in planned(small_set).jobs]


def test_a_sequence_that_cannot_be_opened_fails_alone(small_set):
    small_set.without.path.write_bytes(b"no recording")
    plan = planned(small_set, ["hold", "cf"])
    assert [job.name for job in plan.jobs] == ["a/hold", "a/cf"]
    assert set(plan.failures) == {("b", "hold"), ("b", "cf")}
    assert "not a recording" in plan.failures["b", "hold"].message


def test_images_that_are_missing_for_one_sequence_fail_alone(small_set, monkeypatch):
    folder = small_set.folder / "results" / "a"
    folder.mkdir(parents=True)
    (folder / "timestamps.csv").write_text("t_us,file\n0,0.npy\n")
    np.save(folder / "0.npy", np.zeros((32, 40), np.float32))
    monkeypatch.chdir(small_set.folder)
    plan = planned(small_set, ["hold", "theirs=results/{sequence}"])
    assert [job.name for job in plan.jobs] == ["a/hold", "a/theirs=results/{sequence}", "b/hold"]
    assert list(plan.failures) == [("b", "theirs=results/{sequence}")]


def test_an_unknown_method_is_refused_at_once(small_set):
    with pytest.raises(InputError, match="no method 'e3vid'"):
        planned(small_set, ["hold", "e3vid"])


def test_methods_given_win_over_those_of_the_file_and_none_is_run_twice(small_set):
    benchmark = Benchmark("", (small_set.without,), ("cf",))
    assert make_plan(benchmark).methods == ("cf",)
    assert make_plan(benchmark, ["hold", "mean", "hold"]).methods == ("hold", "mean")


def test_a_list_of_no_methods_is_not_all_of_them(small_set):
    with pytest.raises(InputError, match="no method is given"):
        planned(small_set, [])


def test_two_folders_of_one_name_are_refused(small_set):
    with pytest.raises(InputError, match=r"'a=y/\{sequence\}': 'a=x/\{sequence\}' is there already"):
        planned(small_set, ["a=x/{sequence}", "a=y/{sequence}"])


def test_csv_is_tidy_and_holds_the_means(results):
    rows = list(csv.DictReader(io.StringIO(as_csv(results))))
    values = {(r["sequence"], r["method"], r["metric"]): r["value"] for r in rows}
    assert len(values) == len(rows)
    for key, record in results.records.items():
        assert float(values[*key, "mse"]) == record["scores"]["means"]["mse"]
        assert ((*key, "rms_z") in values) == (key[1] == "default")
        assert (*key, "q") not in values
    assert {metric for *_, metric in values} == {
        *("mse", "psnr", "ssim", "log_mse", "one_sigma", "rms_z", "median_z", "seconds")
    }


def test_json_holds_the_records_and_is_valid(results):
    whole = json.loads(as_json(results), parse_constant=pytest.fail)
    assert [job["method"]["name"] for job in whole["jobs"]] == ["hold", "default", "hold", "mean", "default"]
    assert whole["jobs"][0] == results.records["a", "hold"]
    assert whole["sequences"] == ["a", "b"]


def test_means_of_groups_need_all_sequences(results, lasting_set):
    both = [lasting_set.with_truth, lasting_set.without]
    values = [results.mean(sequence, "hold", "mse") for sequence in both]
    assert results.group_mean(both, "hold", "mse") == pytest.approx(sum(values) / 2)
    assert results.group_mean(both, "mean", "mse") is None
    assert [[s.name for s in group] for group in results.groups().values()] == [["a"], ["b"]]


def test_the_best_is_by_what_is_shown():
    error, similarity = SHOWN[0], SHOWN[1]
    best = Results.best
    assert best(None, error, {"a": 0.0100001, "b": 0.01, "c": 0.02, "d": None}) == {"a", "b"}
    assert best(None, similarity, {"a": 0.9, "b": 0.95}) == {"b"}
    assert best(None, error, {"a": 0.1, "b": None}) == set()
    assert (error.shown(0.0123456), error.shown(None), PSNR.shown(30.123)) == ("1.235", "–", "30.12")
