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
    Status.MEASURED: "Found, fitted, and no check doubts this mark; a deformation of its frame is in its sigma.",
    Status.WEAK: "Fitted, but damaged, faint, partly covered or not well known; its standard deviation says how well.",
    Status.PREDICTED: "Not found; the coordinates are predicted from the other marks.",
    Status.REJECTED: "Something was found and measured, but a check says that it is not this mark.",
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
    Code.DAMAGED_FILE: "The scan's file does not give the pixels there.",
    Code.FAILED_SCAN: "The scan could not be measured at all: its failure says why.",
    Code.UNREACHABLE: "The second pass could not reach it: the scan is gone, or the process that did it was ended.",
    Code.NO_FRAME: "No frame of the camera was found in the scan.",
    Code.NOT_FOUND: "No candidate near its place.",
    Code.GROUND: "The background is as light or as dark as the mark: there is no contrast.",
    Code.COVERED: "A part of it is damaged, covered or touched by something.",
    Code.CONTRAST: "It hardly stands out of the noise, or of the texture about it.",
    Code.LIKENESS: "Its picture does not match its drawing.",
    Code.POLARITY: "It is light where the marks are dark, or the reverse.",
    Code.SIZE: "It is larger, smaller or otherwise turned than it should be.",
    Code.SMALL: "It is so small that size, blur and dust cannot be separated.",
    Code.BLUR: "Its blur is another than that of the other marks.",
    Code.NO_FIT: "The fit did not converge, or went to something else.",
    Code.IMPRECISE: "Its standard deviation is large.",
    Code.EDGES: "The place by its edges differs from the fitted one.",
    Code.DUST: "Dust may hide in it.",
    Code.OFF_PLACE: "It lies elsewhere than the other marks of the scan, or its orientation, put it.",
    Code.OFF_FRAMES: "It lies elsewhere than in the camera's other frames.",
    Code.OFF_GIVEN: "It lies elsewhere than the given coordinates put it.",
    Code.AMBIGUOUS: "Several things there may be it.",
    Code.UNNAMED: "Nothing tells which point it is, or its marker was not read.",
    Code.OWN_PICTURE: "It was learned from this scan alone: nothing checks its place.",
    Code.OTHER_SCANS: "The picture about the point, or its place, contradicts the other scans.",
    Code.FEW_SCANS: "Too few scans agree on the point.",
    Code.POSE: "The scan orientation is ambiguous.",
    Code.CHANCE: "The frame may be a false alarm.",
    Code.FAINT_FRAME: "The frame was found only where less about each mark was compared.",
    Code.OTHER_FRAME: "The scan shows another frame as well.",
    Code.BENT_FRAME: "No affine transformation takes the given coordinates to the marks of this frame.",
    Code.BENT_SCANS: "All scans are bent alike in the scanner's axes.",
    Code.PERSPECTIVE: "The film was photographed obliquely: no affine transformation fits.",
    Code.PITCH: "The marks want another pixel pitch.",
    Code.NO_CHECK: "There are no more marks than the transformation needs.",
    Code.NO_BOARD: "The board, or a part of its markers, was not found.",
    Code.PLATE: "The plate in the picture contradicts the camera.",
    Code.FEW_TIES: "Fewer natural points were found than wanted.",
    Code.OTHER_PART: "Another scan of its frame shows it, for that was scanned in parts.",
    Code.SECOND_PICTURE: "Its file holds a further picture of full size, or its scan shows a further frame.",
    Code.COPY: "The scan's file is a copy of another one, whose marks count.",
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
    Cause.NOISE: "Grain of the film and noise of the scanner, as the picture shows them.",
    Cause.ROUNDING: "The grey values are whole numbers.",
    Cause.SECOND_ORDER: "A soft and faint mark's picture bends within the errors of its place, blur and contrast.",
    Cause.UNLIKE_DRAWING: "At its edges the picture differs by more than noise: it is not quite as drawn.",
    Cause.DAMAGE: "Damage that was cut out may go on about it, too faint to stand out.",
    Cause.TEXTURE: "One side of its edges has texture that the other has not.",
    Cause.TONE: "The curve through which light was stored as grey values is not known well enough.",
    Cause.SHARPENING: "By how much the scan was sharpened is not known well enough.",
    Cause.CHANGED_TONES: "A learned mark's half tones may be others than where it was learned.",
    Cause.LANDSCAPE: "The background within a notch has texture.",
    Cause.COMPRESSION: "JPEG rounded the mark's edges away.",
    Cause.TOUCHED: "Something may touch the mark, as its size or shape says.",
    Cause.OWN_TURN: "Its rotation and scale were taken from the frame, not fitted.",
    Cause.FILM: "The film was bent or stretched, as the camera's frames show.",
    Cause.SECOND_METHOD: "Its edges put it elsewhere.",
    Cause.GIVEN_PLACES: "It contradicts the given places.",
    Cause.OTHER_FRAMES: "It contradicts the camera's other frames.",
    Cause.INTERPOLATION: "Two scans have their pixels at other places, and between these no picture is sure.",
    Cause.CLICK: "A person pointed at it, and nothing could be matched there.",
    Cause.LENS: "The lens of the camera that photographed the film is not known better than its calibration says.",
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
    "expected false alarms, as frames in a scan without any, over all attempts so far, or those at its pitch",
    "a frame found under another pitch, or by the search for faint marks, is rejected",
)
PLACEMENTS_BY_CHANCE = _limit(
    30.0,
    "expected false alarms: placements as good, before the marks are matched",
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
    "expected false alarms: constellations as good",
    "a camera is not named unless its marks correlate half as well at wrong places",
)
CAMERA_BY_NOISE = _limit(
    1e-8,
    "triples of marks that noise is expected to make look as much like themselves",
    "a camera whose marks may be false alarms is not matched there",
)
NOISE_LIKE_A_MARK = _limit(
    0.05, "noise as coarse as the window's answering as strongly as the best place", "nothing is matched there"
)
TEXTURE_LIKE_A_FAINT_MARK = _limit(  # one in some five hundred places
    1e-4, "texture feigning a faint mark so strongly so near to its place", "the faint mark is rejected"
)
FAINT_MARK_BY_NOISE = _limit(  # counted: in some four hundred places
    1e-3,
    "noise as strong as a faint mark, as near to its place, in the search for faint marks",
    "it has no part in the frame, which all its marks together decide",
)

