"""Tables of statuses, reason codes, causes of uncertainty, and significance and false-alarm limits of measuring.

The documentation and the report are generated from these tables or checked against them.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Self


class MeaningfulWord(StrEnum):
    """Words of a table, each with its meaning: a sentence for the user."""

    meaning: str

    def __new__(cls, value: str, meaning: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_, member.meaning = value, meaning
        return member


class Status(MeaningfulWord):
    """Status of a mark. Only `measured` and `weak` marks are observations of the adjustment."""

    MEASURED = (
        "measured",
        "Found, fitted and passed all checks; a deformation of its frame is in its standard deviation.",
    )
    WEAK = "weak", "Fitted, but damaged, faint, partly covered or imprecise; its standard deviation allows for it."
    PREDICTED = "predicted", "Not found; the coordinates are predicted from the other marks."
    REJECTED = "rejected", "Something was measured, but a check shows that it is not this mark."
    ABSENT = "absent", "Not found, outside the scan or unreadable."

    @property
    def is_observation(self) -> bool:
        return self in (Status.MEASURED, Status.WEAK)


class Code(MeaningfulWord):
    """Code of a reason."""

    OUTSIDE = "outside", "Its place lies outside of the scan, or behind the camera."
    DAMAGED_FILE = "damaged-file", "The scan's file is damaged there."
    FAILED_SCAN = "failed-scan", "The scan could not be measured at all; its failure gives the reason."
    UNREACHABLE = "unreachable", "The second pass could not read the scan, or its process was killed."
    NO_FRAME = "no-frame", "No frame of the camera was found in the scan."
    NOT_FOUND = "not-found", "No candidate near its place."
    GROUND = "ground", "The background is as light or as dark as the mark: there is no contrast."
    COVERED = "covered", "A part of it is damaged, covered or touched by something."
    CONTRAST = "contrast", "Its contrast is low against the noise or the texture around it."
    LIKENESS = "likeness", "The image does not match its drawing."
    POLARITY = "polarity", "It is light where the marks are dark, or the reverse."
    SIZE = "size", "Its size or rotation differs from the expected one."
    SMALL = "small", "It is so small that size, blur and dust cannot be separated."
    BLUR = "blur", "Its blur differs from that of the other marks."
    NO_FIT = "no-fit", "The fit did not converge, or converged to something else."
    IMPRECISE = "imprecise", "Its standard deviation is large."
    DUST = "dust", "Dust may hide in it."
    OFF_PLACE = "off-place", "Its position contradicts the other marks of the scan, or the orientation."
    OFF_FRAMES = "off-frames", "Its position contradicts the camera's other frames."
    OFF_GIVEN = "off-given", "Its position contradicts the given coordinates."
    AMBIGUOUS = "ambiguous", "Several candidates there may be this mark."
    UNNAMED = "unnamed", "It could not be identified, or its marker was not read."
    OWN_PICTURE = "own-picture", "It was learned from this scan alone: nothing checks its place."
    OTHER_SCANS = "other-scans", "The image around the point, or its position, contradicts the other scans."
    FEW_SCANS = "few-scans", "Too few scans agree on the point."
    POSE = "pose", "The scan orientation is ambiguous."
    CHANCE = "chance", "The frame may be a false alarm."
    FAINT_FRAME = "faint-frame", "The frame was found only with less background around each mark in the correlation."
    OTHER_FRAME = "other-frame", "The scan shows another frame as well."
    BENT_FRAME = "bent-frame", "No affine transformation fits the given coordinates to the marks of this frame."
    BENT_SCANS = "bent-scans", "All scans have the same deformation in the scanner's axes."
    PERSPECTIVE = "perspective", "The film was photographed obliquely: no affine transformation fits."
    PITCH = "pitch", "The marks fit another pixel pitch."
    NO_CHECK = "no-check", "There are only as many marks as the transformation needs: no redundancy."
    NO_BOARD = "no-board", "The board, or a part of its markers, was not found."
    OTHER_CAMERA = "other-camera", "The fiducials fit another camera of the project."
    PLATE = "plate", "The plate in the image contradicts the camera."
    FEW_TIES = "few-ties", "Fewer natural points were found than wanted."
    OTHER_PART = "other-part", "Another part of the same frame shows it."
    COPY = "copy", "The scan is a copy of another one, or shows the board where that does; its marks are used."
    SECOND_PICTURE = "second-picture", "The file holds a second image of full size, or the scan shows further frames."
    CLICKED = "clicked", "A person pointed at it, and nothing could be matched there."
    DECIDED = "decided", "A person decided so."


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
        """Read a stored reason, without codes that only other versions know."""
        return cls(sentence, *(Code(each) for each in code.split() if each in Code._value2member_map_))

    def reword(self, sentence: str) -> Self:
        """Copy of the reason with another sentence and the same codes."""
        return type(self)(sentence, *self.codes)

    @property
    def code(self) -> str:
        """Codes, separated by spaces."""
        return " ".join(self.codes)


NO_REASON = Reason()


class Cause(MeaningfulWord):
    """Cause of a part of a covariance, in the order in which the parts are listed."""

    NOISE = "noise", "Film grain and scanner noise, estimated from the image."
    MODEL_MISFIT = (
        "unlike drawing",
        "Model misfit: at the edges the image differs from the drawing by more than noise.",
    )
    DAMAGE = "damage", "Faint damage may remain around the damaged pixels that were left out."
    TEXTURE = "texture", "Background texture on one side of its edges, or a pattern over the whole scan."
    TONE = "tone", "Uncertainty of the tone curve between light and grey values."
    SHARPENING = "sharpening", "Uncertainty of the scan's sharpening."
    CHANGED_TONES = "changed tones", "A learned mark may have other half tones than in the scans it was learned from."
    NOTCH_BACKGROUND = "landscape", "The background within a notch has texture."
    COMPRESSION = "compression", "Loss of the mark's edges by JPEG compression."
    TOUCHED = "touched", "Something may touch the mark, judging by its size or shape."
    ROTATION = (
        "own turn",
        "Rotation and scale are those of the frame, with its standard deviations; they were not fitted.",
    )
    FILM = "film", "Film deformation, estimated from the camera's frames."
    SECOND_METHOD = "second method", "Difference of a faint mark's fit from its matched filter."
    GIVEN_PLACES = "given places", "Disagreement with the given coordinates."
    OTHER_FRAMES = "other frames", "Disagreement with the camera's other frames."
    INTERPOLATION = (
        "interpolation",
        "Interpolation between two scans, of a scan enlarged or reduced, or none: nearest neighbours.",
    )
    MOTION = "motion", "Motion blur of the whole scan: the place lies anywhere in it."
    SMEAR = (
        "smear",
        "Blur beyond that of the other marks: something smears it, and the place lies anywhere in that.",
    )
    CLICK = "click", "A person pointed at it, and nothing could be matched there."
    LENS = "taking lens", "Uncertainty of the lens that photographed the film, from its calibration."

    @property
    def shown(self) -> str:
        """Name for readers; files keep the value."""
        names = {
            Cause.MODEL_MISFIT: "model misfit",
            Cause.ROTATION: "rotation",
            Cause.NOTCH_BACKGROUND: "notch background",
        }
        return names.get(self, self.value)


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
MAX_FALSE_FRAMES = _limit(
    0.01,
    "expected number of false frames, over all attempts so far, or over those at its pitch",
    "a frame found under another pitch, or by the search for faint marks, is rejected",
)
MAX_FALSE_PLACEMENTS = _limit(
    30.0,
    "expected number of false placements with as high a score, before the marks are matched",
    "no frame is measured there",
)
FRAME_DOUBT_P = _limit(
    0.05,
    "p-value of the frame, where only some of its marks are found",
    "its marks are weak, its scan orientation assumed",
)
FRAME_REJECTED_P = _limit(  # likelier than not
    0.5,
    "p-value of the frame, where only some of its marks are found",
    "none of its marks is an observation: they are predicted",
)
MAX_FALSE_CAMERAS = _limit(
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
    0.05, "expected number of peaks as high in the window for noise of its coarseness", "nothing is matched there"
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
CLIPPED_END = _limit(  # there are many windows
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
