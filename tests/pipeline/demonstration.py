"""How much of the demonstration the tests render and run."""

FRAMES = 3  # of its five: one upright, one turned, one mirrored; a run of all five is a study
FEWER_TARGETS = {  # over the same field
    "columns = 6\nrows = 5": "columns = 5\nrows = 4",
    "right = [0.58, 0.0, 0.0]\nup = [0.0, 0.58, 0.0]": "right = [0.72, 0.0, 0.0]\nup = [0.0, 0.77, 0.0]",
    "columns = 3\nrows = 3": "columns = 3\nrows = 2",
    "up = [0.0, 0.85, 0.0]": "up = [0.0, 1.7, 0.0]",
}
