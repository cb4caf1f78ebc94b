"""The camera models of the report: Figure 2 of the paper."""

from __future__ import annotations

import json
from html import escape
from typing import Any

from kalux.evaluation.benchmark import svg
from kalux.evaluation.benchmark.results import Results
from kalux.evaluation.benchmark.svg import Axis, Series


def camera_section(results: Results) -> str:
    """f^w and R_bar over the camera's response, of every camera model in use; empty where none is."""
    models: dict[str, tuple[dict[str, Any], set[str], set[str]]] = {}
    for sequence in results.plan.sequences:
        for method, record in results.of_sequence(sequence).items():
            if (camera := record["camera"]) is not None:
                _, methods, titles = models.setdefault(json.dumps(camera), (camera, set(), set()))
                methods.add(results.label(method))
                titles.add(sequence.title)
    if not models:
        return ""
    weights, covariances, legend = [], [], []
    for style, (camera, methods, titles) in enumerate(models.values()):
        levels = [255 * level for level in camera["response"]]
        weights.append(Series(camera["source"], style, list(zip(levels, camera["weight"], strict=True))))
        covariances.append(
            Series(camera["source"], style, list(zip(levels, camera["covariance"], strict=True)))
        )
        used = f"{'; '.join(sorted(methods))} on {'; '.join(sorted(titles))}"
        legend.append(
            f"<li>{svg.sample(style)}<span>{escape(camera['source'])}"
            f' <span class="soft">({escape(used)})</span></span></li>'
        )
    x = Axis("camera response, 8-bit levels", limits=(0.0, 255.0))
    first = svg.chart("Weighting function", x, Axis("weight fʷ", limits=(0.0, 1.05)), weights)
    second = svg.chart("Image covariance function", x, Axis("covariance R̄ / σᵢₘ²", log=True), covariances)
    return (
        '<section id="camera"><h2>The camera model in use (Figure 2 of the paper)</h2>'
        f'<ul class="legend">{"".join(legend)}</ul>'
        f'<div class="charts"><figure>{first}<figcaption>(a) Weighting function, equation (5). Where kalux’s default '
        "takes a pixel as clipped it has no weight.</figcaption></figure>"
        f"<figure>{second}<figcaption>(b) Covariance of the frame’s noise, equation (6); it ends where a pixel counts "
        "as clipped, or is capped by the paper’s floor of "
        "f<sup>w</sup>.</figcaption></figure></div></section>"
    )
