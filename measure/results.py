"""Results of measuring: marks with covariance, status and reason, and the frame that contains them."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import Any, Literal

import numpy as np

from measure.annotations.lines import Line
from measure.array_types import Array
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.geometry import linear_scale
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import SharpeningScore

CLEAR_LIKENESS = 0.5  # correlation with the drawing: below it most of the image is not the mark
Kind = Literal["fiducial", "target", "tie", "join"]
ON_FILM: tuple[Kind, ...] = ("fiducial", "join")  # kinds that are points of the film, not of the object
# Stored results are reused only if this is unchanged. Increase it whenever measurements would change:
# tests/measure/test_revision.py fails if that was forgotten.
MEASURE_REVISION = 76


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """Covariance of a place (column, row): independent parts (2, 2) px² by their causes.

    A cause common to several marks of a frame, such as `tone`, is included in each of them.
    """

    parts: Mapping[Cause, Array]

    @classmethod
    def from_noise(cls, px2: Array) -> "Covariance":
        """Covariance with noise (2, 2) as its only part."""
        return cls({Cause.NOISE: np.asarray(px2, float)})

    @cached_property
    def px2(self) -> Array:
        """(2, 2) sum of the parts."""
        return np.asarray(sum(self.parts.values(), np.zeros((2, 2))))

    @property
    def sigmas_px(self) -> dict[Cause, float]:
        """Standard deviation of a coordinate by cause, root mean square of both; zero parts are omitted."""
        sigmas = {cause: float(np.sqrt(np.trace(self.parts[cause]) / 2)) for cause in Cause if cause in self.parts}
        return {cause: sigma for cause, sigma in sigmas.items() if sigma > 0}

    @property
    def largest(self) -> Cause:
        """Cause of the largest part."""
        return max(self.parts, key=lambda cause: float(np.trace(self.parts[cause])))

    def plus(self, cause: Cause, px2: Array) -> "Covariance":
        """Add the part (2, 2) of a cause; unchanged if it is zero."""
        if not np.any(px2):
            return self
        return Covariance({**self.parts, cause: self.parts.get(cause, np.zeros((2, 2))) + px2})

    def without(self, cause: Cause) -> "Covariance":
        """Take out the part of a cause."""
        return Covariance({each: part for each, part in self.parts.items() if each is not cause})

    def through(self, matrix: Array) -> "Covariance":
        """Propagate through a matrix (2, 2) that multiplies the errors."""
        return Covariance({cause: matrix @ part @ matrix.T for cause, part in self.parts.items()})

    def __repr__(self) -> str:
        return "Covariance(" + ", ".join(f"{cause} {sigma:.3g} px" for cause, sigma in self.sigmas_px.items()) + ")"


def largest_sigma_px(covariance_px2: Array) -> float:
    """Standard deviation in the direction in which it is largest: semi-major axis of the error ellipse (2, 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance_px2)[-1]))


