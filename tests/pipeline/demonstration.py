"""How much of the demonstration the tests render and run."""

FRAMES = 3  # of its five: one upright, one turned, one mirrored; a run of all five is slow
