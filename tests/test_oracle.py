"""The engine against the slow oracle (`naive`), over random streams."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import PRESETS, Frame, Reconstructor
from kalux.events import make_events

import naive

HEIGHT, WIDTH = 2, 3
LAST_BIT = 2 * np.finfo(np.float32).eps

VARIANTS = {
    "default": PRESETS["default"],
    "default-blurred": dataclasses.replace(
        PRESETS["default"], filter=dataclasses.replace(PRESETS["default"].filter, deblur=False)
    ),
    "default-black": dataclasses.replace(
        PRESETS["default"], camera=dataclasses.replace(PRESETS["default"].camera, response="s-curve:0.1")
    ),
    "default-refractory": dataclasses.replace(
        PRESETS["default"], events=dataclasses.replace(PRESETS["default"].events, refractory_period=2_000)
    ),
    "default-refractory-doubted": dataclasses.replace(
        PRESETS["default"],
        events=dataclasses.replace(PRESETS["default"].events, refractory_period=2_000, refractory_spread=0.3),
    ),
    "default-background": dataclasses.replace(
        PRESETS["default"], events=dataclasses.replace(PRESETS["default"].events, noise_rate=5.0)
    ),
    "default-quiet": dataclasses.replace(
        PRESETS["default"], camera=dataclasses.replace(PRESETS["default"].camera, frame_noise=0.0019)
    ),
    "default-no-slope": dataclasses.replace(
        PRESETS["default"], events=dataclasses.replace(PRESETS["default"].events, quantisation_variance=0.0)
    ),
    "default-noisy": dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(PRESETS["default"].camera, frame_noise=0.01, shot_noise=5e-4),
    ),
    "default-night": dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(
            PRESETS["default"].camera, frame_noise=0.03, shot_noise=1e-3, log_offset=0.003
        ),
    ),
    "default-dark": dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(
            PRESETS["default"].camera, frame_noise=0.02, shot_noise=5e-4, log_offset=0.004
        ),
        filter=dataclasses.replace(
            PRESETS["default"].filter, dark_shares="0.3 0.05 0 0.01 0.1 0.1 0 0.2 0.3 0.1"
        ),
    ),
    "default-gamma": dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(PRESETS["default"].camera, response="gamma:2.2", frame_noise=0.002),
    ),
    "default-rolling": dataclasses.replace(
        PRESETS["default"], camera=dataclasses.replace(PRESETS["default"].camera, row_time=810.0)
    ),
    "default-rolling-up": dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(PRESETS["default"].camera, row_time=-810.0),
        events=dataclasses.replace(PRESETS["default"].events, refractory_period=2_000),
    ),
    "default-slow": dataclasses.replace(
        PRESETS["default"], events=dataclasses.replace(PRESETS["default"].events, lag_variance=2.5)
    ),
    "default-slow-steps": dataclasses.replace(
        PRESETS["default"],
        events=dataclasses.replace(
            PRESETS["default"].events, noise_rate=2.0, dark_steps="0.1 0.3 1.5 1.2 2 2.5"
        ),
    ),
    "default-trusted": dataclasses.replace(
        PRESETS["default"],
        events=dataclasses.replace(PRESETS["default"].events, extrapolation_trust=0.7),
        filter=dataclasses.replace(PRESETS["default"].filter, unshown_scale=0.4),
    ),
    "iccv2021": PRESETS["iccv2021"],
    "iccv2021-exact": dataclasses.replace(
        PRESETS["iccv2021"], filter=dataclasses.replace(PRESETS["iccv2021"].filter, solution="exact")
    ),
    "cf": PRESETS["cf"],
}


@st.composite
def streams(draw):
    """A few frames with uneven exposures and gaps, and events that also fall on edges and on each other."""
    count = draw(st.integers(1, 4))
    t, frames = draw(st.integers(0, 10**6)), []
    for _ in range(count):
        exposure = draw(st.integers(1000, 30_000))
        levels = draw(
            st.lists(
                st.one_of(st.just(0), st.just(255), st.integers(0, 255)),
                min_size=HEIGHT * WIDTH,
                max_size=HEIGHT * WIDTH,
            )
        )
        frames.append(Frame(np.array(levels, np.uint8).reshape(HEIGHT, WIDTH), t, t + exposure))
        t += exposure + draw(st.integers(0, 40_000))
    begin, end = frames[0].exposure_start - 1000, frames[-1].exposure_end + 20_000
    edges = [edge for f in frames for edge in (f.exposure_start, f.middle, f.exposure_end)]
    bursts = st.integers(edges[1], edges[1] + 12_000)
    moments = st.one_of(st.integers(begin, end), bursts, st.sampled_from(edges))
    events = draw(
        st.lists(
            st.tuples(moments, st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), st.booleans()),
            max_size=30,
        )
    )
    events.sort(key=lambda event: event[0])
    columns = list(zip(*events, strict=True)) if events else [(), (), (), ()]
    array = make_events(*(np.array(column, np.int64) for column in columns))
    times = sorted(draw(st.lists(st.integers(frames[0].middle, end), min_size=1, max_size=6)))
    return array, frames, times


@pytest.mark.parametrize("name", VARIANTS)
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_engine_agrees_with_the_oracle(name, data):
    """Log intensity to 1e-4 and 5e-5 of itself, variance to 2e-4 of itself."""
    assert_agrees(name, *data.draw(streams()))


@st.composite
def streams_with_losses(draw):
    """Three or four frames, and many events, of which those of about half of a frame interval are missing."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    begin, every = draw(st.integers(0, 10**6)), draw(st.integers(12_000, 40_000))
    count = draw(st.integers(3, 4))
    frames = [
        Frame(
            rng.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8),
            start,
            start + draw(st.integers(1000, 9000)),
        )
        for start in range(begin, begin + count * every, every)
    ]
    t = np.sort(rng.integers(begin - 500, begin + count * every, 350 * count))
    lost = frames[draw(st.integers(0, count - 2))].middle + round(draw(st.floats(0.0, 0.3)) * every)
    t = t[(t < lost) | (t > lost + draw(st.floats(0.4, 0.65)) * every)]
    events = make_events(
        t, rng.integers(0, WIDTH, len(t)), rng.integers(0, HEIGHT, len(t)), rng.integers(0, 2, len(t)) > 0
    )
    moments = st.integers(frames[0].middle, frames[-1].exposure_end)
    around_the_loss = st.integers(lost, lost + every)
    times = sorted(draw(st.lists(st.one_of(moments, around_the_loss), min_size=2, max_size=6)))
    return events, frames, times


