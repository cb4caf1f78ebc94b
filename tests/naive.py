"""The slow oracle: float64, one pixel at a time, the paper's equations (and docs/equations.md, K1 to K16) as written.

Nothing here is incremental: L^A(t) is summed from the events anew at every t, integrals are taken by Gauss-Legendre
quadrature where a closed form would repeat the code under test. Lookahead mode only; 8-bit frames. The paper's
filter has a linear response only; I and f^w of others are `kalux.models.camera`'s.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import erf

import numpy as np
from scipy.special import lambertw, log_ndtr

from kalux.models.camera import Camera
from kalux.settings import chosen_response

US = 1e-6
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
UNMEASURED = 1e12
USUAL_INTERVAL = 40_000
SURE = (1.0, 1.0)  # on and off events are signal


@dataclass
class Pixel:
    """What one pixel sees. Events: time, polarity, newest event in the 3x3 pixels, newest of its own, weight
    (K13).

    Changes, of frame intervals, K11: whether both frames measure it, whether it is silent, how much its L changed,
    squared, as far as frames tell (told), without what noise makes of that, and the variances of both frames; and how
    likely it has an event that is signal (active). Untold: variance of what no event tells of it (K1). Forgotten: what
    comes to P after each. Around: mean square change of the silent pixels around (K11); expected: how far above white
    it is by the frame after each (K7). Lost: variance of what events would have told that are missing (K18); None: none
    are. Before: events before the first exposure, of which frames alone know (K19). Late: how much later than a frame's
    middle its row is exposed; reach: the same of the row that is exposed last.
    Signal: probability that its on and its off events of every frame interval are no noise (K5); none: by their age.
    """

    starts: list[int]
    middles: list[int]
    ends: list[int]
    intensity: list[float]
    white: list[float]
    clipped: list[bool]
    rounding: list[float]
    black: list[bool]
    dark: list[float]
    events: list[tuple[int, bool, int, int, float]]
    before: list[tuple[int, bool, int, int, float]]
    late: int = 0
    reach: int = 0
    shown: int = 0
    excess: float = 0.0
    raised: list[bool] = field(default_factory=list)
    left: bool = False
    gone: bool = False
    changes: list[tuple[bool, bool, float, tuple[float, float], float]] = field(default_factory=list)
    told: list[float] = field(default_factory=list)
    active: list[float] = field(default_factory=list)
    untold: list[float] = field(default_factory=list)
    around: list[float] = field(default_factory=list)
    expected: list[float] = field(default_factory=list)
    lost: list[float | None] = field(default_factory=list)
    latents: list[tuple[float, float]] = field(default_factory=list)
    forgotten: list[float] = field(default_factory=list)
    measured: list[bool] = field(default_factory=list)
    signal: list[tuple[float, float]] = field(default_factory=list)


def pixels(events, frames, sensor_size, settings, begin):
    """Split a recording into pixels. The newest event around each event is looked up in the whole stream."""
    height, width = sensor_size
    camera = Camera.named(chosen_response(settings.camera.response, None), settings.camera.clipped_from)
    reference = settings.camera.reference_exposure
    places = [(row, column) for row in range(height) for column in range(width)]
    own, early = ({place: [] for place in places} for _ in range(2))
    heard = {place: [] for place in places}  # all events of a pixel until now
    newest = {}  # its latest one after the beginning
    for e in events:
        row, column = place = int(e["y"]), int(e["x"])
        heard[place].append(e)
        weight = event_weight(heard[place], settings)
        if e["t"] <= begin:
            early[place].append((int(e["t"]), bool(e["p"]), begin, begin, weight))
            continue
        around = [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        near = max(newest.get(q, begin) for q in around)
        own[place].append((int(e["t"]), bool(e["p"]), near, newest.get(place, begin), weight))
        newest[place] = int(e["t"])
    out = {}
    for row, column in places:
        ratio = [reference / (f.exposure_end - f.exposure_start) for f in frames]
        response = [float(f.image[row, column]) / 255 for f in frames]
        out[row, column] = Pixel(
            [f.exposure_start for f in frames],
            [(f.exposure_start + f.exposure_end) // 2 for f in frames],
            [f.exposure_end for f in frames],
            [r * float(camera.response.inverse(q)) for r, q in zip(ratio, response, strict=True)],
            ratio,
            [r >= settings.camera.clipped_from for r in response],
            [r * half_rounded(camera.response, q) for r, q in zip(ratio, response, strict=True)],
            [r == 0 for r in response],
            [dark_scale(f, settings.camera) for f in frames],
            own[row, column],
            early[row, column],
        )
    return out


def half_rounded(response, level):
    """K3: half of the irradiances that are rounded to a level of 8 bits; 0 where it is the same at all levels."""
    if response.is_linear:
        return 0.0
    least, most = max(level - 0.5 / 255, 0.0), min(level + 0.5 / 255, 1.0)
    return float(response.inverse(most) - response.inverse(least)) / 2


def event_weight(events, settings):
    """K13: how many thresholds the last of a pixel's ``events`` tells of."""
    period = settings.events.refractory
    if period == 0:
        return 1.0

    def since(n):
        """us from the event before the n-th last one that this goes on from; 0 if it does not go on."""
        if len(events) <= n or bool(events[-n - 1]["p"]) != bool(events[-n]["p"]):
            return 0.0
        return float(events[-n]["t"] - events[-n - 1]["t"])

    def tells(n):
        """Whether the time since the event before the n-th last one tells a pace."""
        return since(n) > 0.95 * period

    def pace(n, unsteady):
        return period / np.hypot(since(n) - period, unsteady * period)

    def to_come(n):
        """What is counted with the n-th last one of what its own refractory period hides."""
        if not (tells(n) and tells(n + 1)):
            return 0.0
        return max(1 - 500 / period, 0) / 2 * min(pace(n, 0.15), pace(n + 1, 0.15))

    if not tells(1):
        return 1.0
    between = (pace(1, 0.15) + pace(2, 0.15)) / 2 if tells(2) else pace(1, 0.2)
    weight = 1 + between - to_come(2) + to_come(1)
    return 1 + round((weight - 1) * 4096) / 4096  # as events carry it


def growth_with_period(weight):
    """K10: derivative of an event's weight by the logarithm of the refractory period, by its mean pace."""
    pace = weight - 1
    if pace <= 0:
        return 0.0
    looked = np.sqrt(max(pace**-2 - 0.15**2, 0.0))
    return pace + max(pace**3 * (looked - 0.15**2), 0.0)


def event_sum(pixel, a, b, on, off):
    """int_a^b e(gamma) d gamma: the steps of the events with a < t <= b."""
    return sum(w * (on if p else -off) for t, p, _, _, w in pixel.events if a < t <= b)


def dark_light(clean, shares, even):
    """K3: intensities, white = 1, and how often frames show them; the even ones where that is not known."""
    if shares in ("auto", "even"):
        return even, np.ones(200) / 200
    edges = [0, 0.125, 0.375, 0.75, 1.25, 1.75, 2.5, 4, 6.5, 10, 14]
    light, often = [], []
    for k, share in enumerate(shares.split()):
        wide = edges[k + 1] - edges[k]
        part = 0.8 * float(share) / sum(float(s) for s in shares.split()) + 0.2 * wide / 14
        for j in range(8):
            light.append(edges[k] + wide * (j / 7 if k == 0 else (j + 0.5) / 8))
            often.append(part / 8)
    return np.array(light) * clean, np.array(often)


@lru_cache
def dark_levels(read, shot, i0, shares):
    """K3: what is added to log(I + I_0) of the 8-bit levels of dark pixels, white = 1."""
    clean = np.sqrt(max(read**2 - (1 / 255) ** 2 / 12, 0))
    if clean < 0.5 / 255:
        return [0.0], [0.0]
    step = max(1, int(clean * 255 / 4)) / 255
    levels = [k * step for k in range(int(12 * clean / step) + 1)]
    rows, wanted = [], []
    for i, often in zip(*dark_light(clean, shares, np.linspace(0, 8 * clean, 200)), strict=True):
        share = weights_of(levels, i, read, shot, i0)
        share /= share.sum()
        rows.append(np.sqrt(often) * share[None])
        wanted.append([np.sqrt(often) * np.log(i + i0)])
        rows.append(
            np.sqrt(often * share / 10)[:, None] * (np.eye(len(levels)) - share)
        )  # the noise of a mean of ten
        wanted.append(np.zeros(len(levels)))
    value = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0]
    added = value - np.log(np.array(levels) + i0)
    return levels, added * np.clip((8 * clean - np.array(levels)) / (2 * clean), 0, 1)


def weights_of(levels, i, read, shot, i0):
    """K3: probabilities that an intensity i reads levels, times how much these count."""
    clean, step = np.sqrt(read**2 - (1 / 255) ** 2 / 12), levels[1] - levels[0]
    deviation = np.sqrt(clean**2 + shot * i) * np.sqrt(2)
    below = [0.0] + [(1 + erf((b + step / 2 - i) / deviation)) / 2 for b in levels[:-1]] + [1.0]
    return np.diff(below) / [0.03 + (read**2 + shot * b) / (max(b, 1.5 * read) + i0) ** 2 for b in levels]


