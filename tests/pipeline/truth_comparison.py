"""Comparison of a rendered project with its truth: identification, errors over sigmas, and adjusted camera."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import read_measurement

Array = NDArray[np.float64]
Json = dict[str, Any]

WRONG_PX = 1.0  # px: a mark farther from its true place is a wrong one


@dataclass
class FrameComparison:
    """Numbers of marks by kind, points with wrong marks, and of all others the measured less the true places, and these
    divided by the Cholesky factors of their covariances."""

    truth: Json
    pose: str
    observed: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    errors_px: list[Array] = field(default_factory=list)
    normalised: list[Array] = field(default_factory=list)

    def visible(self, kind: str) -> int:
        return sum(place["visible"] for place in self.truth[f"{kind}s"].values())


def compare_frames(folder: Path) -> list[FrameComparison]:
    """The measured marks of a project with its truth.json: figures' centres, for a disk that of its ellipse."""
    truth: Json = json.loads((folder / "truth.json").read_text())
    frames = []
    for scan in read_measurement(folder / "out" / "measurement.db"):
        found = FrameComparison(truth["images"][scan.frame.image], scan.frame.pose.name if scan.frame.pose else "")
        for mark in scan.frame.marks:
            if not mark.status.is_observation or mark.kind not in ("fiducial", "target"):  # a join has no true place
                continue
            assert mark.covariance_px2 is not None
            found.observed[mark.kind] += 1
            place = found.truth[f"{mark.kind}s"].get(mark.point, {"col_px": np.inf, "row_px": np.inf})
            true = [place.get(f"ellipse_{axis}_px", place[f"{axis}_px"]) for axis in ("col", "row")]
            error = np.asarray(mark.center_px) - true
            if np.linalg.norm(error) > WRONG_PX:
                found.wrong.append(mark.point)
            else:
                found.errors_px.append(error)
                found.normalised.append(np.linalg.solve(np.linalg.cholesky(mark.covariance_px2), error))
        frames.append(found)
    return frames


def camera_errors(folder: Path) -> list[float]:
    """Errors over standard deviations of the adjusted quantities of the cameras that are estimated."""
    truth: Json = json.loads((folder / "truth.json").read_text())["cameras"]
    adjusted: Json = json.loads((folder / "out" / "adjustment.json").read_text())["cameras"]
    return [(mine["value"] - true["value"]) / mine["sigma"] for mine, true in _pairs(adjusted, truth) if mine["sigma"]]


def _pairs(adjusted: Any, truth: Any) -> Iterator[tuple[Json, Json]]:
    """Quantities in both records."""
    if not isinstance(truth, dict) or not isinstance(adjusted, dict):
        return
    if "value" in truth and "value" in adjusted:
        yield adjusted, truth
    else:
        for key in truth.keys() & adjusted.keys():
            yield from _pairs(adjusted[key], truth[key])
