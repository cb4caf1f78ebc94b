"""How far clipped pixels lie beyond their bounds, of those that a frame has measured before (K7)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from kalux.augmentation.beyond import Beyond, follow_beyond, mean_beyond, nothing_beyond
from kalux.augmentation.bridge import MASKED, UNMEASURED, BridgeNoise, Latent, bridge, nominal_thresholds

SHAPE = (16, 20)
C = 0.2
Q0 = C**2 / 6
NOISE = BridgeNoise(C, C, 0.2 * C**2, Q0)
SECOND = 1_000_000
MIDDLE = (8, 10)


def frame(level=0.0, clipped=None):
    """A frame that shows ``level`` everywhere, and white, of level 0, where it is ``clipped``."""
    clipped = np.zeros(SHAPE, bool) if clipped is None else clipped
    value = np.where(clipped, 0.0, level).astype(np.float32)
    return Latent(value, np.where(clipped, UNMEASURED, 1e-6).astype(np.float32))


def window():
    clipped = np.zeros(SHAPE, bool)
    clipped[4:12, 5:15] = True
    return clipped


def follow(before, first, second, *, on=0, off=0, change=Q0, expected=0.5, q0=Q0):
    """`follow_beyond` from one frame to the next, between which every pixel has ``on`` and ``off`` events.

    Also by how much L has changed in the middle of the image.
    """
    counts = tuple(np.full(SHAPE, n, np.float32) for n in (on, off))
    noise = NOISE._replace(quantisation_variance=q0)
    thresholds = nominal_thresholds(SHAPE, 0.1, np.float32)
    segment, _ = bridge(first, second, counts, thresholds, noise, 0, SECOND)
    plane = np.full(SHAPE, change, np.float32)

    def scale(pixels):
        return np.full(len(pixels), expected, np.float32)

    segment, after = follow_beyond(before, segment, first, second, plane, q0, scale)
    changed = segment.augmented + segment.net + segment.slope - first.value
    return segment, after, float(changed[MIDDLE])


def risen(by=0.05, **given):
    """A window rises to white from ``by`` below it, unheard."""
    return follow(nothing_beyond(), frame(-by), frame(-by, window()), **given)


def of_middle(beyond: Beyond):
    (place,) = np.flatnonzero(beyond.pixels == np.ravel_multi_index(MIDDLE, SHAPE))
    return {name: float(getattr(beyond, name)[place]) for name in ("level", "unheard", "variance", "bound")}


@pytest.mark.parametrize("short", [-0.3, 0.0, 0.05, 0.4])
@pytest.mark.parametrize("scale", [0.02, 0.3, 1e6])
def test_the_mean_beyond_a_bound_is_that_of_the_distribution(short, scale):
    deviation = 0.1

    def density(above):
        return np.exp(-(((short + above) / deviation) ** 2) / 2 - above / scale)

    mass, moment = (
        quad(f, 0, 3, points=[0.1, 0.5], epsabs=0)[0] for f in (density, lambda x: x * density(x))
    )
    found = mean_beyond(*(np.array([x]) for x in (short, deviation**2, scale)))
    assert found == pytest.approx(moment / mass, rel=1e-6)


def test_the_mean_beyond_a_bound_far_below_is_the_way_to_it_and_less_as_less_is_expected():
    def of(scale):
        return mean_beyond(np.array([-10.0]), np.array([0.01]), np.array([scale]))

    assert of(np.inf) == pytest.approx(10.0)
    assert of(0.1) == pytest.approx(10.0 - 0.01 / 0.1)


def test_what_rises_unheard_goes_on_beyond_white():
    """By less than a threshold, and by what has been unheard so far and more."""
    segment, after, changed = risen(0.05)
    assert 0.05 + 0.02 < changed < C
    clipped = window()
    assert np.array_equal(np.sort(after.pixels), np.flatnonzero(clipped))
    now = of_middle(after)
    assert now["level"] + now["unheard"] == pytest.approx(-0.05 + changed, abs=1e-6)
    assert now["level"] == pytest.approx(-0.05, abs=1e-5)
    unclipped = segment.augmented + segment.net + segment.slope
    assert unclipped[~clipped] == pytest.approx(-0.05, abs=1e-5)


def test_less_where_the_surroundings_change_little():
    of_little, of_much = (risen(0.05, change=change)[2] for change in (1e-4, Q0))
    assert 0.05 < of_little < 0.06 < of_much


def test_more_is_not_unheard_than_a_threshold_leaves():
    assert risen(change=Q0)[2] == risen(change=1.0)[2]


def test_less_where_less_is_expected_beyond_white():
    little, much = (risen(0.02, expected=expected)[2] for expected in (0.02, 2.0))
    assert 0.02 < little < 0.8 * much
    assert risen(0.02, expected=0.0)[2] == pytest.approx(0.02, abs=2e-3)


def test_events_that_lead_beyond_white_say_it_themselves():
    _, after, changed = risen(0.05, on=3)
    assert changed == pytest.approx(3 * C, abs=1e-4)
    assert of_middle(after)["unheard"] == 0.0


def test_a_silent_pixel_may_rise_on_from_frame_to_frame():
    """As long as no event comes; never further than what all that is unheard makes expect."""
    _, beyond, first = risen(0.05, change=1e-3)
    levels = [first]
    for _ in range(12):
        _, beyond, more = follow(beyond, frame(-0.05, window()), frame(-0.05, window()), change=1e-3)
        levels.append(levels[-1] + more)
    assert levels[1] > levels[0] + 1e-3
    assert np.all(np.diff(levels) > -1e-6)
    assert levels[-1] == pytest.approx(levels[-2], abs=1e-6)
    assert of_middle(beyond)["variance"] == pytest.approx(Q0)


def test_a_frame_that_is_exposed_for_longer_takes_nothing_back():
    """Its white is lower; until an event comes the light is as far up as the frame before has shown."""
    _, beyond, _ = risen(0.05)
    lower = frame(-0.3, window())
    lower.value[window()] = -0.2
    _, after, changed = follow(beyond, frame(-0.05, window()), lower)
    assert changed == pytest.approx(0.0, abs=1e-3)
    assert of_middle(after)["bound"] == 0.0
    _, heard, _ = follow(after, lower, lower, off=1)
    assert of_middle(heard)["bound"] == pytest.approx(-0.2)


def test_an_event_tells_half_of_what_was_added():
    _, beyond, _ = risen(0.05)
    before = of_middle(beyond)["unheard"]
    _, after, changed = follow(beyond, frame(-0.05, window()), frame(-0.05, window()), on=1)
    assert changed == pytest.approx(C - before / 2, abs=2e-3)
    assert of_middle(after)["unheard"] < 2e-3


def test_events_that_lead_back_to_white_add_nothing():
    """What is unheard grows in silence alone."""
    _, beyond, _ = risen(0.05, on=2)
    segment, after, changed = follow(beyond, frame(-0.05, window()), frame(-0.05, window()), off=2)
    assert of_middle(after)["unheard"] == 0.0
    assert changed == pytest.approx(-2 * C, abs=1e-3)
    assert segment.floor is not None  # which raises it at the start, by what the next bound asks for
    assert of_middle(after)["level"] == pytest.approx(0.0, abs=1e-6)


def test_a_frame_that_measures_a_pixel_ends_it():
    _, beyond, _ = risen()
    _, after, _ = follow(beyond, frame(-0.05, window()), frame(-0.05))
    assert len(after.pixels) == 0


def test_a_masked_pixel_is_not_bounded():
    masked = frame(-0.05, window())
    masked.variance[window()] = MASKED
    _, after, changed = follow(nothing_beyond(), frame(-0.05), masked)
    assert len(after.pixels) == 0
    assert changed == pytest.approx(0.0, abs=1e-6)


def test_pixels_that_no_frame_has_measured_are_not_among_them():
    _, after, _ = follow(nothing_beyond(), frame(-0.05, window()), frame(-0.05, window()))
    assert len(after.pixels) == 0


def test_what_cannot_be_unheard_is_not():
    """With q_0 = 0 events tell all."""
    segment, after, _ = risen(q0=0.0)
    assert len(after.pixels) == 0
    assert np.all(segment.slope == 0)


def test_what_is_expected_is_asked_only_where_a_frame_is_clipped():
    first, second = frame(-0.05), frame(-0.05)
    counts = (np.zeros(SHAPE, np.float32),) * 2
    thresholds = nominal_thresholds(SHAPE, 0.1, np.float32)
    segment, _ = bridge(first, second, counts, thresholds, NOISE, 0, SECOND)

    def expected(_):
        raise AssertionError

    change = np.full(SHAPE, Q0, np.float32)
    assert follow_beyond(nothing_beyond(), segment, first, second, change, Q0, expected)[0] is segment