@lru_cache
def dark_doubts(read, shot, i0, shares):
    """K11: by intensities shown, what the mean of frames is wrong by where noise hides the light below black."""
    levels, added = dark_levels(read, shot, i0, shares)
    clean = np.sqrt(max(read**2 - (1 / 255) ** 2 / 12, 0))
    if len(levels) == 1 or clean < 4 * i0:
        return [0.0, 1.0], [0.0, 0.0]
    shown = np.linspace(0, 4 * clean, 65)
    found = []
    light, often = dark_light(clean, shares, np.geomspace(i0, 4 * clean + i0, 200) - i0)
    for i in light:
        weights = weights_of(levels, i, read, shot, i0)
        mean = np.sum(weights * (np.log(np.array(levels) + i0) + added)) / np.sum(weights)
        found.append((mean, (mean - np.log(i + i0)) ** 2, 1 / np.sum(weights) / 4))  # of a mean of four
    doubts = []
    for one in shown[:-1]:
        chances = [
            -((np.log(one + i0) - mean) ** 2) / (2 * noise) - np.log(noise) / 2 for mean, _, noise in found
        ]
        chances = often * np.exp(np.array(chances) - max(chances))
        doubts.append(np.sum(chances * [wrong for _, wrong, _ in found]) / np.sum(chances))
    return shown, [*doubts, 0.0]


def with_dark_doubt(variance, intensity, settings):
    camera = settings.camera
    doubts = dark_doubts(*camera.noise, camera.offset, settings.filter.dark_shares)
    return variance + np.interp(intensity, *doubts)


def dark_correction(intensity, read, shot, i0, shares):
    return np.interp(intensity, *dark_levels(read, shot, i0, shares))


def edi(pixel, k, log_frame, on, off):
    """EDI: L^D(start), straight from B + I_0 = 1/T int exp(L(t)) dt."""
    s, e = pixel.starts[k] + pixel.late, pixel.ends[k] + pixel.late
    inside = [(t, w * (on if p else -off)) for t, p, _, _, w in pixel.events if s < t <= e]
    edges = [s, *[t for t, _ in inside], e]
    levels = [0.0, *np.cumsum([step for _, step in inside])]  # after each event, also of several at one time
    mean = sum(np.exp(v) * (b - a) for v, a, b in zip(levels, edges[:-1], edges[1:], strict=True)) / (e - s)
    return log_frame - np.log(mean)


# The paper.


def paper(pixel, settings, times, on, off):
    """L(t) and P(t) of one pixel, equations (6) to (21)."""
    c, ev, fl = settings.camera, settings.events, settings.filter
    i0, count = c.offset, len(pixel.starts)
    r_bar = [w**2 / c.confidence / max(1.0, c.weight_floor) for w in pixel.white]  # (6), linear: f^w = 1
    log_frame = [
        np.log(i + i0) - r / (2 * (i + i0) ** 2)
        for i, r in zip(pixel.intensity, r_bar, strict=True)  # (8)
    ]
    if fl.deblur:
        start = [edi(pixel, k, log_frame[k], on, off) for k in range(count)]
        end = [start[k] + event_sum(pixel, pixel.starts[k], pixel.ends[k], on, off) for k in range(count)]
    else:
        start, end = list(log_frame), list(log_frame)
    scale = []
    for k in range(count - 1):  # (12)
        integral = event_sum(pixel, pixel.starts[k], pixel.ends[k + 1], on, off)
        difference = end[k + 1] - start[k]
        usable = difference != 0 and 0.6 <= integral / difference <= 100
        scale.append(difference / integral if usable else 1.0)

    def forward(k, t, factor):  # (10)
        return start[k] + factor * event_sum(pixel, pixel.starts[k], t, on, off)

    def backward(k, t):  # (11), of the interval from k to k + 1
        return end[k + 1] - scale[k] * event_sum(pixel, t, pixel.ends[k + 1], on, off)

    def augmented(k, t, known_until=None):  # (13); events up to known_until
        u = min(max((t - pixel.starts[k]) / (pixel.ends[k] - pixel.starts[k]), 0.0), 1.0)
        at = t if known_until is None else known_until
        if k == 0:
            before = forward(0, at, scale[0] if scale else 1.0)
        else:
            before = forward(k - 1, at, scale[k - 1])
        if k < count - 1:
            after = backward(k, at)
        else:
            after = forward(k, at, scale[k - 1] if k else 1.0)
        return (1 - u) * before + u * after

    def covariance(k, t, after):  # (7), (9)
        if after:
            if k == count - 1:
                return r_bar[k] / (pixel.intensity[k] + i0) ** 2
            f = (t - pixel.middles[k]) / (pixel.middles[k + 1] - pixel.middles[k])
            r = (1 - f) * r_bar[k] + f * r_bar[k + 1]
            return r / (pixel.intensity[k] + i0) ** 2
        if k == 0:
            return r_bar[0] / (pixel.intensity[0] + i0) ** 2
        f = (t - pixel.middles[k - 1]) / (pixel.middles[k] - pixel.middles[k - 1])
        return ((1 - f) * r_bar[k - 1] + f * r_bar[k]) / (pixel.intensity[k - 1] + i0) ** 2

    def predict(k, state, ti, t):
        value, variance = state
        if fl.solution == "printed":
            p = 1 / (1 / variance + (t - ti) * US / covariance(k, t, t >= pixel.middles[k]))  # (20)
            deviation = value - augmented(k, ti)
            return deviation * (1 / variance) * p + augmented(k, t, ti), p  # (17)
        # J L = J_i L_i + int L^A / R, J = J_i + int 1/R
        j, z = 1 / variance, value / variance
        cuts = sorted({ti, t, *[q for q in (pixel.middles[k], pixel.ends[k]) if ti < q < t]})
        for a, b in itertools.pairwise(cuts):
            # Sixteen panels: 1/R of a line that R falls along is all but singular at its end.
            panels = np.linspace(a, b, 17)
            q = (panels[:-1, None] + np.diff(panels)[:, None] * (NODES + 1) / 2).ravel()
            w = np.tile(WEIGHTS / 2, 16) * (b - a) / 16 * US
            w /= np.array([covariance(k, x, a >= pixel.middles[k]) for x in q])
            j += w.sum()
            z += (w * np.array([augmented(k, x, ti) for x in q])).sum()
        return z / j, 1 / j

    begin = pixel.starts[0]
    state = (augmented(0, begin), fl.initial_variance)
    out, at, k = [], begin, 0
    pending = list(pixel.events)

    def step_to(limit):
        nonlocal state, at
        while pending and pending[0][0] <= limit:
            t, polarity, near, same, _ = pending.pop(0)
            value, variance = predict(k, state, at, t)
            q = ev.sigma_proc2 * (t - same) * US + ev.sigma_iso2 * (t - near) * US  # (2)
            q += ev.sigma_ref2 if (t - same) * US <= ev.refractory_bound else 0.0
            state = (value + (on if polarity else -off), variance + q)  # (15), (21)
            at = t

    for t in times:
        while k + 1 < count and t > pixel.starts[k + 1]:
            step_to(pixel.starts[k + 1])
            state, at = predict(k, state, at, pixel.starts[k + 1]), pixel.starts[k + 1]
            k += 1
        step_to(t)
        out.append(predict(k, state, at, t))
    return np.array(out)


# kalux's own.