@pytest.mark.parametrize(
    "name", ["default", "default-background", "default-black", "default-refractory-doubted"]
)
@given(data=st.data())
@settings(max_examples=8, deadline=None)
def test_they_agree_where_events_are_missing(name, data):
    assert_agrees(name, *data.draw(streams_with_losses()))


@st.composite
def streams_unheard(draw):
    """Three or four frames of 6 x 6 pixels, between two of which hardly an event comes though all of them change."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    begin, every = draw(st.integers(0, 10**6)), draw(st.integers(12_000, 40_000))
    count = draw(st.integers(3, 4))
    least = draw(st.sampled_from([0, 60]))  # of frames that clip hardly a pixel, and others
    frames = [
        Frame(rng.integers(least, 256, (6, 6)).astype(np.uint8), start, start + draw(st.integers(1000, 9000)))
        for start in range(begin, begin + count * every, every)
    ]
    silent = draw(st.integers(0, count - 2))
    start, end = frames[silent].middle, frames[silent + 1].middle
    t = np.sort(rng.integers(begin - 500, begin + count * every, 150 * count))
    heard = (t <= start) | (t > end - draw(st.sampled_from([0, every // 30])))
    t = t[heard]
    events = make_events(
        t, rng.integers(0, 6, len(t)), rng.integers(0, 6, len(t)), rng.integers(0, 2, len(t)) > 0
    )
    moments = st.integers(frames[0].middle, frames[-1].exposure_end)
    times = sorted(draw(st.lists(st.one_of(moments, st.integers(start, end)), min_size=2, max_size=4)))
    return events, frames, times


@pytest.mark.parametrize("name", ["default", "default-background"])
@given(data=st.data())
@settings(max_examples=8, deadline=None)
def test_they_agree_where_no_event_is_heard(name, data):
    assert_agrees(name, *data.draw(streams_unheard()))


def test_they_agree_where_frames_are_exposed_for_longer_than_between_their_middles():
    """Of a pixel that both frames clip, whose b' of K11 is then more than 1."""
    places = [(1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1), (2, 0, 0), (2, 0, 0), (2, 0, 1), (2, 0, 1)]
    x, y, polarity = np.array(places).T
    events = make_events(np.full(len(places), 240_831), x, y, polarity)
    image = np.array([[0, 0, 0], [0, 255, 0]], np.uint8)
    frames = [Frame(image, 238_570, 243_089), Frame(image, 243_089, 248_933)]
    assert_agrees("default-blurred", events, frames, [246_005, 246_011])