# The marks of a frame.
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

# Tests of a window before a fit.
NATURAL_END = _limit(  # there are many windows
    1e-6, "grey values heaping up so at an end by nature", "they count as clipped"
)
JPEG_GRID = _limit(
    1e-6, "a picture without the grid of an earlier JPEG being thought to have one", "its rounding is counted"
)
JPEG_STEP = _limit(0.01, "a coefficient without a step being given one, where there is a grid", "that step is counted")

# Targets and natural points.
DISK_UNLIKE_THE_OTHERS = _limit(
    0.01, "a right disk differing so much from the others of its scan", "the disk is weak: dust may hide in it"
)
TARGET_OFF_PLACE = _limit(1e-3, "a right target lying farther off its place", "the target is weak")
TARGET_ELSEWHERE = _limit(  # one target in a thousand fields of a thousand targets
    1e-6, "a right target lying still farther off", "the target is rejected"
)
SHEET_POINT_OFF_PLACE = _limit(
    0.01, "any right point of a sheet, in all pictures, lying so far off", "the point is weak"
)
SHEET_POINT_ELSEWHERE = _limit(
    1e-4, "any right point of a sheet lying still farther off", "the point is rejected, if other pictures show it"
)
POINT_OFF_ITS_NEIGHBOURS = _limit(
    1e-4, "a right natural point moving so differently from those about it", "it is left out"
)
POINT_OFF_ITS_RAY = _limit(1e-4, "a right natural point lying so far off the epipolar line", "it is left out")
POINT_REFUSED = _limit(1e-4, "a test of its pictures refusing a right natural point", "it is left out of that scan")

LIMITS = {name: limit for name, limit in dict(globals()).items() if isinstance(limit, Limit)}
