"""A rendered project against its truth: names, errors over sigmas, and the adjusted camera in sigmas."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure.status import Status
from pipeline.archive.measurement import read_measurement
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]
Json = dict[str, Any]

WRONG_PX = 1.0  # farther from its own place than this, a mark is another one


@dataclass(frozen=True)
class FrameComparison:
    """One frame: how many fiducials and targets could be seen and were observed, which are wrong, and the pose.

    errors_px (n, 2): measured less true places of the observed marks that are right; normalised (n, 2): the same in
    units of their covariances, each component of variance 1 if these are right.
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
    """All frames, and every adjusted quantity of the camera: its name to (value, sigma, truth)."""

    frames: tuple[FrameComparison, ...]
    camera: Mapping[str, tuple[float, float, float]]

    @property
    def rms_error_over_sigma(self) -> float:
        return float(np.sqrt(np.mean(np.concatenate([frame.normalised for frame in self.frames]) ** 2)))

    @property
    def worst_camera_sigmas(self) -> float:
        return max(
            (abs(value - truth) / sigma for value, sigma, truth in self.camera.values() if sigma > 0.0), default=0.0
        )


def compare_with_truth(truth_path: Path, measurement_path: Path, adjustment_path: Path | None = None) -> Comparison:
    """Compare what was measured, and adjusted if there is a file of it, with truth.json."""
    truth: Json = json.loads(truth_path.read_text(encoding="utf-8"))
    frames = tuple(_frame(scan, truth["images"][scan.frame.image]) for scan in read_measurement(measurement_path))
    camera: dict[str, tuple[float, float, float]] = {}
    if adjustment_path is not None:
        adjusted: Json = json.loads(adjustment_path.read_text(encoding="utf-8"))["cameras"]
        for name, given in truth["cameras"].items():
            camera |= dict(_quantities(adjusted[name], given))
    return Comparison(frames, camera)


def _frame(scan: MeasuredScan, truth: Json) -> FrameComparison:
    places = {"fiducial": truth["fiducials"], "target": truth["targets"]}
    visible = {kind: sum(place["visible"] for place in marks.values()) for kind, marks in places.items()}
    observed = dict.fromkeys(places, 0)
    wrong, errors, normalised = [], [], []
    for mark in scan.frame.marks:
        if not Status(mark.status).is_observation or mark.center_px is None or mark.covariance_px2 is None:
            continue
        if mark.kind not in places:  # a join, whose place in the scene is nobody's
            continue
        observed[mark.kind] += 1
        place = places[mark.kind].get(mark.point)
        error = np.full(2, np.inf) if place is None else mark.center_px - _seen(place)
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


def _seen(place: Json) -> Array:
    """Where the centre of the figure lies that is seen: for a disk that of its ellipse."""
    return np.array([place.get("ellipse_col_px", place["col_px"]), place.get("ellipse_row_px", place["row_px"])])


def _quantities(adjusted: Json, truth: Json, name: str = "") -> Iterator[tuple[str, tuple[float, float, float]]]:
    """Every quantity that both hold, by the path of its names."""
    for key, given in truth.items():
        mine = adjusted.get(key) if isinstance(adjusted, dict) else None
        if not isinstance(given, dict) or not isinstance(mine, dict):
            continue
        path = f"{name}.{key}" if name else key
        if "value" in given and "value" in mine:
            yield path, (mine["value"], mine["sigma"], given["value"])
        else:
            yield from _quantities(mine, given, path)
