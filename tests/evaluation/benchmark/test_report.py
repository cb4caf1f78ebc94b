"""The report: self-contained, well-formed, with the numbers of the results and the failures."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from kalux.evaluation.benchmark.jobs import Failed, run_job
from kalux.evaluation.benchmark.report import make_report
from kalux.evaluation.benchmark.results import Results, make_plan
from kalux.evaluation.benchmark.sequences import Benchmark
from kalux.evaluation.benchmark.store import Store

_VOID = {"meta", "img", "input", "br", "link"}
_SHAPES = {"path", "line"}


class Page(HTMLParser):
    """Checks that tags are closed in order, and collects what matters."""

    def __init__(self, text):
        super().__init__()
        self.open, self.sources, self.links, self.ids, self.cells, self.text = [], [], [], [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.sources += [values[name] for name in ("src", "srcset", "data", "poster") if name in values]
        self.links += [values["href"]] if "href" in values else []
        self.ids += [values["id"]] if "id" in values else []
        assert tag not in ("link", "iframe", "object")
        if tag == "img" and "src" in values:
            assert values["alt"]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "td":
            self.cells.append(data)
        if "script" not in self.open and "style" not in self.open:
            self.text += data


@pytest.fixture(scope="module")
def results(lasting_set, tmp_path_factory):
    plan = make_plan(
        Benchmark("A <title>", (lasting_set.with_truth, lasting_set.without)),
        ["hold", "mean", "cf", "default"],
        hdr_vdp=True,
    )
    store = Store(tmp_path_factory.mktemp("out"))
    for job in plan.jobs:
        store.save(job, run_job(job))
    return Results(plan, {(j.sequence.name, j.method): store.record(j) for j in plan.jobs}, {}), store


def test_the_page_asks_for_nothing_and_its_links_lead_somewhere(results):
    text = make_report(*results)
    page = Page(text)
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert not re.search(r"https?:|url\(|@import|fetch\(|XMLHttp", text)
    assert "A &lt;title&gt;" in text


def test_the_tables_hold_the_numbers(results):
    found, store = results
    page = Page(make_report(found, store))
    for record in found.records.values():
        means = record["scores"]["means"]
        assert f"{100 * means['mse']:.3f}" in page.cells
        assert f"{means['q']:.2f}" in page.cells
        if record["calibration"]:
            assert f"{record['calibration']['all']['rms_z']:.2f}" in page.cells
    assert "–" in page.cells  # the mean of the neighbours has no ground truth


def test_every_method_is_in_every_picture_of_its_sequence(results):
    found, store = results
    text = make_report(found, store)
    for sequence, methods in (("a", 3), ("b", 4)):
        part = text.split(f'<section id="s-{sequence}"')[1].split("</section>")[0]
        assert part.count('data-name="') == 3 * (methods + 2)  # at three times, with frame and reference
        assert part.count(", error") == 3 * methods
        assert part.count('uncertainty σ"') == 3
        assert part.count("<option") == 2 * (methods + 2)


def test_failures_are_told(results):
    found, store = results
    records = {name: record for name, record in found.records.items() if name != ("b", "cf")}
    failed = Results(found.plan, records, {("b", "cf"): Failed("no <luck>", is_bug=False)})
    page = Page(make_report(failed, store))
    assert "failed" in page.cells
    assert "no <luck>" in page.text


def test_the_page_is_made_even_if_all_failed(results):
    found, store = results
    nothing = Results(found.plan, {}, {("b", "cf"): Failed("gone", is_bug=False)})
    assert "gone" in Page(make_report(nothing, store)).text
