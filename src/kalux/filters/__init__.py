"""The filters: `akf` (14)-(21) in two forms, `complementary`, and `readout` from state to intensity.

Each filter is four functions over explicit values. ``begin(segment, state)`` takes the state at the start of
a segment to a cursor of working arrays; ``advance(segment, cursor, events, noise)`` moves the cursor over
events, in place; ``read(segment, cursor, t)`` evaluates the estimate at t and changes nothing; the state at the
segment's end is what is read there. Splitting a segment's events differently, or reading it more often, cannot
change a bit.
"""
