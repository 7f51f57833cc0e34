"""What a measurement hands on: marks with covariance, status and reason, and the frame they were found in."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from measure.annotations.line import Line
from measure.covariance import Covariance
from measure.reason import NO_REASON, Code, Reason
from measure.status import Status
from measure.tone.estimate import FrameTone

Kind = Literal["fiducial", "target", "tie", "join"]
ON_FILM: tuple[Kind, ...] = ("fiducial", "join")  # what is a place of the film, and no point of the object
Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class MarkMeasurement:
    """One mark in one scan.

    center_px: (2,) column and row, the centre of the top-left pixel being (0, 0). With status `predicted` it is the
    predicted place, with `absent` it may be None: there is nothing to say.
    covariance: of the centre, by its causes; None where nothing was fitted.
    reason: one sentence, with its codes (`measure.reason`); empty only when the status is `measured`.
    quality: named figures of the fit: snr, contrast_dn, blur_px, noise_dn, damaged_fraction, second_method_sigmas, ...
    """

    point: str
    kind: Kind
    center_px: Array | None
    covariance: Covariance | None
    status: Status
    reason: Reason = NO_REASON
    quality: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status.is_observation and (self.center_px is None or self.covariance is None):
            raise ValueError(f"mark {self.point}: a {self.status} mark needs a centre and a covariance")
        if self.status is not Status.MEASURED and not self.reason:
            raise ValueError(f"mark {self.point}: the status {self.status} needs a reason")

    @property
    def covariance_px2(self) -> Array | None:
        """(2, 2) of (column, row), all causes together; None where nothing was fitted."""
        return None if self.covariance is None else self.covariance.px2

    def __repr__(self) -> str:
        return f"MarkMeasurement({self.kind} {' '.join(cell for cell in self.cells() if cell)})"

    def cells(self) -> tuple[str, str, str, str, str]:
        """Name, status, place, standard deviations and reason in words; blank where there is none."""
        place = "" if self.center_px is None else f"({self.center_px[0]:.3f}, {self.center_px[1]:.3f})"
        sigmas = None if self.covariance_px2 is None else np.sqrt(np.diag(self.covariance_px2))
        told = "" if sigmas is None else f"+- ({sigmas[0]:.3f}, {sigmas[1]:.3f})"
        return self.point, str(self.status), place, told, str(self.reason)


@dataclass(frozen=True)
class Pose:
    """How the scan was laid on the scanner: its counter-clockwise turn in degrees, "m" behind it if mirrored.

    A scan of pose "90m": the camera frame (x' right, y' up) is first mirrored (x' to -x'), then turned by 90 degrees
    counter-clockwise, and so seen in the scan.
    decided: whether something in the picture (or the user) decides it; otherwise it is assumed.
    evidence: what speaks for it, and by how much, one sentence each.
    written: log-likelihoods of the poses, by name, by what is written alone; empty where nothing was read. writing: the
    pose in which most of that lies in the scan; "" where that is not clear. roll: what is to be asked once for all
    frames of the camera; "" where there is no such question. rivals: the poses, in the frame's own axes, in which it
    may lie as well, where what is seen does not tell them apart.
    """

    name: str
    decided: bool
    evidence: tuple[str, ...] = ()
    written: Mapping[str, float] = field(default_factory=dict)
    writing: str = ""
    roll: str = ""
    rivals: tuple[str, ...] = ()

    def is_decided_but_for(self, alike: Collection[str]) -> bool:
        """Whether it is decided, or no other than poses under which the marks are alike may be right."""
        return self.decided or bool(self.rivals and set(self.rivals) <= set(alike))


@dataclass(frozen=True, repr=False)
class FrameMeasurement:
    """All marks of one scan.

    pixel_from_camera: (2, 3) affine matrix, camera mm (x', y', 1) to (column, row), from the fiducials found; None
    where there are too few.
    weights: what each channel of a colour scan counts in what its fiducials were measured in; None for its grey value.
    problems: what the user should look at, one sentence each, with its codes.
    tone: what is believed of the curve by which its light was stored; None where no frame was found.
    writing: the lines read about the frame; None where none was looked for.
    """

    image: str
    marks: tuple[MarkMeasurement, ...]
    pose: Pose | None = None
    pixel_from_camera: Array | None = None
    problems: tuple[Reason, ...] = ()
    weights: tuple[float, ...] | None = None
    tone: FrameTone | None = None
    writing: tuple[Line, ...] | None = None

    @property
    def px_per_mm(self) -> float | None:
        """The scale of pixel_from_camera, the mean of both directions; None without one."""
        matrix = self.pixel_from_camera
        return None if matrix is None else float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))

    def marks_because(self, code: Code) -> tuple[MarkMeasurement, ...]:
        """Those of whose reason this is a code."""
        return tuple(mark for mark in self.marks if code in mark.reason.codes)

    def __repr__(self) -> str:
        counts = Counter(str(mark.status) for mark in self.marks)
        told = ", ".join(f"{count} {status}" for status, count in counts.items())
        pose = "" if self.pose is None else f", pose {self.pose.name}{'' if self.pose.decided else ' (assumed)'}"
        return f"FrameMeasurement({self.image!r}: {told or 'no marks'}{pose})"

    def _repr_html_(self) -> str:
        """Its marks, as a notebook shows them."""
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in mark.cells())}</tr>" for mark in self.marks
        )
        head = "".join(f"<th>{name}</th>" for name in ("mark", "status", "column, row (px)", "sigmas (px)", "reason"))
        return f"<p>{escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>"


def moved_frame(frame: FrameMeasurement, shift_px: Array) -> FrameMeasurement:
    """The frame where pixels count from elsewhere: all its places moved by (2,) column and row."""
    return replace(
        frame,
        marks=tuple(_moved_mark(mark, shift_px) for mark in frame.marks),
        pixel_from_camera=None
        if frame.pixel_from_camera is None
        else frame.pixel_from_camera + np.column_stack([np.zeros((2, 2)), shift_px]),
        writing=None if frame.writing is None else tuple(_moved_line(line, shift_px) for line in frame.writing),
    )


def _moved_mark(mark: MarkMeasurement, shift_px: Array) -> MarkMeasurement:
    places = {"junction_col_px": shift_px[0], "junction_row_px": shift_px[1]}
    quality = {key: value + places.get(key, 0.0) for key, value in mark.quality.items()}
    return replace(mark, center_px=None if mark.center_px is None else mark.center_px + shift_px, quality=quality)


def _moved_line(line: Line, shift_px: Array) -> Line:
    outline = tuple((col + float(shift_px[0]), row + float(shift_px[1])) for col, row in line.outline_px)
    return replace(line, outline_px=outline)