@dataclass(frozen=True, repr=False)
class MarkMeasurement:
    """Measurement of one mark in one scan.

    Attributes
    ----------
    point : name of the mark or point.
    kind : kind of the mark.
    center_px : (2,) column and row; the centre of the top-left pixel is (0, 0). With status `predicted` it is the
        predicted place, with `absent` it may be None.
    covariance : of the centre, by causes; None if nothing was fitted.
    status : see `measure.flags`.
    reason : one sentence with its codes (`measure.flags`); may be empty only with status `measured`.
    quality : named quantities of the fit: snr, contrast_dn, blur_px, noise_dn, damaged_fraction, ...
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
        """(2, 2) covariance of (column, row), sum of all causes; None if nothing was fitted."""
        return None if self.covariance is None else self.covariance.px2

    def __repr__(self) -> str:
        return f"MarkMeasurement({self.kind} {' '.join(cell for cell in self.cells() if cell)})"

    def reject(self, reason: Reason) -> "MarkMeasurement":
        """Reject an observation for a reason; any other mark stays."""
        return replace(self, status=Status.REJECTED, reason=reason) if self.status.is_observation else self

    def cells(self) -> tuple[str, str, str, str, str]:
        """Name, status, place, standard deviations and reason as text; empty where not available."""
        place = "" if self.center_px is None else f"({self.center_px[0]:.3f}, {self.center_px[1]:.3f})"
        sigmas = None if self.covariance_px2 is None else np.sqrt(np.diag(self.covariance_px2))
        sigmas_text = "" if sigmas is None else f"± ({sigmas[0]:.3f}, {sigmas[1]:.3f})"
        return self.point, str(self.status), place, sigmas_text, str(self.reason)


@dataclass(frozen=True)
class ScanOrientation:
    """Scan orientation: counter-clockwise turn in degrees, followed by "m" if mirrored.

    In orientation "90m" the camera frame (x' right, y' up) is first mirrored (x' to -x'), then turned by 90 degrees
    counter-clockwise, to give the scan.

    Attributes
    ----------
    name : one of `measure.geometry.POSES`.
    decided : whether the image or the user determines it; otherwise it is assumed.
    evidence : one sentence for each piece of evidence, with its weight.
    written : log-likelihoods of the orientations, by name, from writing alone; empty if nothing was read.
    writing : orientation of most of the writing in the scan; "" if unclear.
    roll : question to the user, asked once for all frames of the camera; "" if there is none.
    rivals : orientations, in the frame's own axes, that the image does not distinguish from this one.
    """

    name: str
    decided: bool
    evidence: tuple[str, ...] = ()
    written: Mapping[str, float] = field(default_factory=dict)
    writing: str = ""
    roll: str = ""
    rivals: tuple[str, ...] = ()

    def is_unambiguous_up_to(self, alike: Collection[str]) -> bool:
        """Whether it is decided, or all its rivals are orientations under which the marks look alike."""
        return self.decided or bool(self.rivals and set(self.rivals) <= set(alike))


@dataclass(frozen=True, repr=False)
class FrameMeasurement:
    """Measurement of all marks of one scan.

    Attributes
    ----------
    image : name of the scan.
    marks : measurements of all marks, found or not.
    pose : scan orientation.
    pixel_from_camera : (2, 3) affine matrix, camera mm (x', y', 1) to (column, row), from the fiducials found; None if
        there are too few.
    problems : messages to the user, one sentence each, with codes.
    weights : channel weights with which the fiducials of a colour scan were measured; None for its grey value.
    tone : tone curve of the scan; None if no frame was found.
    writing : lines of text read around the frame; None if text was not searched.
    notes : remarks that need no action.
    """

    image: str
    marks: tuple[MarkMeasurement, ...]
    pose: ScanOrientation | None = None
    pixel_from_camera: Array | None = None
    problems: tuple[Reason, ...] = ()
    weights: tuple[float, ...] | None = None
    tone: FrameTone | None = None
    writing: tuple[Line, ...] | None = None
    notes: tuple[str, ...] = ()

    @property
    def px_per_mm(self) -> float | None:
        """Mean scale of pixel_from_camera; None without it."""
        matrix = self.pixel_from_camera
        return None if matrix is None else linear_scale(matrix)

    def marks_because(self, code: Code) -> tuple[MarkMeasurement, ...]:
        """Marks whose reason has this code."""
        return tuple(mark for mark in self.marks if code in mark.reason.codes)

    def to_pandas(self) -> Any:
        """Convert to a pandas.DataFrame, one row per mark, in px. Raises ImportError if pandas is not installed."""
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
        """Table of the marks for notebooks."""
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in mark.cells())}</tr>" for mark in self.marks
        )
        head = "".join(f"<th>{name}</th>" for name in ("mark", "status", "column, row (px)", "sigmas (px)", "reason"))
        return f"<p>{escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>"


def shift_frame(frame: FrameMeasurement, shift_px: Array) -> FrameMeasurement:
    """Shift all places of a frame by (2,) column and row, for another pixel origin."""
    right, down = shift_px.tolist()
    marks, lines, matrix = [], [], frame.pixel_from_camera
    for mark in frame.marks:
        places = {"junction_col_px": right, "junction_row_px": down}
        quality = {key: value + places.get(key, 0.0) for key, value in mark.quality.items()}
        center_px = None if mark.center_px is None else mark.center_px + shift_px
        marks.append(replace(mark, center_px=center_px, quality=quality))
    for line in frame.writing or ():
        outline_px = tuple((col + right, row + down) for col, row in line.outline_px)
        lines.append(replace(line, outline_px=outline_px))
    return replace(
        frame,
        marks=tuple(marks),
        pixel_from_camera=None if matrix is None else matrix + np.column_stack([np.zeros((2, 2)), shift_px]),
        writing=None if frame.writing is None else tuple(lines),
    )


@dataclass(frozen=True, eq=False)
class SecondPlace:
    """Second place by another method. offset_px (2,): second place minus matched one; covariance_px2 (2, 2): of that
    difference."""

    offset_px: Array
    covariance_px2: Array

    @property
    def sigmas(self) -> float:
        """Mahalanobis length of the difference."""
        return float(np.sqrt(self.offset_px @ np.linalg.solve(self.covariance_px2, self.offset_px)))


@dataclass(frozen=True, eq=False)
class OwnShape:
    """Scale and rotation by the mark's own image.

    change: (2,) scale and rotation (rad) from the image alone minus those of the frame; sigma: (2,) their standard
    deviations; on_place: (2, 2) derivatives of the place (px) if they were not held at the frame's values.
    """

    change: Array
    sigma: Array
    on_place: Array


@dataclass(frozen=True, eq=False)
class MarkFit:
    """Fit of a mark. If converged is False, reason states why, and the values are those of the last iteration.

    Attributes
    ----------
    converged, reason : whether the fit converged, and why not.
    center_px : (2,) column and row in the scan, not in the window.
    place_covariance : of the centre, by causes.
    pixel_from_mark : (2, 3) mm of the mark to pixels of the scan.
    contrast_dn : light of the mark minus that of the background, negative for a dark mark.
    stored_contrast_dn : the same in grey values of the file.
    noise_dn : standard deviation of one pixel's noise in light, for a chip after smoothing.
    blur_px : standard deviation of the blur.
    damaged_fraction : fraction of the pixels within plain_px of the mark that were masked.
    lost_fraction : fraction of the place's information lost to damage, in the direction with the largest loss.
    redundancy : pixels used minus unknowns.
    neighbour_correlation : of the residuals.
    covariance_is_white : whether the residuals were treated as white noise.
    likeness : correlation of the fitted model with the window after subtraction of its plane background: 1 for a
        perfect mark, 0 for none.
    significance : contrast over its standard deviation.
    blur_sigma : standard deviation of the logarithm of the blur, pixel included; infinite if the blur was not estimated
        or is at a limit of its range.
    size_sigma : standard deviation of the mark's relative size; infinite if not estimated.
    sloping : second place of an ellipse with a contrast gradient.
    line_width : logarithm of the width of the lines of a cross over the drawn width, and its standard deviation, where
        they are narrower than the least blur explains.
    own_shape : rotation and scale by the image alone, where the frame determined them.
    tone : information on an unknown tone curve.
    sharpening : score of the scan's sharpening.
    covariance : of all unknowns of the `PictureModel`, by noise; None if a different model was fitted.
    figures : quantities compared with other frames: size_ratio and blur_ratio relative to the other marks, turn_rad
        where the frame determined the rotation, arm1_ratio ... of a cross, with standard deviations size_sigma ... of
        the logarithms and of the turn.
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
    sloping: SecondPlace | None = None
    line_width: tuple[float, float] | None = None
    own_shape: OwnShape | None = None
    tone: MarkTone | None = None
    sharpening: SharpeningScore | None = None
    covariance: Array | None = None
    figures: Mapping[str, float] = field(default_factory=dict)

    def shifted(self, offset_px: Array) -> "MarkFit":
        """Shift the place by (2,) column and row."""
        place = self.pixel_from_mark + np.column_stack([np.zeros((2, 2)), offset_px])
        return replace(self, center_px=place[:, 2], pixel_from_mark=place)

    @property
    def is_clear(self) -> bool:
        """Whether the mark correlates clearly with its drawing."""
        return self.likeness >= CLEAR_LIKENESS

    @property
    def covariance_px2(self) -> Array:
        """(2, 2) covariance of the centre, sum of all causes."""
        return self.place_covariance.px2

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a coordinate."""
        return float(np.sqrt(np.trace(self.covariance_px2) / 2))

    @property
    def snr(self) -> float:
        return abs(self.contrast_dn) / max(self.noise_dn, 1e-12)
