"""What measuring hands on: marks with covariance, status and reason, and the frame they were found in."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc

from measure.annotations.fields import Line
from measure.array_types import Array
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.geometry import linear_scale
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import SharpeningScore

Kind = Literal["fiducial", "target", "tie", "join"]
ON_FILM: tuple[Kind, ...] = ("fiducial", "join")  # what is a place of the film, and no point of the object
# Stored results are used again only where this is the same. Raise it whenever scans would be measured otherwise:
# tests/measure/test_revision.py fails where that was forgotten.
MEASURE_REVISION = 22


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """The covariance of a place, (column, row): parts (2, 2) px2 by their causes, independent of one another.

    What is common to several marks of a frame, as `tone` is, is in each of them by its own part.
    """

    parts: Mapping[Cause, Array]

    @classmethod
    def from_noise(cls, px2: Array) -> "Covariance":
        """Of a place of which the noise (2, 2) is all that is known."""
        return cls({Cause.NOISE: np.asarray(px2, float)})

    @cached_property
    def px2(self) -> Array:
        """(2, 2): the sum."""
        return np.asarray(sum(self.parts.values(), np.zeros((2, 2))))

    @property
    def sigmas_px(self) -> dict[Cause, float]:
        """Of each cause the standard deviation of a coordinate, the mean of both; causes that add nothing are left
        out."""
        sigmas = {cause: float(np.sqrt(np.trace(self.parts[cause]) / 2)) for cause in Cause if cause in self.parts}
        return {cause: sigma for cause, sigma in sigmas.items() if sigma > 0}

    def plus(self, cause: Cause, px2: Array) -> "Covariance":
        """With what a cause adds (2, 2); the same where that is nothing."""
        if not np.any(px2):
            return self
        return Covariance({**self.parts, cause: self.parts.get(cause, np.zeros((2, 2))) + px2})

    def through(self, matrix: Array) -> "Covariance":
        """Of a place whose errors are these times a matrix (2, 2)."""
        return Covariance({cause: matrix @ part @ matrix.T for cause, part in self.parts.items()})

    def __repr__(self) -> str:
        return "Covariance(" + ", ".join(f"{cause} {sigma:.3g} px" for cause, sigma in self.sigmas_px.items()) + ")"


@dataclass(frozen=True, repr=False)
class MarkMeasurement:
    """One mark in one scan.

    center_px: (2,) column and row, the centre of the top-left pixel being (0, 0). With status `predicted` it is the
    predicted place, with `absent` it may be None: there is nothing to say.
    covariance: of the centre, by its causes; None where nothing was fitted.
    reason: one sentence, with its codes (`measure.flags`); empty only when the status is `measured`.
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
        sigmas_text = "" if sigmas is None else f"+- ({sigmas[0]:.3f}, {sigmas[1]:.3f})"
        return self.point, str(self.status), place, sigmas_text, str(self.reason)


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
        return None if matrix is None else linear_scale(matrix)

    def marks_because(self, code: Code) -> tuple[MarkMeasurement, ...]:
        """Those of whose reason this is a code."""
        return tuple(mark for mark in self.marks if code in mark.reason.codes)

    def to_pandas(self) -> Any:
        """One row a mark, as pandas.DataFrame, in px. Raises ImportError where pandas is not installed."""
        try:
            import pandas as pd
        except ImportError:
            message = "Tables need pandas, which this installation lacks. Install: pip install pandas."
            raise ImportError(message) from None
        nothing = np.full(2, np.nan)
        places = np.array([nothing if mark.center_px is None else mark.center_px for mark in self.marks]).reshape(-1, 2)
        covariances = (mark.covariance_px2 for mark in self.marks)
        sigmas = [nothing if each is None else np.sqrt(np.diag(each)) for each in covariances]
        columns: dict[str, Any] = {
            name: [str(getattr(mark, name)) for mark in self.marks] for name in ("point", "kind")
        }
        columns |= {"status": [str(mark.status) for mark in self.marks]}
        columns |= dict(zip(("column_px", "row_px"), places.T, strict=True))
        columns |= dict(zip(("sigma_column_px", "sigma_row_px"), np.reshape(sigmas, (-1, 2)).T, strict=True))
        return pd.DataFrame(columns | {"reason": [str(mark.reason) for mark in self.marks]})

    def __repr__(self) -> str:
        counts = Counter(str(mark.status) for mark in self.marks)
        counts_text = ", ".join(f"{count} {status}" for status, count in counts.items())
        pose = "" if self.pose is None else f", pose {self.pose.name}{'' if self.pose.decided else ' (assumed)'}"
        return f"FrameMeasurement({self.image!r}: {counts_text or 'no marks'}{pose})"

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