def assert_agrees(name, events, frames, times):
    """Compare every image of a stream, whose frames have exposures of any length."""
    chosen = VARIANTS[name]
    chosen = dataclasses.replace(
        chosen,
        events=dataclasses.replace(chosen.events, threshold_on=0.21, threshold_off=0.17),
        camera=dataclasses.replace(chosen.camera, reference_exposure=10_000),
    )
    size = frames[0].image.shape
    pixels, expected, variance, hidden, moving, unshowns = naive.reconstruct(
        events, frames, size, chosen, times
    )
    engine = Reconstructor(size, settings=chosen)
    for frame in frames:
        engine.push_frame(frame)
    engine.push_events(events)
    engine.finish()
    for i, t in enumerate(times):
        image = engine.read(t)
        k = max([j for j, f in enumerate(frames) if engine_node(f, name) < t], default=-1)
        white = white_at(t, k, frames, name, chosen.camera.offset)
        value, total = expected[i], np.nan_to_num(variance[i])
        unknown_scale = chosen.events.mismatch**2
        bound, noise, beyond = value, total, np.zeros(total.shape)
        excess, doubt = unshowns[i]
        unshown = ~np.isnan(excess)
        top = np.log(white + chosen.camera.offset)
        if unshown.any():
            value, total, beyond, noise = naive.lifted(value, total, excess, chosen, top)
        given = sure = np.where(unshown, np.maximum(beyond, 0.05) ** 2 + noise, total)
        if chosen.filter.neighbours > 0:
            known = total + 1.6 * hidden[0, i]  # before neighbours are heard
            raised = value
            rough = naive.texture(pixels, size, t, chosen.filter.neighbours)
            value, total = naive.regularised(raised, known, moving[i], rough)
            surface = np.zeros(unshown.shape, bool)
            for place, pixel in pixels.items():
                surface[place] = naive.is_unmeasured(pixel, t) and not unshown[place]
            if naive.is_surface(surface):
                smooth = naive.smoothed_surfaces(raised, known, surface, chosen.filter.neighbours, top)
                value, total = (
                    np.where(surface, *planes) for planes in zip(smooth, (value, total), strict=True)
                )
            total = np.where(unshown, known, total)
            given, left = hidden[1, i].copy(), total / known
            for place, pixel in pixels.items():
                given[place] += naive.known(pixel, sure[place], t, chosen, 0.21 * 0.17, left[place])
        least = np.minimum(bound, np.maximum(bound - 2 * np.sqrt(noise), top))
        value = np.where(unshown, np.maximum(value, least) + np.minimum(beyond**2, beyond) / 2, value)
        level = np.vectorize(lambda v, p: naive.intensity(v, p, chosen, white, unknown_scale))(  # noqa: B023
            value, np.where(unshown, noise, total)
        )
        offset = chosen.camera.offset
        if name.startswith("default"):
            for place, pixel in pixels.items():
                least = naive.kept_white(expected[i][place], pixel, t, white, offset)
                level[place] = max(level[place], least)
        # Two deviations of a bound's noise are no finer than the root of the last bit of P, which is about 1.
        slack = np.where(unshown, 2 * (np.sqrt(noise + LAST_BIT) - np.sqrt(noise)), 0.0)
        off = np.abs(np.log(image.intensity + offset) - np.log(level + offset))
        assert (off <= 1e-4 + slack).all(), (off, slack)
        if name != "cf":
            if name.startswith("default"):
                # At its own levels: near black the slope of a curve changes by more than they do.
                given = naive.with_pattern(given, image.intensity, white, chosen.camera)
            if name == "default-slow":
                for place, pixel in pixels.items():
                    given[place] += naive.lagging(pixel, image.intensity[place], t, 0.21 * 0.17, chosen)
            given += 0.25 * np.nan_to_num(doubt)
            if name.startswith("default"):
                for place in pixels:
                    given[place] += naive.blurred(pixels, place, t, 0.21 * 0.17, chosen)
            if name == "default-quiet":
                given = naive.with_rounding(given, level, moving[i], white / 255, offset)
            if name in ("default-noisy", "default-night", "default-dark"):
                given = naive.with_dark_doubt(given, image.intensity, chosen)
            # What float32 leaves of differences of variances: more than 1e-4 in one of some thousand random streams.
            np.testing.assert_allclose(image.variance, given, rtol=2e-4)


def white_at(t, k, frames, name, offset):
    """The level that frames show, from one frame's to the next's: linear in log(white + I_0)."""
    levels = [10_000 / f.exposure for f in frames]
    if k < 0 or k + 1 == len(frames):
        return levels[max(k, 0)]
    start, end = engine_node(frames[k], name), engine_node(frames[k + 1], name)
    fraction = (t - start) / (end - start)
    return (
        np.exp((1 - fraction) * np.log(levels[k] + offset) + fraction * np.log(levels[k + 1] + offset))
        - offset
    )


def engine_node(frame, name):
    """Where a frame's segment begins."""
    return frame.exposure_start if name.startswith("iccv2021") else frame.middle
