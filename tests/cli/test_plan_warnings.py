"""Warnings of what a plan mended; those of thresholds and gaps are tested with ``kalux reconstruct``."""

from __future__ import annotations

import numpy as np

from kalux.calibration.event_layout import LayoutFit
from kalux.calibration.frame_faults import FrameFaults
from kalux.cli.plan_warnings import calibration_warnings, mend_warnings
from kalux.planning.mending import Mends
from kalux.recording import AS_STORED, EventLayout

FAULTY = Mends(
    layout=LayoutFit(EventLayout(mirrored_y=True), 0.8),
    faults=FrameFaults(10, copies=(3,), steps=(5,), gains=np.repeat([1.0, 2.0], 5)),
)


def test_what_is_as_recorded_is_no_warning():
    assert [*mend_warnings(Mends())] == []
    assert [*mend_warnings(Mends(layout=LayoutFit(AS_STORED, 0.7)))] == []


def test_each_mend_is_a_line_with_the_flag_that_turns_it_off():
    gain, left_out, layout = mend_warnings(FAULTY)
    assert gain.endswith("evened out (--camera.even-gain false does not)")
    assert gain.startswith(
        "the brightness of the frames steps at 1 frame, first at frame 5, by up to a factor of 2"
    )
    assert left_out.startswith("left out: 1 frame, first frame 3")
    assert left_out.endswith("(--camera.leave-out-faulty false keeps them)")
    assert layout.startswith("events follow the frames if their y counts from the other side")
    assert layout.endswith("(--events.mend-layout false leaves them as they are)")


def test_a_calibration_has_no_such_flags():
    found = [*calibration_warnings(FAULTY)]
    assert len(found) == 3
    assert not any("--" in text for text in found)


def test_events_that_do_not_belong_to_the_frames_are_calibrations_warning_too():
    (text,) = calibration_warnings(Mends(layout=LayoutFit(AS_STORED, 0.02, contradicts=True)))
    assert text.startswith("the events do not explain how the frames change")


def test_a_gain_that_is_never_steady_is_said_to_go_up_and_down():
    faults = FrameFaults(3, steps=(1, 2), gains=np.array([1.0, 1.2, 0.9]), unsteady=True)
    (line,) = mend_warnings(Mends(faults=faults))
    assert line.startswith(
        "the brightness of the frames goes up and down by a factor of 1.3, and events show no such"
    )
