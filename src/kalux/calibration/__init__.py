"""Calibration from a recording itself: `contrast`, the thresholds of the event pixels."""
