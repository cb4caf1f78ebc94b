"""What the pixels around tell of those that no frame has shown yet, and what those that leave saturation tell."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.augmentation.bridge import (
    MASKED,
    UNMEASURED,
    BridgeNoise,
    Latent,
    Revealed,
    bridge,
    nominal_thresholds,
)
from kalux.augmentation.highlights import (
    FrameHighlights,
    Tail,
    above_frames,
    begin_unshown,
    border_hardness,
    excess_from_surroundings,
    expected_excess,
    follow_unshown,
    of_both,
    scale_of_all,
    weights_of_both,
)
from kalux.augmentation.parts import weighted_sums

from builders import printed_on_threads

SIZE = (40, 48)
TAIL = Tail(0.5, 0.5)
EVERYWHERE = np.ones(SIZE, bool)
STILL = np.zeros(SIZE, np.float32)
MOVED = 0.1
NOISE = 1e-4


def latent(clipped, value=0.0):
    """A frame that shows ``value`` where it is not clipped, and its bound, 0, elsewhere."""
    level = np.where(clipped, 0.0, value).astype(np.float32)
    return Latent(level, np.where(clipped, UNMEASURED, NOISE).astype(np.float32))


def frame_highlights(clipped, darker=1.0, pitch=1):
    below = np.where(clipped, 0.0, darker).astype(np.float32)
    return FrameHighlights(clipped, below, ~clipped, pitch)


def begun(clipped, darker=1.0):
    return begin_unshown(latent(clipped), frame_highlights(clipped, darker), TAIL)


def followed(memory, clipped, value, net, events=(STILL, STILL)):
    """The next frame, which is ``value`` where it is not ``clipped``."""
    noise = np.full(len(memory.pixels), NOISE, np.float32)
    return follow_unshown(
        memory, latent(clipped, value), frame_highlights(clipped, -value), noise, net, events, MOVED, TAIL
    )


def excess_at(memory):
    found = expected_excess(memory, np.ones(SIZE, np.float32), 1.0)
    out = np.full(SIZE, np.nan)
    out.reshape(-1)[found.pixels] = found.excess
    return out


def around(seen, tail=TAIL):
    """`excess_from_surroundings` as an image; nan where nothing is clipped."""
    pixels = np.flatnonzero(seen.clipped)
    out = np.full(seen.clipped.shape, np.nan)
    near = (seen.measured & (seen.darker < 0.2)).sum() / max(len(pixels), 1)
    out.reshape(-1)[pixels] = excess_from_surroundings(seen, border_hardness(seen), pixels, near, tail)
    return out


def window(shape=SIZE, sides=np.s_[12:28, 14:34]):
    clipped = np.zeros(shape, bool)
    clipped[sides] = True
    return clipped


def striped():
    """Half of every part is clipped, half just below white; the clipped ones are expected to lie by 0.5 above it."""
    clipped = np.broadcast_to(np.arange(48) % 8 >= 4, SIZE)
    memory = begun(clipped, 0.1)
    high = np.full(len(memory.pixels), 0.5, np.float32)
    return clipped, memory._replace(excess=high, limited=high, expected=high)


def uniform(events):
    return np.full(SIZE, events / 2, np.float32), np.full(SIZE, events / 2, np.float32)


def test_where_nothing_is_clipped_nothing_is_expected():
    assert expected_excess(begun(np.zeros(SIZE, bool)), np.ones(SIZE), 1.0) is None


def test_masked_pixels_have_no_bound():
    first = latent(EVERYWHERE)
    first.variance[:, 5] = MASKED
    memory = begin_unshown(first, frame_highlights(EVERYWHERE), TAIL)
    assert not np.isin(np.arange(40) * 48 + 5, memory.pixels).any()


def test_where_all_is_white_it_is_the_most():
    np.testing.assert_allclose(excess_at(begun(EVERYWHERE)), 0.5, rtol=1e-6)


def test_a_tail_of_pixels_just_below_white_goes_on():
    """Half of every part is clipped, half just below: the scale is 0.2, of which half is expected, softly bounded."""
    clipped = np.zeros(SIZE, bool)
    clipped[:, ::2] = True
    found = around(frame_highlights(clipped, 0.1), Tail(0.5, 0.5))
    hard, inside = 0.1 / (0.1 + 0.05), 1 - np.exp(-1)
    expected = 0.5 * (1 - np.exp(-0.1 / 0.5)) * hard * inside
    np.testing.assert_allclose(found[:, ::2], expected, rtol=2e-3)


def test_the_share_and_the_most_that_are_expected():
    clipped = np.zeros(SIZE, bool)
    clipped[:, ::2] = True
    seen = frame_highlights(clipped, 0.1)
    doubled, wide = around(seen, Tail(1.0, 1.0)), around(seen, Tail(0.5, 0.5))
    np.testing.assert_allclose(doubled[clipped], 2 * wide[clipped], rtol=1e-5)
    assert np.nanmax(around(frame_highlights(window(), 3.0), Tail(0.5, 0.05))) == pytest.approx(
        0.05, rel=0.02
    )


def test_beyond_a_soft_border_less_is_expected_than_beyond_a_hard_one():
    soft, hard = (around(frame_highlights(window(), darker))[20, 24] for darker in (0.02, 2.0))
    assert 0 < soft < 0.1 * hard


def test_at_the_border_less_is_expected_than_inside():
    found = around(frame_highlights(window(), 2.0))[20, 14:24]
    assert (np.diff(found) > -1e-3).all()
    assert found[0] == pytest.approx(found[-1] * (1 - np.exp(-1)), rel=0.05)


def test_two_windows_of_their_own():
    """One in the dark, one on a bright wall."""
    clipped = window(sides=np.s_[14:26, 4:16]) | window(sides=np.s_[14:26, 32:44])
    darker = np.where(np.arange(48) < 24, 2.0, 0.05) * np.ones(SIZE)
    found = around(frame_highlights(clipped, darker))
    assert found[20, 10] > 3 * found[20, 38]


def test_pixels_of_a_mosaic_have_neighbours_of_their_colour():
    """Only one colour is clipped: its borders are with its own pixels, two apart."""
    clipped = np.zeros(SIZE, bool)
    clipped[12:28:2, 14:34:2] = True
    found = around(frame_highlights(clipped, 2.0, pitch=2))
    assert found[12, 14] == pytest.approx(found[18, 22] * (1 - np.exp(-2)), rel=0.05)
    assert found[18, 22] > 1.3 * around(frame_highlights(clipped, 2.0))[18, 22]


def test_masked_pixels_are_no_border():
    clipped = window()
    seen = frame_highlights(clipped, 0.01)
    masked = np.zeros(SIZE, bool)
    masked[:, 34] = True
    darker = np.where(masked, 0.0, seen.darker).astype(np.float32)
    without = around(FrameHighlights(clipped, darker, ~clipped & ~masked))
    assert np.nanmax(without) < 0.2


def of_all(told, foretold):
    """The scale of the whole image."""
    return ((told + 5) / (foretold + 5)) ** (foretold / (foretold + 100))


def test_pixels_around_tell_and_far_ones_do_not():
    """Half of a block leaves saturation by events of -1, and is measured at -0.7: it was 0.3 above its bound."""
    left = np.zeros(SIZE, bool)
    left[:16, :8] = True
    memory = begun(EVERYWHERE)
    memory = followed(memory, ~left, -0.7, np.where(left, np.float32(-1.0), np.float32(0.0)))
    found = excess_at(memory)
    np.testing.assert_array_equal(np.isnan(found), left)
    assert found[4, 8] == pytest.approx(0.3, abs=0.02)
    assert found[-1, -1] == pytest.approx(0.5 * of_all(128 * 0.3, 128 * 0.5), abs=1e-3)
    assert (np.diff(found[4, 8:]) >= -1e-6).all()


def alternating():
    told = np.zeros(SIZE, bool)
    told[::2] = True
    weights = (np.exp(-0.5 * np.subtract.outer(np.arange(n), np.arange(n)) ** 2).sum(0) for n in (5, 6))
    rows, columns = weights
    return told, 32 * rows[2] * columns[3]


def test_less_than_expected_scales_what_is_expected():
    """Every second row: 0.2 told of 0.5."""
    told, count = alternating()
    memory = followed(begun(EVERYWHERE), ~told, -0.8, np.where(told, np.float32(-1.0), np.float32(0.0)))
    usual = 0.5 * of_all(960 * 0.2, 960 * 0.5)
    scaled = usual * (0.2 * count + 5) / (usual * count + 5)
    assert excess_at(memory)[2 * 8 + 3, 3 * 8 + 3] == pytest.approx(scaled, rel=2e-3)


def test_more_than_expected_is_added():
    """Every second row: 0.9 told of 0.5, against ten pixels that tell nothing more."""
    told, count = alternating()
    memory = followed(begun(EVERYWHERE), ~told, -0.1, np.where(told, np.float32(-1.0), np.float32(0.0)))
    usual = 0.5 * of_all(960 * 0.9, 960 * 0.5)
    added = usual + (0.9 - usual) * count / (count + 10)
    assert added < usual * (0.9 * count + 5) / (usual * count + 5)
    assert excess_at(memory)[2 * 8 + 3, 3 * 8 + 3] == pytest.approx(added, rel=2e-3)


def test_what_is_expected_is_in_doubt_until_pixels_tell():
    """Where nobody has, the mean has three times itself as its standard deviation."""
    left = np.zeros(SIZE, bool)
    left[:16, :8] = True
    first = begun(EVERYWHERE)
    np.testing.assert_allclose(first.doubt, (3 * 0.5) ** 2, rtol=1e-5)
    second = followed(first, ~left, -0.7, np.where(left, np.float32(-1.0), np.float32(0.0)))
    usual = 0.5 * of_all(128 * 0.3, 128 * 0.5)
    doubt = expected_excess(second, np.ones(SIZE, np.float32), 1.0).doubt
    assert doubt[-1] == pytest.approx((3 * usual) ** 2, rel=1e-3)
    assert doubt[0] < 0.2 * doubt[-1]


def test_pixels_that_noise_takes_out_of_saturation_tell_nothing():
    """2 standard deviations below their bound, and no event: they were at white; those beside need not be."""
    told, _ = alternating()
    memory = followed(begun(EVERYWHERE), ~told, -0.02, STILL)
    assert memory.revealed.pixels.sum() == 0
    assert len(memory.pixels) == 40 * 48 / 2
    np.testing.assert_allclose(memory.expected, 0.5, rtol=1e-6)


def test_what_deblurring_adds_to_the_variance_silences_nobody():
    """Only pixels that move have it."""
    told, _ = alternating()
    memory, net = begun(EVERYWHERE), np.where(told, np.float32(-1.0), np.float32(0.0))
    frame = latent(~told, -0.08)
    moving = frame._replace(variance=np.where(told, np.float32(0.01), frame.variance))
    noise = np.full(len(memory.pixels), NOISE, np.float32)
    events = STILL, STILL
    memory = follow_unshown(memory, moving, frame_highlights(~told, 0.08), noise, net, events, MOVED, TAIL)
    assert memory.revealed.pixels.sum() == told.sum()


def test_silent_pixels_that_leave_saturation_tell_those_near():
    left = np.zeros(SIZE, bool)
    left[:16, :8] = True
    found = excess_at(followed(begun(EVERYWHERE), ~left, -0.08, STILL))
    assert found[4, 8] < 0.1
    assert found[-1, -1] == pytest.approx(0.5, abs=1e-3)


def test_silent_pixels_beside_moving_borders_lie_no_farther_above_white_than_these_are_steep():
    """Two of four pixels of the borders have a slope of 0.05, all have half an event: 20 events a slope of one."""
    clipped, memory = striped()
    at_rims = tuple(np.where(clipped, np.float32(0.0), plane) for plane in uniform(0.5))
    found = excess_at(followed(memory, clipped, -0.1, STILL, at_rims))[2 * 8 + 3, 3 * 8 + 6]
    around = 1.3 * alternating()[1]  # 0.3 of the whole image's counts besides
    most = 10 * 3 / (around * 20) + 2 * 0.1
    assert found == pytest.approx(0.5 / np.sqrt(1 + (0.5 / most) ** 2), rel=2e-3)


def test_events_beyond_white_tell_that_the_light_changes_there():
    """As many events as at the borders: slopes of 0.025 on average, for 10 pixels."""
    clipped, memory = striped()
    found = excess_at(followed(memory, clipped, -0.1, STILL, uniform(0.5)))[2 * 8 + 3, 3 * 8 + 6]
    around = 1.3 * alternating()[1]
    most = 10 * (0.5 * around + 3) / (around * 20) + 2 * 0.1
    assert found == pytest.approx(0.5 / np.sqrt(1 + (0.5 / most) ** 2), rel=2e-3)


def test_where_nothing_moves_silence_tells_nothing():
    clipped, memory = striped()
    np.testing.assert_array_equal(excess_at(followed(memory, clipped, -0.1, STILL)), excess_at(memory))


def test_what_is_limited_is_what_revealed_pixels_are_compared_with():
    clipped, memory = striped()
    at_rims = tuple(np.where(clipped, np.float32(0.0), plane) for plane in uniform(2.0))
    second = followed(memory, clipped, -0.1, STILL, at_rims)
    left = clipped & (np.arange(40)[:, None] < 8)
    third = followed(second, clipped & ~left, -0.1, np.where(left, np.float32(-1.0), np.float32(0.0)))
    gone = left.reshape(-1)[second.pixels]
    assert third.revealed.expected.sum() == pytest.approx(second.limited[gone].sum(), rel=1e-6)
    assert second.limited[gone].sum() < 0.9 * memory.excess[gone].sum()


def test_silence_in_one_direction_limits_what_events_in_the_other_leave_open():
    """As many pixels and slopes are beyond white in both: half of the events per pixel are left."""
    clipped, memory = striped()
    below, rims = np.full(SIZE, -0.1, np.float32), np.where(clipped, np.float32(0.0), np.float32(1.0))
    quiet, loud = (followed(memory, clipped, below, STILL, events) for events in ((rims, rims), uniform(2.0)))
    found = of_both(quiet, loud)
    assert (quiet.limited < found.limited).all()
    assert (found.limited < loud.limited).all()


def test_pixels_that_leave_saturation_in_either_direction_tell():
    clipped, memory = striped()
    fall = np.full(SIZE, -1.0, np.float32)
    columns = np.arange(48)
    first, second = (
        followed(memory, clipped & ~gone, np.where(gone, value, -0.5).astype(np.float32), fall)
        for gone, value in ((clipped & (columns < 16), -0.1), (clipped & (columns >= 32), -0.3))
    )
    found = of_both(first, second)
    np.testing.assert_array_equal(found.pixels, np.flatnonzero(clipped & (columns >= 16) & (columns < 32)))
    for name, of_one, of_other in zip(found.revealed._fields, first.revealed, second.revealed, strict=True):
        np.testing.assert_array_equal(getattr(found.revealed, name), of_one + of_other)
    assert found.revealed.moved_excess == pytest.approx(0.9 * 40 * 8 + 0.7 * 40 * 8)


def test_of_two_expectations_of_the_same_pixels_the_mean_is_that_of_logarithms():
    _, memory = striped()
    twice = memory._replace(excess=2 * memory.excess, bound=memory.bound + 1)
    found = of_both(memory, twice)
    np.testing.assert_allclose(found.expected, 2**0.5 * memory.excess, rtol=1e-6)
    np.testing.assert_allclose(found.doubt, 9 * 2 * memory.excess**2, rtol=1e-6)
    np.testing.assert_array_equal(found.bound, memory.bound + 1)
    again = of_both(twice, memory)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_equal(one, other)


def test_a_direction_whose_bounds_are_lower_tells_less_of_what_lies_above_both():
    """As before a longer exposure: white is lower, and what leaves saturation lay above less."""
    bound, excess = np.linspace(0, 1, 7, dtype=np.float32), np.full(7, 0.5, np.float32)
    assert weights_of_both((bound, bound), (excess, excess)) == (1.0, 1.0)
    assert weights_of_both((bound, bound - 0.5), (excess, excess)) == pytest.approx((1.0, 2.0**-8))
    assert weights_of_both((bound - 0.5, bound), (excess, excess)) == pytest.approx((2.0**-8, 1.0))
    none = np.zeros(0, np.float32)
    assert weights_of_both((none, none), (none, none)) == (1.0, 1.0)


def test_what_leaves_saturation_counts_as_far_as_bounds_are_those_of_both():
    clipped, memory = striped()
    columns, fall = np.arange(48), np.full(SIZE, -1.0, np.float32)
    first, second = (
        followed(memory, clipped & ~gone, np.where(gone, np.float32(-0.2), np.float32(-0.5)), fall)
        for gone in (clipped & (columns < 16), clipped & (columns >= 32))
    )
    found = of_both(first, second._replace(bound=second.bound - second.excess))
    expected = second.revealed.excess / 2**8 + first.revealed.excess
    np.testing.assert_allclose(found.revealed.excess, expected, rtol=1e-3)
    assert 0 < (second.revealed.excess / 2**8).sum() < first.revealed.excess.sum() / 100


@pytest.mark.parametrize("pitch", [1, 2])
def test_slopes_are_per_pixel_in_a_mosaic_too(pitch):
    """Down from a clipped half by 0.1 a pixel. In a mosaic four pixels belong to the rim, not two, and one of them is
    compared with one that lies 0.1 above white and is shown as white."""
    darker = np.broadcast_to(np.maximum(24 - np.arange(48), 0) * np.float32(0.1), SIZE)
    clipped = darker == 0.0
    memory = begun(clipped)
    seen, noise = FrameHighlights(clipped, darker, ~clipped, pitch), np.zeros(len(memory.pixels), np.float32)
    after = follow_unshown(memory, latent(clipped, -1.0), seen, noise, STILL, uniform(1.0), MOVED, TAIL)
    rim = 2 * pitch * SIZE[0]
    assert after.texture.rim_events.sum() == pytest.approx(rim)
    lost = 0.1 / 4 * SIZE[0] if pitch == 2 else 0.0
    assert after.texture.rim_slope.sum() == pytest.approx(0.1 * rim - lost, rel=1e-5)
    assert after.texture.pixels.sum() == clipped.sum()


def test_across_masked_pixels_there_is_no_slope():
    """A flat wall beside a window, masked two pixels beside it: only the row of pixels at the window has one."""
    clipped = np.zeros(SIZE, bool)
    clipped[:, 24:] = True
    darker = np.where(clipped, np.float32(0.0), np.float32(0.1))
    masked = np.zeros(SIZE, bool)
    masked[:, 21] = True
    memory, noise = begun(clipped), np.zeros(clipped.sum(), np.float32)
    seen = FrameHighlights(clipped, np.where(masked, np.float32(0.0), darker), ~clipped & ~masked)
    after = follow_unshown(memory, latent(clipped, -1.0), seen, noise, STILL, uniform(1.0), MOVED, TAIL)
    assert after.texture.rim_slope.sum() == pytest.approx(0.05 * SIZE[0], rel=1e-5)


def test_a_clipped_frame_that_raises_the_bound_tells_of_its_surroundings():
    """The window comes to lie beside pixels just below white. Where it raises no bound that tells nothing."""
    down = np.where(np.arange(48) < 24, np.float32(-0.3), np.float32(0.0)) * np.ones(SIZE, np.float32)
    first = begun(window(), 2.0)
    second = followed(first, window(), -0.02, down)
    before, after = excess_at(first), excess_at(second)
    assert (after[window()][down[window()] < 0] < 0.2 * before[window()][down[window()] < 0]).all()
    np.testing.assert_array_equal(after[:, 24:], before[:, 24:])


def test_a_bound_rises_with_events_and_never_falls_below_a_clipped_frame():
    """Up by 2 and down by 2: where a frame was clipped in between, the level was 0 at least, and 2 at the top."""
    one = np.zeros(SIZE, bool)
    one[0, 0] = True
    step = np.zeros(SIZE, np.float32)
    step[0, 0] = -2.0
    memory = followed(begun(one), one, -1.0, step)
    assert memory.bound[0] == 0.0
    memory = followed(memory, one, -1.0, -step)
    assert memory.bound[0] == 2.0
    memory = followed(memory, np.zeros(SIZE, bool), -1.0, 1.5 * step)
    assert len(memory.pixels) == 0
    assert (memory.revealed.excess.sum(), memory.revealed.pixels.sum()) == (
        0.0,
        1.0,
    )  # -1, as its bound had said


def test_what_came_to_the_variance_is_noise():
    variance = np.full(SIZE, 1.25, np.float32)
    variance[0, 0] = 0.5
    noise = expected_excess(begun(EVERYWHERE), variance, 1.0).noise
    assert (noise[0], noise[1]) == (0.0, 0.25)


def test_a_bound_is_too_high_by_what_it_is_above_the_frames_at_most():
    """Four pixels, clipped at 0 or masked; on events come at the first, off events at the second."""
    first = Latent(np.zeros((1, 4)), np.array([[UNMEASURED] * 3 + [MASKED]]))
    second = Latent(np.zeros((1, 4)), np.array([[UNMEASURED] * 2 + [MASKED] * 2]))
    noise = BridgeNoise(0.5, 0.5, 0.0, 0.0)
    on, off = np.array([[2.0, 0, 0, 0]]), np.array([[0, 2.0, 0, 0]])
    segment, _ = bridge(first, second, (on, off), nominal_thresholds((1, 4), 0.0), noise, 0, 40_000)
    found = above_frames(segment, segment.augmented, np.arange(4), np.array([1.5, 1.5, 1.5, 1.5]))
    np.testing.assert_allclose(found, [1.5, 0.5, np.inf, np.inf])
    np.testing.assert_array_equal(
        above_frames(segment, segment.augmented, np.arange(2), np.array([0.0, 0.5])), [0.0, 0.0]
    )


_SUMS = """
import numpy as np
from kalux.augmentation.parts import weighted_sums
print(weighted_sums(np.random.default_rng(0).random((90, 160))).tobytes().hex())
"""


def test_sums_of_parts_do_not_depend_on_the_number_of_threads():
    """Of 1280 x 720 pixels OpenBLAS's do. What is made of them in float32 hides it nearly always, not always."""
    assert len(printed_on_threads(_SUMS)) == 1


