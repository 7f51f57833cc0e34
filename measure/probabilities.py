"""Every probability at which measuring refuses or doubts something, in one table, from which the documentation is
checked: what it is a probability of, and what depends on it."""


class Limit(float):
    """A probability, or the number of things that chance is expected to make; of: what it is a probability, or a
    number, of; decides: what becomes of what lies beyond it."""

    of: str
    decides: str


def _limit(value: float, of: str, decides: str) -> float:
    limit = Limit(value)
    limit.of, limit.decides = of, decides
    return limit


# The search for a frame.
FRAMES_BY_CHANCE = _limit(
    0.01,
    "frames that chance is expected to find in a scan without any, over all attempts so far, or those at its pitch",
    "a frame under another pitch, or seen at a closer look only, is not taken",
)
PLACEMENTS_BY_CHANCE = _limit(
    30.0,
    "placements as good that chance is expected to make, before the marks are matched",
    "no frame is measured there",
)
FRAME_BY_CHANCE = _limit(
    0.05, "chance having made the frame, where only some of its marks are seen", "its marks are weak, its pose assumed"
)
NO_FRAME = _limit(  # likelier than not
    0.5,
    "chance having made the frame, where only some of its marks are seen",
    "none of its marks is an observation: they are predicted",
)
CAMERA_BY_CHANCE = _limit(
    0.01,
    "constellations that chance is expected to make as good",
    "a camera is not named unless its marks in wrong places look half as much like themselves",
)
CAMERA_BY_NOISE = _limit(
    1e-8,
    "triples of marks that noise is expected to make look as much like themselves",
    "the marks of a camera that chance may have found are not matched there",
)
NOISE_LIKE_A_MARK = _limit(
    0.05, "noise as coarse as the window's answering as strongly as the best place", "nothing is matched there"
)
TEXTURE_LIKE_A_FAINT_MARK = _limit(  # one in some five hundred places
    1e-4, "texture feigning a faint mark so strongly so near to its place", "a faint mark is not taken for seen"
)
FAINT_MARK_BY_NOISE = _limit(  # counted: in some four hundred places
    1e-3,
    "noise looking like a faint mark so strongly so near to its place, at a closer look",
    "it has no part in the frame, which all its marks together decide",
)

# The marks of a frame.
TRUE_MARK_AN_OUTLIER = _limit(
    1e-3, "taking any true mark for an outlier, were the film's deformation random", "it has no part in the frame's fit"
)
MARK_UNLIKE_THE_OTHERS = _limit(
    0.01, "doubting any good mark of a frame by its blur, size or turn", "the mark is weak, or not this mark"
)
LARGE_ERROR = _limit(  # it leaves two of 384 such errors in 840 rendered frames of disks unflagged
    0.0015, "an error of half a pixel in a mark that is called measured", "the mark is weak"
)
FALSE_DOUBT = _limit(
    0.01,
    "any good mark of a camera's frames being doubted, by each check",
    "a mark is weak, or its frame has a problem",
)
RIGHT_PITCH_REFUSED = _limit(0.01, "calling a right pitch wrong", "the frame has a problem")

# What a fit believes of its window.
NATURAL_END = _limit(  # there are many windows
    1e-6, "grey values heaping up so at an end by nature", "they count as clipped"
)
JPEG_GRID = _limit(
    1e-6, "a picture without the grid of an earlier JPEG being thought to have one", "its rounding is counted"
)
JPEG_STEP = _limit(0.01, "a coefficient without a step being given one, where there is a grid", "that step is counted")

# Targets and natural points.
MUCH_DUST = _limit(
    0.05, "much dust on a disk, by what it looks like beside the others", "the disk is unlike the others"
)
TARGET_OFF_PLACE = _limit(1e-3, "a right target lying farther off its place", "the target is weak")
TARGET_ELSEWHERE = _limit(  # in a thousand fields of a thousand targets one is
    1e-6, "a right target lying still farther off", "the target is rejected"
)
SHEET_POINT_OFF_PLACE = _limit(
    0.01, "any right point of a sheet, in all pictures, lying so far off", "the point is weak"
)
SHEET_POINT_ELSEWHERE = _limit(
    1e-4, "any right point of a sheet lying still farther off", "the point is rejected, if other pictures show it"
)
POINT_OFF_ITS_NEIGHBOURS = _limit(1e-4, "a right natural point moving so unlike those about it", "it is left out")
POINT_OFF_ITS_RAY = _limit(1e-4, "a right natural point lying so far off the epipolar line", "it is left out")
POINT_REFUSED = _limit(1e-4, "a test of its pictures refusing a right natural point", "it is left out of that scan")

TABLE = {name: limit for name, limit in dict(globals()).items() if isinstance(limit, Limit)}
