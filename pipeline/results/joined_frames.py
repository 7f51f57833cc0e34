"""Frames scanned in parts: differences at tie points, and the marks of all partial scans in camera coordinates."""

from collections import defaultdict

import numpy as np

from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Image, Network
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.results.adjustment_record import JoinedFrameRecord, JoinRecord, PartMarkRecord, PartRecord
from pipeline.types import Array, Indices

_UM_PER_MM = 1000.0


def joined_frames(adjustment: Adjustment) -> dict[str, JoinedFrameRecord]:
    """Records of the frames scanned in parts, by frame; empty without such frames or without a solution.

    Coordinates are camera coordinates in mm, sigmas a posteriori.
    """
    if not adjustment.converged:
        return {}
    parts = defaultdict[str, list[Image]](list)
    for image in adjustment.network.images:
        if image.part_of:
            parts[image.part_of].append(image)
    return {frame: _frame(adjustment, frame, own) for frame, own in parts.items()}


def _frame(adjustment: Adjustment, frame: str, parts: list[Image]) -> JoinedFrameRecord:
    network = adjustment.network
    scans = {part.name: _Part(adjustment, part) for part in parts}
    marks = [row for scan in scans.values() for row in scan.marks()]
    joins = []
    for (owner, point), rows in network.joins.items():
        if owner == frame:
            names = [network.observations.image[row] for row in rows]
            places = [scans[name].camera_mm([row])[0] for name, row in zip(names, rows.tolist(), strict=True)]
            apart_um = _UM_PER_MM * (places[1] - places[0])
            middle = np.mean(places, axis=0)
            joins.append(JoinRecord(point, tuple(names), *middle.tolist(), *apart_um.tolist()))
    known = {name: PartRecord(scan.corner_sigma_um()) for name, scan in scans.items()}
    return JoinedFrameRecord(known, tuple(joins), tuple(marks))


class _Part:
    """Adjusted partial scan of a frame."""

    def __init__(self, adjustment: Adjustment, image: Image) -> None:
        self.adjustment, self.image = adjustment, image
        self.model = adjusted_image(adjustment, image.name)
        film = [Parameter.film(image.name, name) for name in film_parameter_names(image.transformation)]
        self.film_covariance = adjustment.sigma0**2 * adjustment.cofactor_of(film)

    def camera_mm(self, rows: list[int] | Indices) -> Array:
        """(n, 2) camera coordinates of observations by the film transformation."""
        return np.asarray(self.model.camera_from_comparator(self.adjustment.network.observations.xy_mm[rows]))

    def marks(self) -> list[PartMarkRecord]:
        """Marks that are observations. Tie points and fiducials have adjusted coordinates. Targets have measured ones;
        their covariance is that of the measurement plus that of the film transformation, taken as independent."""
        network = self.adjustment.network
        rows = np.flatnonzero(network.image_numbers == network.images.index(self.image))
        observations = network.observations
        measured, film = self.camera_mm(rows), self._film_covariances(observations.xy_mm[rows])
        gradient = self.model.camera_by_comparator(observations.xy_mm[rows])
        noise = gradient @ observations.covariance_mm2[rows] @ gradient.swapaxes(1, 2)
        found = []
        for k, row in enumerate(rows.tolist()):
            place, covariance = measured[k], self.adjustment.sigma0**2 * noise[k] + film[k]
            if own := _own_unknowns(network, self.image, row):
                place = self.adjustment.values_of(own)
                covariance = self.adjustment.sigma0**2 * self.adjustment.cofactor_of(own)
            sx, sy = np.sqrt(np.diag(covariance))
            rho = float(covariance[0, 1] / (sx * sy)) if sx * sy > 0.0 else 0.0
            named = self.image.name, observations.point[row], observations.kind[row]
            found.append(PartMarkRecord(*named, float(place[0]), float(place[1]), float(sx), float(sy), rho))
        return found

    def corner_sigma_um(self) -> float:
        """Largest standard deviation of the film transformation at the corners of the observations' bounding box."""
        xy_mm = self.adjustment.network.observations.xy_mm
        rows = self.adjustment.network.image_numbers == self.adjustment.network.images.index(self.image)
        low, high = xy_mm[rows].min(axis=0), xy_mm[rows].max(axis=0)
        corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
        return float(_UM_PER_MM * np.sqrt(np.linalg.eigvalsh(self._film_covariances(corners))[:, -1].max()))

    def _film_covariances(self, xy_mm: Array) -> Array:
        """(n, 2, 2) covariances of camera coordinates at (n, 2), propagated from the film transformation."""
        by_parameters = self.model.film.design(xy_mm)
        return np.asarray(by_parameters @ self.film_covariance @ by_parameters.swapaxes(1, 2))


def _own_unknowns(network: Network, image: Image, row: int) -> list[Parameter]:
    """Unknowns that are the camera coordinates of an observation; empty for a target."""
    kind, point = network.observations.kind[row], network.observations.point[row]
    if kind == "join":
        return [Parameter.join(image.frame, point, axis) for axis in "xy"]
    return [Parameter.fiducial(image.camera, point, axis) for axis in "xy"] if kind == "fiducial" else []