def test_what_was_known_of_the_scale_counts_until_pixels_tell():
    """Of the logarithm as much as pixels that have left saturation do not say."""
    clipped, none = window(), np.zeros((1, 1))
    as_expected, thrice = (
        begin_unshown(latent(clipped), frame_highlights(clipped), TAIL._replace(times=times))
        for times in (1.0, 3.0)
    )
    np.testing.assert_allclose(excess_at(thrice), 3 * excess_at(as_expected), rtol=1e-6)
    np.testing.assert_allclose(thrice.doubt, 9 * as_expected.doubt, rtol=1e-6)
    assert scale_of_all(Revealed(none, none, none, 0.0, 0.0), 3.0) == 3.0
    assert scale_of_all(Revealed(none, none, none, 295.0, 95.0), 3.0) == pytest.approx(3.0)
    half_told = scale_of_all(Revealed(none, none, none, 100.0, 100.0), 3.0)
    assert half_told == pytest.approx(np.sqrt(3.0))


def test_what_was_known_of_the_scale_counts_after_the_next_frame():
    clipped = window()
    seen = [
        followed(begin_unshown(latent(clipped), frame_highlights(clipped), tail), clipped, -1.0, STILL)
        for tail in (TAIL, TAIL._replace(times=0.5))
    ]
    np.testing.assert_allclose(excess_at(seen[1]), excess_at(seen[0]) / 2, rtol=1e-6)


@pytest.mark.parametrize("pitch", [1, 2])
def test_the_hardness_of_borders_is_that_of_the_darkest_pixel_beside_those_beside_clipped_ones(pitch):
    """One colour at a time, and no pixel that is masked."""
    rng = np.random.default_rng(7)
    shape = 16, 24
    clipped = rng.random(shape) < 0.1
    measured = ~clipped & (rng.random(shape) < 0.9)
    darker = np.where(measured, rng.random(shape), 0.0).astype(np.float32)
    sums = np.zeros((2, 2, 3))
    for y, x in np.argwhere(measured):
        around = np.s_[y % pitch :: pitch, x % pitch :: pitch]
        row, column = y // pitch, x // pitch
        near = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if clipped[around][near].any():
            darkest = float(darker[around][near].max())
            sums[:, y // 8, x // 8] += 1.0, darkest / (darkest + 0.05)
    rims, hard = map(weighted_sums, sums)
    found = border_hardness(FrameHighlights(clipped, darker, measured, pitch))
    np.testing.assert_allclose(found, hard / rims, rtol=1e-6)
    nothing = FrameHighlights(np.zeros(shape, bool), darker, measured, pitch)
    assert (border_hardness(nothing) == 1.0).all()