def trail_scales(every, settings):
    """K14: s of the lead-in, of every interval between two frames, and of what follows the last, in seconds."""
    span = number = 0.0
    out = []
    middles = next(iter(every.values())).middles
    for start, end in zip([next(iter(every.values())).starts[0], *middles[:-1]], middles, strict=True):
        span, number = span / 2, number / 2
        for pixel in every.values():
            for (before, p, *_), (t, q, *_) in itertools.pairwise(pixel.events):
                if max(start, end - (end - start) // 4) < t <= end and p == q and t - before < 100_000:
                    span, number = span + t - before, number + 1
        out.append(1.1 * US * (span + 1e6) / (number + 100))
    return [*out, out[-1]]


def trail(pixel, t, scale, height, on, off):
    """K14: how far the pixel is beyond its newest event, as far as that is signal."""
    earlier = [(q, p) for q, p, *_ in pixel.events if q <= t]
    if not earlier:
        return 0.0
    newest, polarity = earlier[-1]
    signal = 1.0
    for k, of_interval in enumerate(pixel.signal):
        if pixel.middles[k] < newest <= pixel.middles[k + 1]:
            signal = np.floor(127 * np.sqrt(of_interval[0 if polarity else 1]) + 0.5) / 127
    x = (t - newest) * US / scale
    return signal * height * (on if polarity else -off) * 2 * x / (1 + x * x)


def hides(camera):
    """K7: the most that black hides."""
    response = Camera.named(chosen_response(camera.response, None), camera.clipped_from).response
    return float(response.inverse(0.5 / 255))


def dark_scale(frame, camera):
    """K7: how the log intensity of what is black is distributed, by the share of black among what is hardly more."""
    response = Camera.named(chosen_response(camera.response, None), camera.clipped_from).response
    most = hides(camera)
    values = response.inverse(frame.image.ravel() / 255)
    near = max(min(1.5 * most, 0.95), 1.1 * most)
    black, dark = np.sum(values <= most), np.sum(values <= near)
    if black == 0:
        return 0.3
    return float(np.clip(np.log(near / most) / max(np.log(dark / black), 1e-3), 0.3, 2.0))


def is_crushed(pixel, k, camera):
    """K7: whether black hides more than a linear response's would."""
    return pixel.black[k] and hides(camera) > 1.5 / 255


def bridged(pixel, settings, times, on, off, scales):
    """L(t) and P(t) of one pixel, docs/equations.md, K1 to K5, K7, K10, K13 and K14; what K15 needs."""
    c, ev = settings.camera, settings.events
    i0, count, c2 = c.offset, len(pixel.starts), on * off
    scale_on, scale_off = 1.0, 1.0
    var_on = var_off = ev.mismatch**2
    learned = []
    pixel.changes.clear()
    pixel.active.clear()
    pixel.told.clear()
    pixel.measured.clear()
    pixel.latents.clear()

    hidden_by_black = hides(c)

    def crushed(k):  # K7
        return is_crushed(pixel, k, c)

    def ceiling(k, middle):  # K7: the most that L is at the middle of the exposure
        if not crushed(k):
            return np.inf
        most = hidden_by_black * pixel.white[k]
        return middle + np.log(most + i0) - np.log(most * np.exp(-pixel.dark[k]) + i0)

    def frame_variance(k):  # K3, by the noise of the frame alone
        read, shot = c.noise
        variance = (read * pixel.white[k]) ** 2 + shot * pixel.white[k] * pixel.intensity[k]
        variance = max(variance, pixel.rounding[k] ** 2)
        variance /= (max(pixel.intensity[k], 1.5 * read * pixel.white[k]) + i0) ** 2
        return variance

    def latent(k):  # K3
        log_frame = np.log(pixel.intensity[k] + i0)
        if c.frame_noise is not None and chosen_response(c.response, None) == "linear":
            log_frame += dark_correction(
                pixel.intensity[k] / pixel.white[k],
                *c.noise,
                i0 / pixel.white[k],
                settings.filter.dark_shares,
            )
        if crushed(k):
            most = hidden_by_black * pixel.white[k]
            log_frame = black = np.log(most * np.exp(-pixel.dark[k]) + i0)
        a, b = on * scale_on, off * scale_off
        whole = replace(pixel, events=[*pixel.before, *pixel.events])
        own_middle, late = pixel.middles[k] + pixel.late, pixel.late
        middle = edi(whole, k, log_frame, a, b) if settings.filter.deblur else log_frame
        inside = 0
        if settings.filter.deblur:
            middle += event_sum(whole, pixel.starts[k] + late, own_middle, a, b)
            inside = sum(w for t, *_, w in whole.events if pixel.starts[k] < t - late <= pixel.ends[k])
        variance = frame_variance(k)
        if crushed(k):
            shares = (np.arange(64) + 0.5) / 64
            variance = 3 * np.mean((np.log(most * shares ** pixel.dark[k] + i0) - black) ** 2)
        error = ev.deblur_variance * c2 * (1 + inside / 12 + inside**2 / 20)
        wrong = error / (error + 0.01 * c2 * inside**2) if error > 0 else 0.0
        variance += (wrong * (middle - log_frame)) ** 2 + (1 - wrong) * error
        if late != 0:  # K19
            first, last = sorted((own_middle, pixel.middles[k]))
            middle -= np.sign(late) * event_sum(whole, first, last, a, b)
            told = sum(w for t, *_, w in whole.events if first < t <= last)
            around = sum(w for t, *_, w in whole.events if abs(t - pixel.middles[k] - 0.5) < pixel.reach)
            untold = c2 * (around * abs(late) / (2 * pixel.reach)) ** 2
            variance += ev.step_noise * c2 * told + min(untold, ev.quantisation_variance * c2)
        return middle, UNMEASURED if pixel.clipped[k] else variance

    def counts(a, b):
        inside = [(p, w) for t, p, *_, w in pixel.events if a < t <= b]
        return sum(w for p, w in inside if p), sum(w for p, w in inside if not p)

    def grown(index, t):  # K14, since the frame at which the interval begins, or that of the lead-in
        frame = pixel.middles[max(index - 1, 0)]
        now, then = (trail(pixel, q, scales[index], ev.trail, on, off) for q in (t, frame))
        return now - then

    begin = pixel.starts[0]
    first = latent(0)
    pixel.measured.append(first[1] < UNMEASURED)
    pixel.latents.append(first)
    intervals = [(begin, pixel.middles[0], None, first, scale_on, scale_off, var_on, var_off, 0.0, SURE)]
    untold_from = {}  # K1: variance of what no event tells, of the interval that begins there
    slow_from = {}  # K20: settings of events, with the variance of a step there
    moved_from = {}  # K1: by which its first frame is moved, of the mismatch
    for k in range(count - 1):
        second = latent(k + 1)
        pixel.measured.append(second[1] < UNMEASURED)
        pixel.latents.append(second)
        a, b = pixel.middles[k], pixel.middles[k + 1]
        n_on, n_off = counts(a, b)
        signal = pixel.signal[k] if pixel.signal else SURE
        slow_from[a] = in_the_dark(ev, first[0], second[0], i0) if pixel.signal else ev
        q_on, q_off = (step_noise(f, slow_from[a]) * c2 for f in signal)
        told_on, told_off = signal[0] * n_on, signal[1] * n_off
        saturated = first[1] >= UNMEASURED and second[1] >= UNMEASURED and settings.filter.highlight_scale > 0
        mismatch = 0.0 if saturated else second[0] - first[0]
        change = on * scale_on * told_on - off * scale_off * told_off
        mismatch -= change + grown(k + 1, b)
        of_frames = 4 * settings.filter.highlight_scale**2 if saturated else first[1] + second[1]
        of_events = var_on * (on * told_on) ** 2 + var_off * (off * told_off) ** 2
        of_events += q_on * n_on + q_off * n_off
        q0, noise = ev.quantisation_variance * c2, first[1] + second[1]
        q0 += pixel.lost[k] or 0.0
        total = of_frames + of_events + q0
        untold = pixel.untold[k] if pixel.untold else q0
        untold_from[a] = untold
        reached = 0  # K7: the bound that events lead below, to which the other frame is joined as if it had no error
        if min(first[1], second[1]) < UNMEASURED <= max(first[1], second[1]):
            which = 1 if first[1] >= UNMEASURED else 2
            reached = which if (mismatch < 0 if which == 1 else mismatch > 0) else 0
        gain = mismatch / ((min(first[1], second[1]) if reached else of_frames) + of_events + untold)
        moved_from[a] = 0.0 if reached == 1 else first[1]
        intervals.append((a, b, first, second, scale_on, scale_off, var_on, var_off, gain, signal))
        told = (q0 / (noise + q0)) ** 2
        squared = min((q0 * mismatch / total) ** 2, c2) - noise * told
        pixel.changes.append(
            (noise < UNMEASURED, n_on + n_off == 0, squared, (first[1], second[1]), mismatch)
        )
        pixel.active.append(min(told_on + told_off, 1.0))
        pixel.told.append(told)
        gain_on, gain_off = var_on * on * told_on / total, -var_off * off * told_off / total  # K2
        hidden = 2.4 * ev.quantisation_variance * c2
        excess = mismatch + (change * hidden / (change**2 + hidden) if change else 0.0)
        scale_on = min(max(scale_on + gain_on * excess, 0.3), 3.0)
        scale_off = min(max(scale_off + gain_off * excess, 0.3), 3.0)
        var_on += 1e-5 - gain_on**2 * total
        var_off += 1e-5 - gain_off**2 * total
        learned.append((scale_on, scale_off))
        first = second

    def events_of(interval):  # K20
        return slow_from.get(interval[0], ev)

    def added(interval, k):  # what events and K14 add to the level in all of an interval
        n_on, n_off = counts(*interval[:2])
        up, down = (own_step(interval, p, on, off, events_of(interval), c2, counts) for p in (True, False))
        return n_on * up + n_off * down + grown(k, interval[1])

    def said(interval, k):  # K15: what the frames around say themselves of a clipped pixel, at the first
        left, right = interval[2:4]
        return max(left[0], right[0] - added(interval, k) if right[1] >= UNMEASURED else -np.inf)

    # K15: from which frame on it is known, and how far above its bound it was then; which clipped frames raise that;
    # whether it is clearly below what it was at least, by the frame, and by its events.
    pixel.shown, bounds, pixel.raised = 0, [intervals[0][3][0]], []
    if intervals[0][3][1] >= UNMEASURED:
        pixel.shown = count
        for k, interval in enumerate(intervals[1:], 1):
            bound, right = bounds[-1] + added(interval, k), interval[3]
            if right[1] < UNMEASURED:
                pixel.shown, pixel.excess = k, max(right[0] - bound, 0.0)
                pixel.left = right[0] < bounds[-1] - 3 * np.sqrt(frame_variance(k))
                pixel.gone = bound < bounds[-1] - off / 2
                break
            pixel.raised.append(right[0] > bound + 1e-4)
            bounds.append(max(bound, right[0]))

    def follow_beyond():  # K7: by how much more than events, and bounds, say L rises beyond white in every interval
        # The level to which events have led, how far above it L is, the variance of that, and the bound.
        risen = None
        most = ev.quantisation_variance * c2 if settings.filter.unshown_tail > 0 else 0
        for k, interval in enumerate(intervals[1:-1], 1):
            a, b, left, right, *_, gain, _ = interval
            if right[1] < UNMEASURED or most == 0 or pixel.lost[k - 1] is not None or not pixel.around:
                risen = None
                continue
            change, scale = max(min(pixel.around[k - 1], most), 1e-6), max(pixel.expected[k - 1], 1e-3)
            told = added(interval, k)
            if left[1] < UNMEASURED:
                short = gain * untold_from[a]
                beyond_from[a] = mean_beyond(short, change, scale) if short > 0 else 0.0
                at_bound = augmented(interval, b, b) + grown(k, b)
                total = max(short, 0) + beyond_from[a]
                risen = at_bound - max(short, 0) - beyond_from[a], total, change, right[0]
            elif risen is not None:
                level, above, change = risen[0], risen[1], min(risen[2] + change, most)
                level += told + max(right[0] - told - level - above, 0.0)
                heard = sum(counts(a, b)) > 0
                level, above = (level + above / 2, above / 2) if heard else (level, above)
                bound = right[0] if heard else max(right[0], risen[3])
                after = max(bound + mean_beyond(bound - level, change, scale) - level, 0.0)
                after = min(after, above) if heard else after
                beyond_from[a] = after - above
                risen = level, after, change, bound

    last = (pixel.middles[-1], None, first, None, scale_on, scale_off, var_on, var_off, 0.0, SURE)
    intervals.append(last)

    def period_error(k):  # K10: what that of the refractory period adds to the level in an interval
        a, b, *_, signal = intervals[k]
        error = 0.0
        for t, p, *_, w in pixel.events:
            if a < t <= b:
                step = on * signal[0] if p else -off * signal[1]
                error += ev.refractory_doubt * step * growth_with_period(w)
        return error

    # K10: what every on and off event of an interval adds to the variance besides
    untied = [(0.0, 0.0)] * len(intervals)

    def drift():  # K10: what the thresholds add to the variance at the end of every interval
        far_on = far_off = far = 0
        yield 0.0
        for k, (a, b, left, right, _, _, v_on, v_off, _, signal) in enumerate(intervals[1:-1], 1):
            n_on, n_off = (f * n for f, n in zip(signal, counts(a, b), strict=True))
            if k <= pixel.shown:  # K15
                above = max(bounds[k - 1] - said(intervals[k], k), 0.0)
                far_on = min(far_on, above / on / np.sqrt(v_on))
                far_off = min(far_off, above / off / np.sqrt(v_off))
                far = np.clip(far, -above, above)
            unseen = pixel.forgotten[k - 1] if pixel.forgotten else 0.0
            if right[1] < UNMEASURED:
                if left[1] >= UNMEASURED and sum(counts(a, b)) > 0:
                    (f_on, f_off), now = signal, period_error(k)
                    more = ((far + now) ** 2 - far**2) / sum(counts(a, b))
                    of_on = f_on * v_on * on**2 * (2 * far_on + n_on)
                    of_off = f_off * v_off * off**2 * (2 * far_off + n_off)
                    untied[k] = max(of_on + more, 0.0), max(of_off + more, 0.0)
                far_on = far_off = far = 0
                yield right[1] / 12 if crushed(k) else unseen  # K7
                continue
            unseen += ev.quantisation_variance * c2 / 2 if left[1] < UNMEASURED else 0.0
            before = v_on * (on * far_on) ** 2 + v_off * (off * far_off) ** 2 + far**2
            far_on, far_off = far_on + n_on, far_off + n_off
            far += period_error(k)
            after = v_on * (on * far_on) ** 2 + v_off * (off * far_off) ** 2 + far**2
            yield max(after - before + unseen, 0.0)

    drifts = list(drift())
    beyond_from = {}

    def augmented(interval, t, known_until):  # K1: posterior mean of the level at t, given both frames
        a, b, left, right, s_on, s_off, v_on, v_off, gain, (f_on, f_off) = interval
        if left is None:
            return right[0] - event_sum(pixel, known_until, b, on * s_on, off * s_off)
        prior = left[0] + event_sum(pixel, a, known_until, f_on * on * s_on, f_off * off * s_off)
        if right is None:
            return prior
        (t_on, t_off), (n_on, n_off) = counts(a, known_until), counts(a, b)
        shared = moved_from[a] if min(left[1], right[1]) < UNMEASURED else 0.0  # two bounds measure nothing
        shared += v_on * (f_on * on) ** 2 * t_on * n_on + v_off * (f_off * off) ** 2 * t_off * n_off
        shared += c2 * (step_noise(f_on, slow_from[a]) * t_on + step_noise(f_off, slow_from[a]) * t_off)
        shared += untold_from[a] * (t - a) / (b - a)
        return prior + shared * gain + beyond_from.get(a, 0.0) * (t - a) / (b - a)

    def rate(interval, known_until):  # K4
        a, b, left, right, *_ = interval
        if right is None:
            # All of the last frame's information, spread over the last interval.
            spread = (pixel.middles[-1] - pixel.middles[-2]) * US if count > 1 else 0.04
            return (
                1 / (left[1] + ev.step_noise * c2 * sum(counts(a, known_until))) + 1 / UNMEASURED
            ) / spread
        forward = UNMEASURED if left is None else left[1]
        forward += ev.step_noise * c2 * sum(counts(a, known_until))
        coming = sum(counts(known_until, b))
        backward = right[1] + ev.step_noise * c2 * coming
        if left is not None and left[1] >= UNMEASURED > right[1] and coming > 0:  # nothing ties the other end
            v_on, v_off, (f_on, f_off), (n_on, n_off) = *interval[6:8], interval[-1], counts(a, b)
            wrong = v_on * (on * f_on * n_on) ** 2 + v_off * (off * f_off * n_off) ** 2
            backward += 0.1 * wrong * (coming / (n_on + n_off)) ** 2
        return 0.5 / ((b - a) * US) * (1 / forward + 1 / backward)

    follow_beyond()
    value = augmented(intervals[0], begin, begin)
    variance = first_variance(intervals[0], counts, ev, c2, settings)
    state = (value, variance)
    out, at, index = [], begin, 0
    pending = list(pixel.events)

    def predict(t):
        interval = intervals[index]
        value, variance = state
        information = 1 / variance + rate(interval, at) * (t - at) * US  # (20)
        deviation = (value - augmented(interval, at, at)) / variance / information  # (17)
        return augmented(interval, t, at) + deviation, 1 / information

    def come(t):  # K10: the share of the interval's events, of a pixel that no frame measures at its end
        a, b, left, right, *_ = intervals[index]
        if left is None or right is None or right[1] < UNMEASURED or not pixel.events:
            return 0.0
        return sum(counts(a, t)) / max(sum(counts(a, b)), 1e-9)

    def bounded(t):  # K7 and K10
        value, variance = predict(t)
        value += grown(index, t)
        _, b, _, right, *_ = intervals[index]
        if t != b:
            return value, variance + drifts[index] * come(t) if index < len(drifts) else variance
        value = max(value, right[0]) if right[1] >= UNMEASURED else value
        most = np.inf if index + 1 == len(intervals) else ceiling(index, right[0])
        return min(value, most), variance + drifts[index]

    def raised(value):  # K7: what events take below the next frame's bound was too low all the time
        _, _, left, right, *_ = intervals[index]
        if right is None or left[1] < UNMEASURED or right[1] < UNMEASURED:
            return value
        return max(value, right[0] - added(intervals[index], index))

    def sure(
        value, variance
    ):  # K15: a bound is too high by what it is above what frames say themselves, at most
        _, _, left, right, *_ = intervals[index]
        if index > pixel.shown or (right is not None and right[1] < UNMEASURED):
            return variance
        alone = left[0] if right is None else said(intervals[index], index)
        return min(variance, settings.filter.initial_variance + max(value - alone, 0.0) ** 2)

    def step_to(limit):
        nonlocal state, at
        while pending and pending[0][0] <= limit:
            t, polarity, near, _, weight = pending.pop(0)
            value, variance = predict(t)
            joined = intervals[index][2] is not None and intervals[index][3] is not None
            signal, told = 1.0, events_of(intervals[index])
            if pixel.signal and joined:  # K5; the steps of L^A are those that are expected
                noise = step_noise(intervals[index][-1][0 if polarity else 1], told)
            else:
                signal = 1 / (1 + (9 * ev.background_rate * (t - near) * US) ** 2)
                noise = ev.step_noise + signal * (1 - signal)
            # Several events may share a time: this one alone moves L^A by its own step.
            step = weight * own_step(intervals[index], polarity, on, off, told, c2, counts)
            q = weight * (c2 * noise + untied[index][0 if polarity else 1])
            state = (value + signal * step, variance + q)
            at = t

    for t in times:
        while intervals[index][1] is not None and t > intervals[index][1]:
            step_to(intervals[index][1])
            state, at = bounded(intervals[index][1]), intervals[index][1]
            index += 1
            state = (raised(state[0]), sure(*state))
        step_to(t)
        out.append(bounded(t))
    return np.array(out)


def mean_beyond(short, variance, scale):
    """K7: mean of a normal distribution times an exponential one, above a bound that is ``short`` above its middle."""
    deviation = np.sqrt(variance)
    cut = short / deviation + deviation / scale
    return deviation * (np.exp(-(cut**2) / 2 - np.log(2 * np.pi) / 2 - log_ndtr(-cut)) - cut)


def step_noise(signal, ev):
    """K5: variance of an event's step, in c^2, that is signal with a probability."""
    return signal * (ev.step_noise + 1 - signal)


def in_the_dark(ev, first, second, i0):
    """K20: settings of events with the variance that a step has by the mean of both frames' I."""
    if ev.dark_steps in ("auto", "none"):
        return ev
    middles = np.log([0.32 / 2 ** (k + 0.5) for k in range(-1, 6)])
    more = [0.0, *(float(part) for part in ev.dark_steps.split())]
    level = max((np.exp(first) + np.exp(second)) / 2 - i0, 1e-9)
    return replace(ev, step_variance=ev.step_noise + np.interp(-np.log(level), -middles, more))


def signal_shares(every, k, settings):
    """K5: probabilities that on and off events of every pixel between two frames are signal, by their neighbours."""
    start, end = next(iter(every.values())).middles[k : k + 2]
    m = settings.events.noise_rate * (end - start) * US / 2
    own, near, shares = {}, {}, {}
    for polarity in (True, False):
        for place, pixel in every.items():
            own[polarity, place] = round(
                sum(w for t, p, *_, w in pixel.events if start < t <= end and p == polarity)
            )
        for row, column in every:
            around = [
                (max(abs(r - row), abs(c - column)), own[polarity, (r, c)])
                for r, c in every
                if 0 < max(abs(r - row), abs(c - column)) <= 2
            ]
            n = sum((3 - distance) * count for distance, count in around)
            near[polarity, (row, column)] = n if n < 4 else int(2 * np.log2(n))
    unmeasured = {place: pixel.clipped[k] and pixel.clipped[k + 1] for place, pixel in every.items()}
    for (polarity, place), a in own.items():
        alike = [
            (own[other], unmeasured[other[1]]) for other, n in near.items() if n == near[polarity, place]
        ]
        same = [number for number, clipped in alike if clipped == unmeasured[place]]
        all_of_them = [4 + sum(number == b for number, _ in alike) for b in range(6)]
        noise = 0.0
        for b in range(1, a + 1):
            fewer, as_many = (
                same.count(number)
                + (200 * all_of_them[number] / sum(all_of_them) if unmeasured[place] else 4)
                for number in (min(b, 6) - 1, min(b, 5))
            )
            one = min(m / b * (fewer / as_many if b < 6 else 1.0), 1.0)
            noise = one if b == 1 or b >= 6 else min(noise, one)
        shares[polarity, place] = 1 - noise
    return shares


def own_step(interval, polarity, on, off, ev, c2, counts):
    """By how much one event moves L^A: its nominal step and its share of the mismatch (K1)."""
    a, b, left, right, s_on, s_off, v_on, v_off, gain, signal = interval
    nominal = on * s_on if polarity else -off * s_off
    if left is None or right is None:
        return nominal
    which = 0 if polarity else 1
    f, n = signal[which], counts(a, b)[which]
    shared = v_on * (f * on) ** 2 * n if polarity else v_off * (f * off) ** 2 * n
    return f * nominal + gain * (shared + step_noise(f, ev) * c2)


def first_variance(interval, counts, ev, c2, settings):
    """P at the start: that of L^A, or the setting where the first frame is clipped."""
    a, b, _, right, *_ = interval
    variance = right[1] + ev.step_noise * c2 * sum(counts(a, b))
    return settings.filter.initial_variance if variance >= UNMEASURED else variance


def complementary(pixel, settings, times, on, off):
    """L(t) of one pixel: dL/dt = e - alpha (L - L^F), frames held from the middle of their exposure."""
    i0, alpha = settings.camera.offset, 2 * np.pi * settings.filter.cutoff
    frames = [np.log(i + i0) for i in pixel.intensity]
    out = []
    for t in times:
        value, at = frames[0], pixel.middles[0]
        changes = [(m, 0, k) for k, m in enumerate(pixel.middles[1:], 1) if m < t]
        changes += [(q, -1, on if p else -off) for q, p, *_ in pixel.events if at < q <= t]
        k = 0
        for q, kind, what in sorted(changes, key=lambda change: change[:2]):
            value = frames[k] + (value - frames[k]) * np.exp(-alpha * (q - at) * US)
            at = q
            if kind == 0:
                k = what
            else:
                value += what
        out.append((frames[k] + (value - frames[k]) * np.exp(-alpha * (t - at) * US), np.nan))
    return np.array(out)


def is_moving(pixel, t):
    """K11, K12: whether an event comes in this frame interval or came in the one before, or no frame measures."""
    middles, first = pixel.middles, pixel.starts[0]
    k = sum(m < t for m in middles) - 1  # segments end where the next one's frame is read
    since, until = first, t
    if k >= 0:
        seconds = middles[k] - middles[k - 1] if k > 0 else 0.04e6
        since = max(middles[k] - round(seconds), first)
    if k + 1 < len(middles):
        until = middles[k + 1]
    return is_unmeasured(pixel, t) or any(since < q <= until for q, *_ in pixel.events)


def is_unmeasured(pixel, t):
    """Whether neither frame around measures the pixel."""
    k = sum(m < t for m in pixel.middles) - 1
    return not any(pixel.measured[max(k, 0) : k + 2])


def kept_white(value, pixel, t, white, offset):
    """K12: the least intensity of a pixel that the frames around clip, given its L."""
    top = np.log(white + offset)
    if value <= top - 1 or not is_unmeasured(pixel, t):
        return 0.0
    below = max(top - value, 0.0)
    return np.exp(top - below - below**2 / 0.1) - offset


def silent_change(pixels, place, interval, c2):
    """K11: the mean square change of the silent pixels around from one frame to the next."""
    row, column = place

    whole = sum(q.active[interval] for q in pixels.values()) / len(pixels)

    def usual(place):  # by the share of the pixels around that have events
        near = [
            q.active[interval]
            for p, q in pixels.items()
            if max(abs(p[0] - place[0]), abs(p[1] - place[1])) <= 4
        ]
        return c2 * (0.62 * sum(near) / len(near) + 0.03 * min(max(whole / 0.25, 0.1), 1))

    near = [
        q.changes[interval][2] + (1 - q.told[interval]) * usual((i, j))
        for (i, j), q in pixels.items()
        if abs(i - row) <= 2 and abs(j - column) <= 2 and all(q.changes[interval][:2])
    ]
    return max(sum(near) / len(near), 0.0) if near else usual(place)


def untold(pixels, place, c2, q0):
    """K1: variance of what no event has told of a pixel's change in every frame interval."""
    for k, (measured, silent, *_) in enumerate(pixels[place].changes):
        lost = pixels[place].lost[k]
        if lost is not None:  # K18
            yield q0 + lost
        elif measured and silent and q0 > 0:
            yield max(silent_change(pixels, place, k, c2), 0.003 * c2)
        else:
            yield q0


def forgotten(pixels, place, c2):
    """K11: what the state of a pixel loses in every frame interval."""
    for k, (measured, silent, _, noise, _) in enumerate(pixels[place].changes):
        untold, lost = pixels[place].untold[k], pixels[place].lost[k]
        missed = sum(noise) / (sum(noise) + untold)
        if lost is not None:  # K18
            yield untold * missed**2 if measured else lost
            continue
        yield silent_change(pixels, place, k, c2) * missed**2 if measured and silent else 0.0


def seen(pixels, interval):
    """K18: the intervals up to one that tell of silent pixels: no events are missing in them."""
    lost = next(iter(pixels.values())).lost
    return [k for k in range(interval + 1) if lost[k] is None]


def waits_for_events(pixels, start, end):
    """K18: times of the sensor's events between two frames, all waits for them, those that are long, and the rest."""
    times = sorted(t for pixel in pixels.values() for t, *_ in pixel.events if start < t <= end)
    waits = np.diff([start, *times, end])
    long = waits[waits >= max(np.ceil((end - start) / 20), 1)]
    return times, waits, long, end - start - long.sum()


def lost_time(pixels, start, end):
    """K18: the time between two frames in which events are missing, us; None: frames have to tell."""
    times, waits, long, rest = waits_for_events(pixels, start, end)
    if not len(long):
        return 0
    if rest < (end - start) / 10:
        return None
    digits = sorted(len(f"{wait:b}") for wait in waits[:-1] if wait > 0)
    usual = 2 ** next(d for n, d in enumerate(digits, 1) if sum(e <= d for e in digits) >= 0.9 * len(digits))
    return sum(wait for wait in long if wait * len(times) / rest >= 100 and wait >= 4 * usual)


def lost_changes(pixels, k, on, off, q0, latents):
    """K18: of every pixel, the variance of what events would have told that are missing between two frames.

    ``latents`` makes those of all pixels by what was lost before.
    """
    a, b = next(iter(pixels.values())).middles[k : k + 2]
    lost = lost_time(pixels, a, b)
    if lost == 0:
        return dict.fromkeys(pixels)
    told = {}
    for place, pixel in pixels.items():
        f_on, f_off = pixel.signal[k] if pixel.signal else SURE
        told[place] = sum(
            on * f_on * w if p else -off * f_off * w for t, p, *_, w in pixel.events if a < t <= b
        )
    if lost is None:
        return shown_by_frames(pixels, k, told, on * off, latents)
    found = {}
    for row, column in pixels:
        near = [told[i, j] ** 2 for i, j in pixels if max(abs(i - row), abs(j - column)) <= 4]
        found[row, column] = sum(near) / len(near) * lost / (b - a - lost)
    return found if max(found.values()) > q0 else dict.fromkeys(pixels)


def shown_by_frames(pixels, k, told, c2, latents):
    """K18: the same where hardly an event comes, by the frames; None of all pixels where nothing moved."""
    if len(pixels) < 20:
        return dict.fromkeys(pixels)
    latents()
    beyond, far = {}, 0
    for place, pixel in pixels.items():
        (before, *v_before), (after, *v_after) = pixel.latents[k : k + 2]
        noise = v_before[0] + v_after[0]
        if noise < UNMEASURED:
            square = (after - before - told[place]) ** 2
            far += square > max(16 * noise, 4 * c2)
            beyond[place] = square - noise
    if far < max(0.005 * len(beyond), 20):
        return dict.fromkeys(pixels)
    found = {}
    for row, column in pixels:
        near = [v for (i, j), v in beyond.items() if max(abs(i - row), abs(j - column)) <= 4]
        found[row, column] = max(np.mean(near or [*beyond.values()]), 0.0)
    return found


def lately(values):
    """K11: the mean of up to eight, and of more such that every new one counts an eighth."""
    mean = 0.0
    for n, value in enumerate(values, 1):
        mean = mean + (value - mean) / min(n, 8)
    return mean


def correlated(pixels, interval, c2, q0):
    """K11: sums of C, M and N over the pixels that are silent in this interval and the one before."""
    both, squares, noise = 0.0, 0.0, 0.0
    for q in pixels.values():
        before, now = q.changes[interval - 1], q.changes[interval]
        seen = q.lost[interval - 1] is None and q.lost[interval] is None
        if seen and all(before[:2]) and all(now[:2]):
            a, b = (np.clip(change[4], -np.sqrt(c2), np.sqrt(c2)) for change in (before, now))
            (first, second), weight = now[3], (q0 / (sum(now[3]) + q0)) ** 2
            both += weight * (a * b + first)
            squares += weight * ((a**2 + b**2) / 2 - first - second)
            noise += weight * (first + second)
    return np.array([both, squares, noise])


def half_way(pixels, interval, c2, q0):
    """K11: how far the middle between two frames is off the mean of both, in units of their mean square change."""
    pairs = (correlated(pixels, k, c2, q0) for k in seen(pixels, interval)[1:])
    both, squares, noise = lately(pairs) + np.zeros(3)
    told = both * max(squares, 0) / (squares**2 + noise**2 + (25 * 0.1 * c2) ** 2)
    correlation = np.clip(told, -0.5, 1)
    return 1 / (2 * (1 + correlation)) - 1 / 4


def exposed_as(pixels, start, end, exposed):
    """K11: the share of the time between frames that counts as exposed, E'."""
    pairs, active = 0.0, 0
    for q in pixels.values():
        counts = [
            sum(w for t, p, *_, w in q.events if start < t <= end and p == sign) for sign in (True, False)
        ]
        pairs, active = pairs + min(counts), active + (sum(counts) > 0)
    n = 2 * pairs / max(active, 1)
    x = n * exposed
    if x < 0.01:
        return exposed
    off = 1 + 2 * (x - 1 + np.exp(-x)) / x**2 - 4 * (1 - np.exp(-x / 2)) / x
    return 12 * off / (2 * (1 - np.exp(-n)))


def exposed_around(pixels, pixel, k):
    """K11: E' between frame ``k`` of a pixel and the next."""
    start, end = pixel.middles[k : k + 2]
    exposures = [pixel.ends[i] - pixel.starts[i] for i in (k, k + 1)]
    return exposed_as(pixels, start, end, min(sum(exposures) / 2 / (end - start), 1))


def blurred(pixels, place, t, c2, settings):
    """K11: how far the middle of the exposures around is off their mean, as no event tells."""
    pixel = pixels[place]
    middles = pixel.middles
    k = sum(m < t for m in middles) - 1
    if not 0 <= k < len(middles) - 1 or min(pixel.changes[k][3]) >= UNMEASURED:
        return 0.0
    share = (t - middles[k]) / (middles[k + 1] - middles[k])
    exposed = exposed_around(pixels, pixel, k)
    silent = pixel.changes[k][1]
    change = shown_change(pixels, place, k, c2, settings) if silent else 0.1 * c2
    return 0.06 * exposed**2 * change * (1 - 4 * share * (1 - share))


def lagging(pixel, intensity, t, c2, settings):
    """K11: how far a slow pixel with events is off the light between two frames."""
    middles = pixel.middles
    k = sum(m < t for m in middles) - 1
    if not 0 <= k < len(middles) - 1 or min(pixel.changes[k][3]) >= UNMEASURED or pixel.changes[k][1]:
        return 0.0
    share = (t - middles[k]) / (middles[k + 1] - middles[k])
    growth = (0.02 / max(intensity, 0.005)) ** 1.5
    return 1.5 * 4 * share * (1 - share) * settings.events.lag_variance * c2 * growth


def shown_change(pixels, place, interval, c2, settings):
    """K11: the same for images: what turns back within intervals changes as lately, not as in this interval.

    Of a pixel that one of the frames shows black, no frame says that it changes little.
    """
    if pixels[place].lost[interval] is not None:  # K18
        return shown_change(pixels, place, interval - 1, c2, settings) if interval > 0 else 0.1 * c2
    if any(is_crushed(pixels[place], k, settings.camera) for k in (interval, interval + 1)):
        return 0.4 * c2
    turning = half_way(pixels, interval, c2, settings.events.quantisation_variance * c2)
    change = [silent_change(pixels, place, k, c2) for k in seen(pixels, interval)]
    return change[-1] + min(4 * turning, 1) * (lately(change) - change[-1])


def hidden(pixels, place, moving, t, on, off, settings):
    """K11: the variance of what no event has told, before neighbours are heard, and as it is given out."""
    pixel, c2 = pixels[place], on * off
    middles = pixel.middles
    k = sum(m < t for m in middles) - 1
    if 0 <= k < len(middles) - 1:
        gap = middles[k + 1] - middles[k]
        share = (t - middles[k]) / gap
        between = 4 * share * (1 - share)
        exposed = exposed_around(pixels, pixel, k)
        between += (1 - between) * 0.2 * exposed**2
        of_moving = 0.09 * c2 * between
        still = half_way(pixels, k, c2, settings.events.quantisation_variance * c2)
        still *= between * shown_change(pixels, place, k, c2, settings)
        used = of_moving if moving else still
        _, silent, _, frames, _ = pixel.changes[k]
        waits = silent and min(frames) < UNMEASURED and (moving or max(frames) >= UNMEASURED)
        given = still / 2 + of_moving / 4 if waits else used
        if silent and min(frames) < UNMEASURED <= max(frames):  # nothing ties it at the other frame
            away = share if frames[0] < UNMEASURED else 1 - share
            change = shown_change(pixels, place, k, c2, settings)
            half = half_way(pixels, k, c2, settings.events.quantisation_variance * c2)
            given = (half * change / 2 + 0.09 * c2 / 4) * (between / 2 + (away if away < 1 else 0))
        untied = max(0.09 * c2, of_moving)  # no frame ties what neither measures
        heard = untied if is_unmeasured(pixel, t) else used
        return heard, untied if min(frames) >= UNMEASURED else given
    if moving:
        return 0.09 * c2, 0.09 * c2
    gap = middles[-1] - middles[-2] if k > 0 else USUAL_INTERVAL
    change = shown_change(pixels, place, k - 1, c2, settings) if k > 0 else 0.1 * c2
    changed = min(abs(t - middles[max(k, 0)]) / gap, 1) * change
    return changed, changed


def known(pixel, variance, t, settings, c2, left):
    """K11: P with what the frames around say, of a pixel between two frames; ``left`` is the share that K12 leaves."""
    ev, middles = settings.events, pixel.middles
    k = sum(m < t for m in middles) - 1
    if not 0 <= k < len(middles) - 1:
        return variance
    a, b = middles[k], middles[k + 1]
    share, (first, second) = (t - a) / (b - a), pixel.changes[k][3]
    if min(first, second) >= UNMEASURED:
        variance *= 0.52 * (1 - 0.9 * (1 - left) / 0.3)
    events = sum(w for q, *_, w in pixel.events if a < q <= b)
    between = 4 * share * (1 - share)
    wrong = 0.1 * ev.believed_mismatch**2 * c2 * between * events**2
    lost = pixel.lost[k] or 0.0  # K18
    wrong += between / 4 * lost
    if is_crushed(pixel, k + 1, settings.camera):  # says what others have said
        return variance + wrong
    following = second + (1 - share) * (events * ev.step_noise * c2 + lost)
    if first >= UNMEASURED:  # K4
        following += 0.1 * ev.believed_mismatch**2 * c2 * ((1 - share) * events) ** 2
    common = (pixel.untold[k] / (first + second + pixel.untold[k])) ** 2
    common *= min(first, second) * (1 - between / 2)
    return max(1 / (1 / variance + 1 / following), common) + wrong


def with_pattern(variance, intensity, white, camera):
    """K11: the offsets of stored values that pixels keep in all frames, half a percent where nothing tells them."""
    response = Camera.named(chosen_response(camera.response, None), camera.clipped_from).response
    if response.is_linear:
        return variance + (0.005 * white / (intensity + camera.offset)) ** 2
    least = np.maximum(response.response - 0.005, 0.5 / 255)  # at the levels of the curve
    most = np.minimum(response.response + 0.005, 1.0)
    slopes = (response.inverse(most) - response.inverse(least)) / (most - least)
    given = variance.copy()
    for place in np.ndindex(variance.shape):
        slope = np.interp(intensity[place] / white, response.irradiance, slopes)
        given[place] += (0.005 * slope * white / (intensity[place] + camera.offset)) ** 2
    return given


def with_rounding(variance, intensity, moving, level, offset):
    """K11: a still pixel's frames, with less noise than half a ``level``, have half of their rounding in common."""
    given = variance.copy()
    for place in np.ndindex(variance.shape):
        if not moving[place]:
            given[place] = max(given[place], level**2 / 24 / (intensity[place] + offset) ** 2)
    return given


def averaged(level, variance, hears, rough, apart=1, more=None):
    """K12, of whole images: L, and its variance if errors were independent, of the pixels that hear neighbours.

    ``rough`` is the variance by which pixels one apart differ on one surface, ``more`` how many times that they differ
    from a pixel; neighbours are ``apart``.
    """
    more = np.ones(level.shape) if more is None else more
    out, left = level.copy(), variance.copy()
    around = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
    inside = set(np.ndindex(level.shape))
    for row, column in zip(*np.nonzero(hears), strict=True):
        information, total = 1 / variance[row, column], level[row, column] / variance[row, column]
        for down, right in [(apart * i, apart * j) for i, j in around if (i, j) != (0, 0)]:
            other, distance2 = (row + down, column + right), down**2 + right**2
            if other not in inside:
                continue
            unlike = 0.0
            for i, j in around:
                one, two = (row + i, column + j), (row + down + i, column + right + j)
                if one in inside and two in inside:
                    noise = variance[one] + variance[two] + rough[min(one, two)] * distance2 / 8
                    unlike += (level[two] - level[one]) ** 2 / noise
            weight = (1 + unlike / 18) ** -2 / (
                variance[other] + more[row, column] * rough[other] * distance2
            )
            information, total = information + weight, total + weight * level[other]
        out[row, column], left[row, column] = total / information, 1 / information
    return out, left


def regularised(level, variance, moving, rough):
    """K12, of whole images: L and its variance."""
    out, left = averaged(level, variance, moving, rough)
    return out, 0.7 * variance + 0.3 * left


def texture(pixels, shape, t, difference):
    """K12: by how much neighbours differ, squared, on what the frames around show. Of a sensor of one part."""
    usual = difference**2
    middles = next(iter(pixels.values())).middles
    latest = sum(m < t for m in middles) - 1
    frames = [k for k in (latest, latest + 1) if 0 <= k < len(middles)]
    more, sure = 6 / usual, 6 / usual**2
    for k in [k for k in frames if k > 0]:
        for one, two in itertools.combinations(np.ndindex(shape), 2):
            distance2 = (two[0] - one[0]) ** 2 + (two[1] - one[1]) ** 2
            (before, v_before), (after, v_after) = pixels[one].latents[k], pixels[two].latents[k]
            moving = min(pixels[place].active[k - 1] for place in (one, two)) >= 0.5
            if distance2 <= 2 and moving and max(v_before, v_after) < UNMEASURED:
                expected = v_before + v_after + distance2 * usual
                more += distance2 * ((after - before) ** 2 - 0.7 * (v_before + v_after)) / expected**2
                sure += distance2**2 / expected**2
    shown = np.sqrt(np.clip(more / sure, usual / 100, usual) * usual)
    return np.array(
        [
            [
                shown if all(pixels[row, column].latents[k][1] < UNMEASURED for k in frames) else usual
                for column in range(shape[1])
            ]
            for row in range(shape[0])
        ]
    )


def is_surface(pixels):
    """K12: whether pixels that no frame around measures make up a surface. Of a sensor of one part."""
    return np.count_nonzero(pixels) >= 16


def median_around(values, place):
    """Of a pixel and its eight neighbours; beyond the border the nearest pixels count."""
    rows, columns = (
        np.clip([at - 1, at, at + 1], 0, size - 1) for at, size in zip(place, values.shape, strict=True)
    )
    return np.median(values[np.ix_(rows, columns)])


def roughness(level, variance, surface, usual):
    """K12: the variance by which pixels one apart differ on a surface and beside it. Of a sensor of one part."""
    more, sure = 6 / usual, 6 / usual**2
    for one in np.ndindex(level.shape):
        for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
            two = one[0] + down, one[1] + right
            if two not in set(np.ndindex(level.shape)) or not (surface[one] or surface[two]):
                continue
            distance2, noise = down**2 + right**2, variance[one] + variance[two]
            expected = noise + usual * distance2
            square = min((level[one] - level[two]) ** 2, 4 * expected)
            more += distance2 * (square - 0.7 * noise) / expected**2
            sure += distance2**2 / expected**2
    found = np.clip(more / sure, 0.01 * usual, 1.25**2 * usual)
    rough = np.full(level.shape, usual)
    for row, column in zip(*np.nonzero(surface), strict=True):
        rough[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = (found + usual) / 2
    rough[surface] = found
    return rough


def smoothed_surfaces(level, variance, surface, difference, white):
    """K12, of whole images: L and its variance on surfaces that no frame around measures."""
    rough, more = roughness(level, variance, surface, difference**2), np.ones(level.shape)
    for place in np.ndindex(level.shape):
        more[place] = (1 + 0.4 * np.clip(median_around(level, place) - white - 2, 0, 2)) ** 2
    near, left = averaged(level, variance, surface, rough, more=more)
    far, independent = averaged(near, left, surface, 20 * rough, apart=2, more=more)
    return far, 0.7 * variance + 0.3 * independent


def steps(rows, columns):
    """Distance in steps to neighbours, diagonal ones, and knight's moves, as long as OpenCV's 5x5 mask has them."""
    less, more = sorted((abs(rows), abs(columns)))
    if more >= 2 * less:
        return 2.1969 * less + more - 2 * less
    return 2.1969 * (more - less) + 1.4 * (2 * less - more)


def below_white(split, settings, k):
    """Pixels that frame ``k`` clips, and how far the others are below white, log intensity."""
    camera = Camera.named(chosen_response(settings.camera.response, None), settings.camera.clipped_from)
    first = np.ceil(settings.camera.clipped_from * 255) / 255
    found = {place for place, pixel in split.items() if pixel.clipped[k]}
    top = next(iter(split.values())).white[k]
    if found:
        top *= camera.response.inverse(np.array(first))
    darker = {q: np.log(top) - np.log(max(p.intensity[k], 1e-30)) for q, p in split.items() if q not in found}
    return found, {q: min(max(value, 0.0), 10.0) for q, value in darker.items()}


def mean_hardness(found, darker):
    """K15: of the pixels beside clipped ones; 1 where there are none."""
    hard = []
    for row, column in darker:
        around = {(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
        if around & found:
            darkest = max(darker.get(q, 0.0) for q in around)
            hard.append(darkest / (darkest + 0.05))
    return np.mean(hard) if hard else 1.0


def told_by_events(split, settings, k):
    """K15: E, U, E_r and S_r of the interval that ends at frame ``k``. Of a sensor of one part."""
    found, darker = below_white(split, settings, k)
    height, width = (1 + max(places) for places in zip(*split, strict=True))

    def signal_events(pixel):
        shares = pixel.signal[k - 1] if pixel.signal else (1.0, 1.0)
        inside = (e for e in pixel.events if pixel.middles[k - 1] < e[0] <= pixel.middles[k])
        return sum(e[-1] * shares[not e[1]] for e in inside)

    def slope(row, column):
        step = [0.0, 0.0]
        if 0 < row < height - 1:
            step[0] = (darker.get((row + 1, column), 0.0) - darker.get((row - 1, column), 0.0)) / 2
        if 0 < column < width - 1:
            step[1] = (darker.get((row, column + 1), 0.0) - darker.get((row, column - 1), 0.0)) / 2
        return np.hypot(*step)

    unknown = [pixel for pixel in split.values() if pixel.shown > k]
    rim = [
        place
        for place, value in darker.items()
        if value < 0.7 and any(max(abs(place[0] - r), abs(place[1] - c)) <= 2 for r, c in found)
    ]
    events, rim_events = (sum(map(signal_events, some)) for some in (unknown, [split[q] for q in rim]))
    return np.array([events, len(unknown), rim_events, sum(slope(*place) for place in rim)])


def limited(excess, told, hard):
    """K15: what frames make expect, limited by what events tell; ``told``: from `told_by_events`, of all intervals."""
    events, count, rim_events, rim_slope = 1.3 * told
    if count == 0 or rim_events == 0 or rim_slope == 0 or hard == 1:
        return excess
    slope = (events + 3) / (count * rim_events / rim_slope)
    return excess / np.sqrt(1 + (excess / (10 * slope + 2 * 0.05 * hard / (1 - hard))) ** 2)


def inside_whites(split, settings, frames, k, of_all=None):
    """K15: how far above white pixels are that frame ``k`` clips, not beside others. Of a sensor of one part.

    ``of_all``: numbers of pixels just below white and of clipped ones, in all frames that count; else of this one.
    """
    camera = Camera.named(chosen_response(settings.camera.response, None), settings.camera.clipped_from)
    edges = camera.response(np.array([0.475, 0.95]))
    half, white = (np.count_nonzero(frames[0].image / 255 >= edge) for edge in edges)
    fall = np.log(max(half, white) / white) if white else np.inf
    most = min(min(max(np.log(2) / max(fall, 1e-3), 0.3), 2.0) - 0.275, 0.5)
    found, darker = below_white(split, settings, k)
    below, area = sum(value < 0.2 for value in darker.values()), len(split)
    near, clipped = (below, len(found)) if of_all is None else of_all
    share = 0.1 * near / max(clipped, 1) + 1e-4
    scale = 0.2 * (len(found) + 0.1 * area) / (below + share * area)
    return most * (1 - np.exp(-settings.filter.unshown_tail * scale / most)) * mean_hardness(found, darker)


def beyond_rims(split, settings, frames, k):
    """K15: how far above white pixels are that frame ``k`` clips, from those around. Of a sensor of one part."""
    near = clipped = 0
    for j in range(k + 1):
        found, darker = below_white(split, settings, j)
        near, clipped = near + sum(value < 0.2 for value in darker.values()), clipped + len(found)
    level = inside_whites(split, settings, frames, k, (near, clipped))
    size = sum(frames[k].image.shape)  # where all is clipped
    far = {p: min((steps(p[0] - q[0], p[1] - q[1]) for q in darker), default=size) for p in found}
    return {p: level * (1 - np.exp(-distance)) for p, distance in far.items()}


def known_of_unshown(split, settings, frames, looked):
    """K15, after the frame ``looked``: what is expected of every pixel, and what makes more or less of that."""
    excess, likely, by_events = {}, {}, np.zeros(4)
    for k in range(looked + 1):
        for place, level in beyond_rims(split, settings, frames, k).items():
            if split[place].shown > k and (k == 0 or split[place].raised[k - 1]):
                excess[place] = min(excess.get(place, np.inf), level)
        if k > 0 and any(p.shown > k - 1 for p in split.values()):
            by_events += told_by_events(split, settings, k)
        hard = mean_hardness(*below_white(split, settings, k))
        for place, level in excess.items():
            if split[place].shown > k:
                likely[place] = limited(level, by_events, hard) if k else level
    told = [(p, likely[place]) for place, p in split.items() if 0 < p.shown <= looked]
    gone, gone_foretold = (
        sum(of) for of in ([p.excess for p, _ in told if p.gone], [e for p, e in told if p.gone])
    )
    told_of_all = gone_foretold / (gone_foretold + 100)
    of_all = ((5 + gone) / (5 + gone_foretold)) ** told_of_all
    of_all *= settings.filter.believed_unshown_scale ** (1 - told_of_all)
    left = [(p.excess, e) for p, e in told if p.left]
    total, foretold = sum(p for p, _ in left), of_all * sum(e for _, e in left)

    def corrected(level):
        usual = of_all * level
        scaled = usual * (total + 5) / (foretold + 5)
        return min(scaled, usual + max(total - foretold, 0.0) / (len(left) + 10))

    return likely, corrected, by_events, lambda level: (3 * of_all * level) ** 2 * 5 / (foretold + 5)


def unshown(split, settings, frames, t):
    """K15: (2, H, W) how far above their bounds pixels are expected that no frame has shown, and the variance of that.

    nan where a frame has. Of a sensor no larger than one part.
    """
    looked = min(sum(f.middle < t for f in frames), len(frames) - 1)  # the newest frame that is used
    likely, corrected, _, doubt = known_of_unshown(split, settings, frames, looked)
    out = np.full((2, *frames[0].image.shape), np.nan)
    for place, pixel in split.items():
        if pixel.shown > looked:
            out[0][place], out[1][place] = corrected(likely[place]), doubt(likely[place])
    return out


def expected_of_shown(split, settings, frames, k):
    """K7: how far above white a pixel is expected that frame ``k`` clips and that one has measured."""
    _, corrected, by_events, _ = known_of_unshown(split, settings, frames, k - 1)
    hard = mean_hardness(*below_white(split, settings, k))
    return corrected(limited(inside_whites(split, settings, frames, k), by_events, hard))


def lifted(level, variance, excess, settings, top):
    """K15: where pixels are expected, the variance of that, the excess beyond white, and the noise of the events."""
    filtered = settings.filter
    beyond = settings.events.believed_gain * np.maximum(level - top, 0) / filtered.highlight_scale**2
    excess = np.nan_to_num(excess / (1 + excess * beyond), nan=-1.0)
    where, noise = excess >= 0, np.maximum(variance - filtered.initial_variance, 0)
    spread = np.where(where, np.maximum(excess, 0.3) ** 2 + noise, variance)
    return np.where(where, level + excess, level), spread, np.where(where, excess, 0.0), noise


def intensity(log_intensity, variance, settings, white, unknown_scale):
    """Read-out, K6."""
    i0, scale2 = settings.camera.offset, settings.filter.highlight_scale**2
    top = np.log(white + i0)
    if scale2 > 0 and log_intensity > top:
        excess = settings.events.believed_gain * (log_intensity - top)
        spread = scale2 + settings.events.believed_trust * max(excess**2 - variance, 0)
        trust = spread / (spread + variance)
        believed = excess * trust
        left = variance * trust
        if unknown_scale > 0:
            stretch = unknown_scale / np.sqrt(spread)
            w = lambertw(stretch * believed).real
            believed, left = w / stretch, left * (np.exp(-w) / (1 + w)) ** 2
        believed += scale2 / spread * min(left, believed * np.sqrt(left)) / 2
        log_intensity = top + min(believed, np.log(1e5))
    return max(np.exp(log_intensity) - i0, 0.0)


def reconstruct(events, frames, sensor_size, settings, times):
    """The pixels; of ``times``, (T, H, W) each: L, P, twice what is hidden (K11), who moves; (T, 2, H, W) of K15."""
    kind = settings.filter.kind
    if kind == "cf":
        method, begin = complementary, (frames[0].exposure_start + frames[0].exposure_end) // 2
    else:
        method = bridged if settings.filter.augmentation == "bridge" else paper
        begin = frames[0].exposure_start
    on, off = settings.events.threshold_on, settings.events.threshold_off
    out = np.zeros((5, len(times), *sensor_size))  # outside the bridge nothing is hidden and nobody moves
    every = pixels(events, frames, sensor_size, settings, begin)
    height = sensor_size[0]
    for (row, _), pixel in every.items():
        pixel.late = round((row - (height - 1) / 2) * settings.camera.row_time)
        pixel.reach = round((height - 1) / 2 * abs(settings.camera.row_time))
    more = (trail_scales(every, settings),) if method is bridged else ()
    if method is bridged and settings.events.noise_rate is not None:
        for k in range(len(frames) - 1):
            shares = signal_shares(every, k, settings)
            for place, pixel in every.items():
                pixel.signal.append((shares[True, place], shares[False, place]))
    for pixel in every.values():
        pixel.lost = [None] * (len(frames) - 1)

    def latents():
        for pixel in every.values():
            bridged(pixel, settings, [], on, off, *more)

    for k in range(len(frames) - 1 if method is bridged else 0):
        q0 = settings.events.quantisation_variance * on * off
        for place, lost in lost_changes(every, k, on, off, q0, latents).items():
            every[place].lost[k] = lost
    for (row, column), pixel in every.items():
        out[:2, :, row, column] = method(pixel, settings, times, on, off, *more).T
    if method is not bridged:
        return (
            every,
            out[0],
            out[1],
            out[2:4],
            out[4].astype(bool),
            np.full((len(times), 2, *sensor_size), np.nan),
        )
    for place, pixel in every.items():  # of which nothing depends on it but P and L
        pixel.untold = list(untold(every, place, on * off, settings.events.quantisation_variance * on * off))
        pixel.forgotten = list(forgotten(every, place, on * off))
        pixel.around = [silent_change(every, place, k, on * off) for k in range(len(frames) - 1)]
    beyond = [expected_of_shown(every, settings, frames, k) for k in range(1, len(frames))]
    for pixel in every.values():
        pixel.expected = beyond
    for (row, column), pixel in every.items():
        out[:2, :, row, column] = method(pixel, settings, times, on, off, *more).T
    for (row, column), pixel in every.items():
        for i, t in enumerate(times):
            out[4, i, row, column] = is_moving(pixel, t)
            out[2:4, i, row, column] = hidden(
                every, (row, column), out[4, i, row, column], t, on, off, settings
            )
    expected = np.array([unshown(every, settings, frames, t) for t in times])
    return every, out[0], out[1], out[2:4], out[4].astype(bool), expected


def joined_along(first, second, path, bend, unsure, share, level, variance, c2):
    """L and its variance joined with what both frames show along the paths (K16); ``first``, ``second``: L and V."""
    height, width = level.shape
    of_second = share + ((1 - share) if share <= 0.5 else -share) * (1 - 2 * share) ** 2
    of_second = min(max(of_second, 0.001), 0.999)
    seen, doubt, apart = np.empty(level.shape), np.empty(level.shape), np.empty(level.shape)
    for row, column in np.ndindex(height, width):
        x = column + 4 * share * (1 - share) * bend[0, row, column]
        y = row + 4 * share * (1 - share) * bend[1, row, column]
        step_x, step_y = path[0, row, column], path[1, row, column]
        a = resampled(*first, x - share * step_x, y - share * step_y)
        b = resampled(*second, x + (1 - share) * step_x, y + (1 - share) * step_y)
        seen[row, column] = (1 - of_second) * a[0] + of_second * b[0]
        doubt[row, column] = (1 - of_second) ** 2 * a[1] / 2 + of_second**2 * b[1] / 2
        apart[row, column] = (a[0] - b[0]) ** 2
    fine = (seen - around(seen, 1)) ** 2
    doubt += ((1 - of_second) ** 2 + of_second**2) / 4 * around(apart, 1) + 0.05 * around(fine, 1)
    unexplained = around(apart, 2) / np.maximum(around((first[0] - second[0]) ** 2, 2), 5e-4)
    doubt /= np.maximum(1 - unexplained, 1e-6)
    contradiction = around((level - seen) ** 2 / (variance + doubt + c2 / 4), 2)
    believed = 1 / (doubt * (1 + 4 * np.maximum(contradiction - 1, 0)) ** 2)
    wide = np.pad(seen, 1, mode="reflect")
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    across, down = (rows[:, 2:] - rows[:, :-2]) / 6, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2
    strayed = (4 * share * (1 - share)) ** 2 * unsure * (across**2 + down**2)
    trust = 1 / ((doubt + strayed) * (1 + 0.4 * contradiction) ** 2)
    left = np.maximum(1 / (1 / variance + trust), 0.01 * variance)
    return (level / variance + seen * believed) / (1 / variance + believed), left


def resampled(value, variance, x, y):
    """Between the pixels: Keys' cubic (a = -3/4) of the values, linear of the variances; unmeasured outside."""
    height, width = value.shape
    column, row = int(np.floor(x)), int(np.floor(y))
    level = doubt = 0.0
    for i, j in np.ndindex(4, 4):
        r, c = row - 1 + i, column - 1 + j
        inside = value[min(max(r, 0), height - 1), min(max(c, 0), width - 1)]
        level += keys(y - r) * keys(x - c) * inside
        known = variance[r, c] if 0 <= r < height and 0 <= c < width else 2.0**40
        doubt += max(1 - abs(y - r), 0) * max(1 - abs(x - c), 0) * known
    return level, doubt


def keys(d):
    d, a = abs(d), -0.75
    if d <= 1:
        return (a + 2) * d**3 - (a + 3) * d**2 + 1
    return a * (d**3 - 5 * d**2 + 8 * d - 4) if d < 2 else 0.0


def calmed(image, variance, log_offset, unmeasured):
    """K17; ``unmeasured`` is a (H, W) mask."""
    out = image.astype(float)
    for row in range(1, image.shape[0] - 1):
        for column in range(1, image.shape[1] - 1):
            beside = [(row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column)]
            if not unmeasured[row, column] or not all(unmeasured[at] for at in beside):
                continue
            apart = [(row + a, column + b) for a in (-1, 1) for b in (-1, 1)]
            mean = np.mean([image[at] for at in beside])
            ground = min(mean, np.mean([image[at] for at in apart]))
            error = np.sqrt(sum((image[at] + log_offset) ** 2 * variance[at] for at in beside)) / 4
            most = ground + 8.4 * (mean - ground + error)
            out[row, column] = min(image[row, column], max(most, *(image[at] for at in beside)))
    return out


def around(values, reach):
    """Mean of the square around every pixel; outside, the image is mirrored at its outermost pixels."""
    wide = np.pad(values, reach, mode="reflect")
    size = 2 * reach + 1
    return np.array(
        [
            [wide[row : row + size, column : column + size].mean() for column in range(values.shape[1])]
            for row in range(values.shape[0])
        ]
    )
