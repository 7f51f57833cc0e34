"""Comparison of a rendered project with its truth: identification, errors over sigmas, and adjusted camera."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure import Status
from pipeline import read_measurement
from pipeline.results.measured_record import MeasuredScan

Array = NDArray[np.float64]
Json = dict[str, Any]
Quantity = tuple[float, float, float]  # value, sigma, truth

WRONG_PX = 1.0  # px: a mark farther from its true place is a wrong one


@dataclass(frozen=True)
class FrameComparison:
    """Comparison of one frame.

    Numbers of marks are given by kind; `wrong` are points with wrong marks. errors_px (n, 2): measured less true places
    of the correct marks; normalised: divided by the Cholesky factors of their covariances.
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
    """Comparison of all frames, and of the adjusted parameters of the camera by name."""

    frames: tuple[FrameComparison, ...]
    camera: Mapping[str, Quantity]

    @property
    def rms_error_over_sigma(self) -> float:
        return float(np.sqrt(np.mean(np.concatenate([frame.normalised for frame in self.frames]) ** 2)))

    @property
    def worst_camera_sigmas(self) -> float:
        return max(abs(value - truth) / sigma for value, sigma, truth in self.camera.values() if sigma > 0.0)


def compare_with_truth(truth_path: Path, measurement_path: Path, adjustment_path: Path | None = None) -> Comparison:
    """Compare measurements and, if given, an adjustment with truth.json."""
    truth: Json = json.loads(truth_path.read_text(encoding="utf-8"))
    frames = tuple(_frame(scan, truth["images"][scan.frame.image]) for scan in read_measurement(measurement_path))
    camera = dict[str, Quantity]()
    if adjustment_path is not None:
        adjusted: Json = json.loads(adjustment_path.read_text(encoding="utf-8"))
        for name, given in truth["cameras"].items():
            camera |= dict(_quantities(adjusted["cameras"][name], given))
    return Comparison(frames, camera)


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