@dataclass(frozen=True, eq=False)
class SecondPlace:
    """offset_px (2,): the second place less the matched one; covariance_px2 (2, 2): of that difference."""

    offset_px: Array
    covariance_px2: Array

    @property
    def sigmas(self) -> float:
        """The length of the difference in its own standard deviations."""
        return float(np.sqrt(self.offset_px @ np.linalg.solve(self.covariance_px2, self.offset_px)))

    @property
    def chance(self) -> float:
        """The probability that noise alone makes the difference as long."""
        return float(chdtrc(2, self.sigmas**2))


@dataclass(frozen=True, eq=False)
class OwnShape:
    """change (2,): scale and rotation (rad) by the picture alone, less those of the frame, and sigma (2,), their
    standard deviations; on_place (2, 2): px by which the place would follow, did the match not keep to the frame's."""

    change: Array
    sigma: Array
    on_place: Array


@dataclass(frozen=True, eq=False)
class MarkFit:
    """A mark as fitted. Where converged is false, reason says why and the numbers are the last approximations.

    center_px (2,) with its place_covariance, pixel_from_mark (2, 3): of the scan, not of the window. covariance: of all
    unknowns of the `PictureModel` by the noise, None where another model was fitted.
    contrast_dn: the mark's light less the background's, negative for a dark mark; stored_contrast_dn: the same of the
    grey values that the file has. noise_dn: standard deviation of
    one pixel, of a chip's picture after smoothing. damaged_fraction: share of the pixels about the mark, within
    plain_px of it, that were cut out; lost_fraction: of what tells its place in the direction in which least of that is
    left, what was. redundancy: pixels used less unknowns. neighbour_correlation: of the residuals;
    they were taken as white where covariance_is_white. likeness: correlation of the fitted picture with the window,
    less its plane background: 1 for a perfect mark, 0 for none.
    significance: the contrast over its own standard deviation. blur_sigma: of the logarithm of the blur, the pixel's
    share included, and size_sigma of the mark's size; infinite where they were not estimated, or the blur is at an end
    of its range. edges: the mark's place by another method, to compare;
    sloping: an ellipse's, if its paint may grow lighter or darker from side to side. own_shape: what the picture says
    of rotation and scale, where the frame gave them; tone: and of a tone curve that is not known; sharpening: and of
    a scan's sharpening. figures: what is compared with other frames: size_ratio and blur_ratio to the other marks,
    turn_rad where the frame gave the rotation, arm1_ratio ... of a cross; size_sigma ...: of logarithms, of the turn.
    """

    converged: bool
    reason: Reason
    center_px: Array
    place_covariance: Covariance
    pixel_from_mark: Array
    contrast_dn: float = 0.0
    stored_contrast_dn: float = 0.0
    noise_dn: float = 0.0
    blur_px: float = 0.0
    damaged_fraction: float = 0.0
    lost_fraction: float = 0.0
    redundancy: int = 0
    neighbour_correlation: float = 0.0
    covariance_is_white: bool = False
    likeness: float = 0.0
    significance: float = 0.0
    blur_sigma: float = np.inf
    size_sigma: float = np.inf
    edges: SecondPlace | None = None
    sloping: SecondPlace | None = None
    own_shape: OwnShape | None = None
    tone: MarkTone | None = None
    sharpening: SharpeningScore | None = None
    covariance: Array | None = None
    figures: Mapping[str, float] = field(default_factory=dict)

    @property
    def covariance_px2(self) -> Array:
        """(2, 2) of the centre, all causes together."""
        return self.place_covariance.px2

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a coordinate."""
        return float(np.sqrt(np.trace(self.covariance_px2) / 2))

    @property
    def snr(self) -> float:
        return abs(self.contrast_dn) / max(self.noise_dn, 1e-12)
