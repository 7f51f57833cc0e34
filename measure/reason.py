"""Why a mark is not simply measured, or what a frame should be looked at for: a sentence, with codes to filter by.

The codes stand in one table, like the statuses: the documentation is checked against it.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Self


class Code(StrEnum):
    """What kind of reason a sentence gives."""

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


MEANING = {
    Code.OUTSIDE: "Its place lies outside of the scan, or behind the camera.",
    Code.DAMAGED_FILE: "The scan's file does not give the pixels there.",
    Code.FAILED_SCAN: "The scan could not be measured at all: its failure says why.",
    Code.UNREACHABLE: "It could not be looked at once more: the scan is gone, or the process that did it was ended.",
    Code.NO_FRAME: "No frame of the camera was found in the scan.",
    Code.NOT_FOUND: "Nothing near its place looks like it.",
    Code.GROUND: "The ground is as light or as dark as the mark: it cannot stand out there.",
    Code.COVERED: "A part of it is damaged, covered or touched by something.",
    Code.CONTRAST: "It hardly stands out of the noise, or of the texture about it.",
    Code.LIKENESS: "Its picture is unlike its drawing.",
    Code.POLARITY: "It is light where the marks are dark, or the reverse.",
    Code.SIZE: "It is larger, smaller or otherwise turned than it should be.",
    Code.SMALL: "It is so small that its size, its blur and dust look alike.",
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
    Code.POSE: "How the frame lies in the scan is not certain.",
    Code.CHANCE: "Chance may have made what was taken for the frame.",
    Code.FAINT_FRAME: "The frame was found only where less about each mark was compared.",
    Code.OTHER_FRAME: "The scan shows another frame as well.",
    Code.BENT_FRAME: "No affine transformation takes the given coordinates to the marks of this frame.",
    Code.BENT_SCANS: "All scans are bent alike in the scanner's axes.",
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
    """A sentence, or some joined by "; ", with the codes of what it says; empty where there is nothing to say."""

    codes: tuple[Code, ...]

    def __new__(cls, sentence: str = "", *codes: Code) -> Self:
        made = super().__new__(cls, sentence)
        made.codes = tuple(dict.fromkeys(codes))
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[str, ...]]:
        return type(self), (str(self), *self.codes)

    @classmethod
    def joined(cls, reasons: Iterable["Reason"]) -> Self:
        """All that are not empty, with the codes of all."""
        told = [reason for reason in reasons if reason]
        return cls("; ".join(told), *(code for reason in told for code in reason.codes))

    @classmethod
    def read(cls, sentence: str, code: str) -> Self:
        """As it was written. Raises ValueError for a code that is not in the table."""
        return cls(sentence, *(Code(each) for each in code.split()))

    def told(self, sentence: str) -> Self:
        """The same reason in another sentence."""
        return type(self)(sentence, *self.codes)

    @property
    def code(self) -> str:
        """Its codes, separated by spaces."""
        return " ".join(self.codes)


NO_REASON = Reason()
