"""Tables of statuses, reason codes, causes of uncertainty, and significance and false-alarm limits of measuring.

The documentation and the report are generated from these tables or checked against them.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Self


class Status(StrEnum):
    """Status of a mark. Only `measured` and `weak` marks are observations of the adjustment."""

    MEASURED = "measured"
    WEAK = "weak"
    PREDICTED = "predicted"
    REJECTED = "rejected"
    ABSENT = "absent"

    @property
    def is_observation(self) -> bool:
        return self in (Status.MEASURED, Status.WEAK)


STATUS_MEANING = {
    Status.MEASURED: "Found, fitted and passed all checks; a deformation of its frame is in its standard deviation.",
    Status.WEAK: "Fitted, but damaged, faint, partly covered or imprecise; its standard deviation allows for it.",
    Status.PREDICTED: "Not found; the coordinates are predicted from the other marks.",
    Status.REJECTED: "Something was measured, but a check shows that it is not this mark.",
    Status.ABSENT: "Not found, outside the scan or unreadable.",
}


class Code(StrEnum):
    """Code of a reason."""

    OUTSIDE = "outside"
    DAMAGED_FILE = "damaged-file"
    FAILED_SCAN = "failed-scan"
    UNREACHABLE = "unreachable"
    NO_FRAME = "no-frame"
    NOT_FOUND = "not-found"
    GROUND = "ground"
    COVERED = "covered"
    CONTRAST = "contrast"
    LIKENESS = "likeness"
    POLARITY = "polarity"
    SIZE = "size"
    SMALL = "small"
    BLUR = "blur"
    NO_FIT = "no-fit"
    IMPRECISE = "imprecise"
    EDGES = "edges"
    DUST = "dust"
    OFF_PLACE = "off-place"
    OFF_FRAMES = "off-frames"
    OFF_GIVEN = "off-given"
    AMBIGUOUS = "ambiguous"
    UNNAMED = "unnamed"
    OWN_PICTURE = "own-picture"
    OTHER_SCANS = "other-scans"
    FEW_SCANS = "few-scans"
    POSE = "pose"
    CHANCE = "chance"
    FAINT_FRAME = "faint-frame"
    OTHER_FRAME = "other-frame"
    BENT_FRAME = "bent-frame"
    BENT_SCANS = "bent-scans"
    PERSPECTIVE = "perspective"
    PITCH = "pitch"
    NO_CHECK = "no-check"
    NO_BOARD = "no-board"
    PLATE = "plate"
    FEW_TIES = "few-ties"
    OTHER_PART = "other-part"
    COPY = "copy"
    SECOND_PICTURE = "second-picture"
    CLICKED = "clicked"
    DECIDED = "decided"


CODE_MEANING = {
    Code.OUTSIDE: "Its place lies outside of the scan, or behind the camera.",
    Code.DAMAGED_FILE: "The scan's file is damaged there.",
    Code.FAILED_SCAN: "The scan could not be measured at all; its failure gives the reason.",
    Code.UNREACHABLE: "The second pass could not read the scan, or its process was killed.",
    Code.NO_FRAME: "No frame of the camera was found in the scan.",
    Code.NOT_FOUND: "No candidate near its place.",
    Code.GROUND: "The background is as light or as dark as the mark: there is no contrast.",
    Code.COVERED: "A part of it is damaged, covered or touched by something.",
    Code.CONTRAST: "Its contrast is low against the noise or the texture around it.",
    Code.LIKENESS: "The image does not match its drawing.",
    Code.POLARITY: "It is light where the marks are dark, or the reverse.",
    Code.SIZE: "Its size or rotation differs from the expected one.",
    Code.SMALL: "It is so small that size, blur and dust cannot be separated.",
    Code.BLUR: "Its blur differs from that of the other marks.",
    Code.NO_FIT: "The fit did not converge, or converged to something else.",
    Code.IMPRECISE: "Its standard deviation is large.",
    Code.EDGES: "Its edges give another position than the fit.",
    Code.DUST: "Dust may hide in it.",
    Code.OFF_PLACE: "Its position contradicts the other marks of the scan, or the orientation.",
    Code.OFF_FRAMES: "Its position contradicts the camera's other frames.",
    Code.OFF_GIVEN: "Its position contradicts the given coordinates.",
    Code.AMBIGUOUS: "Several candidates there may be this mark.",
    Code.UNNAMED: "It could not be identified, or its marker was not read.",
    Code.OWN_PICTURE: "It was learned from this scan alone: nothing checks its place.",
    Code.OTHER_SCANS: "The image around the point, or its position, contradicts the other scans.",
    Code.FEW_SCANS: "Too few scans agree on the point.",
    Code.POSE: "The scan orientation is ambiguous.",
    Code.CHANCE: "The frame may be a false alarm.",
    Code.FAINT_FRAME: "The frame was found only with less background around each mark in the correlation.",
    Code.OTHER_FRAME: "The scan shows another frame as well.",
    Code.BENT_FRAME: "No affine transformation fits the given coordinates to the marks of this frame.",
    Code.BENT_SCANS: "All scans have the same deformation in the scanner's axes.",
    Code.PERSPECTIVE: "The film was photographed obliquely: no affine transformation fits.",
    Code.PITCH: "The marks fit another pixel pitch.",
    Code.NO_CHECK: "There are only as many marks as the transformation needs: no redundancy.",
    Code.NO_BOARD: "The board, or a part of its markers, was not found.",
    Code.PLATE: "The plate in the image contradicts the camera.",
    Code.FEW_TIES: "Fewer natural points were found than wanted.",
    Code.OTHER_PART: "Another part of the same frame shows it.",
    Code.SECOND_PICTURE: "The file holds a second image of full size, or the scan shows a second frame.",
    Code.COPY: "The scan's file is a copy of another one, whose marks are used.",
    Code.CLICKED: "A person pointed at it, and nothing could be matched there.",
    Code.DECIDED: "A person decided so.",
}


class Reason(str):
    """A sentence, or several joined by "; ", with its reason codes; empty if there is no reason."""

    codes: tuple[Code, ...]

    def __new__(cls, sentence: str = "", *codes: Code) -> Self:
        made = super().__new__(cls, sentence)
        made.codes = tuple(dict.fromkeys(codes))
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[str, ...]]:
        return type(self), (str(self), *self.codes)

    @classmethod
    def combine(cls, reasons: Iterable["Reason"]) -> Self:
        """Join all non-empty reasons and their codes."""
        present = [reason for reason in reasons if reason]
        return cls("; ".join(present), *(code for reason in present for code in reason.codes))

    @classmethod
    def read(cls, sentence: str, code: str) -> Self:
        """Read a stored reason. Raises ValueError for an unknown code."""
        return cls(sentence, *(Code(each) for each in code.split()))

    def reword(self, sentence: str) -> Self:
        """Copy of the reason with another sentence and the same codes."""
        return type(self)(sentence, *self.codes)

    @property
    def code(self) -> str:
        """Codes, separated by spaces."""
        return " ".join(self.codes)


NO_REASON = Reason()


class Cause(StrEnum):
    """Cause of a part of a covariance, in the order in which the parts are listed."""

    NOISE = "noise"
    ROUNDING = "rounding"
    SECOND_ORDER = "second order"
    UNLIKE_DRAWING = "unlike drawing"
    DAMAGE = "damage"
    TEXTURE = "texture"
    TONE = "tone"
    SHARPENING = "sharpening"
    CHANGED_TONES = "changed tones"
    LANDSCAPE = "landscape"
    COMPRESSION = "compression"
    TOUCHED = "touched"
    OWN_TURN = "own turn"
    FILM = "film"
    SECOND_METHOD = "second method"
    GIVEN_PLACES = "given places"
    OTHER_FRAMES = "other frames"
    INTERPOLATION = "interpolation"
    CLICK = "click"
    LENS = "taking lens"


CAUSE_MEANING = {
    Cause.NOISE: "Film grain and scanner noise, estimated from the image.",
    Cause.ROUNDING: "Quantisation of the grey values.",
    Cause.SECOND_ORDER: "Second-order effects of position, blur and contrast for a soft and faint mark.",
    Cause.UNLIKE_DRAWING: "Model misfit: at the edges the image differs from the drawing by more than noise.",
    Cause.DAMAGE: "Faint damage may remain around the damaged pixels that were left out.",
    Cause.TEXTURE: "Background texture on one side of its edges.",
    Cause.TONE: "Uncertainty of the tone curve between light and grey values.",
    Cause.SHARPENING: "Uncertainty of the scan's sharpening.",
    Cause.CHANGED_TONES: "A learned mark may have other half tones than in the scans it was learned from.",
    Cause.LANDSCAPE: "The background within a notch has texture.",
    Cause.COMPRESSION: "Loss of the mark's edges by JPEG compression.",
    Cause.TOUCHED: "Something may touch the mark, judging by its size or shape.",
    Cause.OWN_TURN: "Rotation and scale are those of the frame, with its standard deviations; they were not fitted.",
    Cause.FILM: "Film deformation, estimated from the camera's frames.",
    Cause.SECOND_METHOD: "Disagreement with the position from its edges.",
    Cause.GIVEN_PLACES: "Disagreement with the given coordinates.",
    Cause.OTHER_FRAMES: "Disagreement with the camera's other frames.",
    Cause.INTERPOLATION: "Interpolation between the pixels of two scans.",
    Cause.CLICK: "A person pointed at it, and nothing could be matched there.",
    Cause.LENS: "Uncertainty of the lens that photographed the film, from its calibration.",
}


class Limit(float):
    """Significance level, or limit of an expected number of false alarms. of: the event it refers to; decides: the
    consequence beyond the limit."""

    of: str
    decides: str


def _limit(value: float, of: str, decides: str) -> float:
    limit = Limit(value)
    limit.of, limit.decides = of, decides
    return limit


# The search for a frame.
FRAMES_BY_CHANCE = _limit(
    0.01,
    "expected number of false frames, over all attempts so far, or over those at its pitch",
    "a frame found under another pitch, or by the search for faint marks, is rejected",
)
PLACEMENTS_BY_CHANCE = _limit(
    30.0,
    "expected number of false placements with as high a score, before the marks are matched",
    "no frame is measured there",
)
FRAME_BY_CHANCE = _limit(
    0.05, "p-value of the frame, where only some of its marks are found", "its marks are weak, its pose assumed"
)
NO_FRAME = _limit(  # likelier than not
    0.5,
    "p-value of the frame, where only some of its marks are found",
    "none of its marks is an observation: they are predicted",
)
CAMERA_BY_CHANCE = _limit(
    0.01,
    "expected number of false constellations with as high a score",
    "a camera is not named unless its marks correlate half as well at wrong places",
)
CAMERA_BY_NOISE = _limit(
    1e-8,
    "expected number of triples of marks with as high a correlation in noise",
    "a camera whose marks may be false alarms is not matched there",
)
NOISE_LIKE_A_MARK = _limit(
    0.05, "p-value of the highest correlation in the window for noise of its coarseness", "nothing is matched there"
)
TEXTURE_LIKE_A_FAINT_MARK = _limit(  # one in some five hundred places
    1e-4, "p-value of a faint mark's correlation and position for background texture", "the faint mark is rejected"
)
FAINT_MARK_BY_NOISE = _limit(  # counted: in some four hundred places
    1e-3,
    "p-value of a faint mark's correlation and position for noise",
    "it does not count for the frame, which is decided by all its marks together",
)

# The marks of a frame.
MARK_UNLIKE_THE_OTHERS = _limit(
    0.01,
    "probability of flagging any good mark of a frame by its blur, size or rotation",
    "the mark is weak, or not this mark",
)
LARGE_ERROR = _limit(  # it leaves two of 384 such errors in 840 rendered frames of disks unflagged
    0.0015, "probability of an error of half a pixel in a mark with the status measured", "the mark is weak"
)
FALSE_DOUBT = _limit(
    0.01,
    "probability of flagging any good mark of a camera's frames, for each check",
    "a mark is weak, or its frame has a problem",
)
RIGHT_PITCH_REFUSED = _limit(0.01, "probability of rejecting a right pitch", "the frame has a problem")

# Tests of a window before a fit.
NATURAL_END = _limit(  # there are many windows
    1e-6, "p-value of the accumulation of grey values at an end of the range", "they count as clipped"
)
JPEG_GRID = _limit(
    1e-6, "probability of finding the grid of an earlier JPEG in an image without one", "its rounding is counted"
)
JPEG_STEP = _limit(
    0.01, "probability of finding a quantisation step in a coefficient without one", "that step is counted"
)

# Targets and natural points.
DISK_UNLIKE_THE_OTHERS = _limit(
    0.01, "p-value of a right disk's difference from the others of its scan", "the disk is weak: dust may hide in it"
)
TARGET_OFF_PLACE = _limit(1e-3, "p-value of a right target's distance from its predicted place", "the target is weak")
TARGET_ELSEWHERE = _limit(  # one target in a thousand fields of a thousand targets
    1e-6, "p-value of a right target's distance from its predicted place", "the target is rejected"
)
SHEET_POINT_OFF_PLACE = _limit(
    0.01, "p-value of the largest distance of any right point of a sheet, over all images", "the point is weak"
)
SHEET_POINT_ELSEWHERE = _limit(
    1e-4,
    "p-value of the largest distance of any right point of a sheet",
    "the point is rejected, if other pictures show it",
)
POINT_OFF_ITS_NEIGHBOURS = _limit(
    1e-4, "p-value of a right tie point's deviation from its neighbours", "it is left out"
)
POINT_OFF_ITS_RAY = _limit(1e-4, "p-value of a right tie point's distance from the epipolar line", "it is left out")
POINT_REFUSED = _limit(1e-4, "p-value of the tests of a right tie point's image", "it is left out of that scan")

LIMITS = {name: limit for name, limit in dict(globals()).items() if isinstance(limit, Limit)}
