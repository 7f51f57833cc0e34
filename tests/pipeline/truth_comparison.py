"""Comparison of a rendered project with its truth: identification, errors over sigmas, and adjusted camera and
scanner."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legval2d, legvander2d
from numpy.typing import NDArray

from measure import Status
from pipeline import read_measurement
from pipeline.results.measured_record import MeasuredScan

Array = NDArray[np.float64]
Json = dict[str, Any]
Quantity = tuple[float, float, float]  # value, sigma, truth

_HIGHEST = 6  # highest degree per axis of a scanner's terms
WRONG_PX = 1.0  # px: a mark farther from its true place is a wrong one


@dataclass(frozen=True)
class FrameComparison:
    """Comparison of one frame.

    Attributes
    ----------
    visible, observed : numbers of visible and of observed marks, by kind.
    wrong : points with wrong marks.
    pose, true_pose : scan orientation.
    errors_px : (n, 2) measured less true places of the correct marks.
    normalised : (n, 2) the errors divided by the Cholesky factors of their covariances: components of variance 1 if
        these are right.
    """

    image: str
    visible: Mapping[str, int]
    observed: Mapping[str, int]
    wrong: tuple[str, ...]
    pose: str
    true_pose: str
    errors_px: Array
    normalised: Array


@dataclass(frozen=True)
class Comparison:
    """Comparison of all frames, and of the adjusted parameters of camera and scanner bend, by name.

    The bend is compared by its separately adjusted products, in mm.
    """

    frames: tuple[FrameComparison, ...]
    camera: Mapping[str, Quantity]
    scanner: Mapping[str, Quantity] = field(default_factory=dict)

    @property
    def rms_error_over_sigma(self) -> float:
        return float(np.sqrt(np.mean(np.concatenate([frame.normalised for frame in self.frames]) ** 2)))

    @property
    def worst_camera_sigmas(self) -> float:
        return _worst(self.camera)

    @property
    def worst_scanner_sigmas(self) -> float:
        return _worst(self.scanner)


def _worst(quantities: Mapping[str, Quantity]) -> float:
    return max((abs(value - truth) / sigma for value, sigma, truth in quantities.values() if sigma > 0.0), default=0.0)


def compare_with_truth(truth_path: Path, measurement_path: Path, adjustment_path: Path | None = None) -> Comparison:
    """Compare measurements and, if given, an adjustment with truth.json."""
    truth: Json = json.loads(truth_path.read_text(encoding="utf-8"))
    frames = tuple(_frame(scan, truth["images"][scan.frame.image]) for scan in read_measurement(measurement_path))
    camera, scanner = dict[str, Quantity](), dict[str, Quantity]()
    if adjustment_path is not None:
        adjusted: Json = json.loads(adjustment_path.read_text(encoding="utf-8"))
        for name, given in truth["cameras"].items():
            camera |= dict(_quantities(adjusted["cameras"][name], given))
        for name, given in truth.get("scanners", {}).items():
            if name in adjusted["scanners"]:
                scanner |= dict(bend_quantities(adjusted["scanners"][name], given))
    return Comparison(frames, camera, scanner)


def _frame(scan: MeasuredScan, truth: Json) -> FrameComparison:
    places = {"fiducial": truth["fiducials"], "target": truth["targets"]}
    visible = {kind: sum(place["visible"] for place in marks.values()) for kind, marks in places.items()}
    observed = dict.fromkeys(places, 0)
    wrong, errors, normalised = [], [], []
    for mark in scan.frame.marks:
        if not Status(mark.status).is_observation or mark.center_px is None or mark.covariance_px2 is None:
            continue
        if mark.kind not in places:  # a join has no true place in the scene
            continue
        observed[mark.kind] += 1
        place = places[mark.kind].get(mark.point)
        error = np.full(2, np.inf) if place is None else mark.center_px - _visible_place(place)
        if np.linalg.norm(error) > WRONG_PX:
            wrong.append(mark.point)
        else:
            errors.append(error)
            normalised.append(np.linalg.solve(np.linalg.cholesky(mark.covariance_px2), error))
    pose = scan.frame.pose.name if scan.frame.pose else ""
    return FrameComparison(
        scan.frame.image,
        visible,
        observed,
        tuple(wrong),
        pose,
        truth["pose"],
        np.array(errors).reshape(-1, 2),
        np.array(normalised).reshape(-1, 2),
    )


def _visible_place(place: Json) -> Array:
    """True centre of the visible figure: for a disk that of its ellipse."""
    return np.array([place.get("ellipse_col_px", place["col_px"]), place.get("ellipse_row_px", place["row_px"])])


def bend_quantities(adjusted: Json, truth: Json) -> Iterator[tuple[str, Quantity]]:
    """Adjusted products of a scanner's bend and their true values over the adjusted extent, which differs from the
    scene's.

    Parts of the scene's bend that the film transformations absorb are in none of these products.
    """
    along = np.linspace(-1.0, 1.0, 2 * _HIGHEST + 1)
    units = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    places_mm = np.array(adjusted["center_mm"]) + units * adjusted["half_mm"]
    true_units = ((places_mm - truth["center_mm"]) / truth["half_mm"]).T
    degrees = [_HIGHEST, _HIGHEST]
    design = legvander2d(units[:, 0], units[:, 1], degrees)
    for axis in "ab":
        factors = np.zeros((_HIGHEST + 1, _HIGHEST + 1))
        for name, given in truth["terms"].items():
            if name[0] == axis:
                factors[int(name[1]), int(name[2])] = given["value"]
        there = np.linalg.lstsq(design, legval2d(true_units[0], true_units[1], factors), rcond=None)[0].reshape(
            factors.shape
        )
        for name, mine in adjusted["terms"].items():
            if name[0] == axis and name[1:].isdigit():
                yield name, (mine["value"], mine["sigma"], float(there[int(name[1]), int(name[2])]))


def _quantities(adjusted: Json, truth: Json, name: str = "") -> Iterator[tuple[str, Quantity]]:
    """Quantities in both records, by the path of their names."""
    for key, given in truth.items():
        mine = adjusted.get(key) if isinstance(adjusted, dict) else None
        if not isinstance(given, dict) or not isinstance(mine, dict):
            continue
        path = f"{name}.{key}" if name else key
        if "value" in given and "value" in mine:
            yield path, (mine["value"], mine["sigma"], given["value"])
        else:
            yield from _quantities(mine, given, path)
