"""Observations other than image points and priors of single unknowns: distances, earlier calibrations.

Each is a group of correlated observations l = f(x) + v of some unknowns, with the positions of the unknowns in f, the
observed values and their covariance, and computed values and derivatives at a state.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.problem.camera import FiducialDistance
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.problem.unknowns import Unknowns


@dataclass(frozen=True)
class FurtherObservation:
    """Correlated observations (m,) of functions of some unknowns; in this base class of the unknowns themselves."""

    group: str  # name of the group in the result
    # names, labels: (m,) names in files and in messages
    names: tuple[str, ...]
    labels: tuple[str, ...]
    positions: Indices  # (k,) positions of the unknowns
    observed: Array  # (m,) in the units of the unknowns
    covariance: Array  # (m, m)

    def computed(self, values: Array) -> Array:
        """Compute the functions (m,) from the values (n,) of all unknowns."""
        return np.asarray(values[self.positions])

    def jacobian(self, values: Array) -> Array:
        """Derivatives (m, k) with respect to the unknowns at `positions`."""
        return np.eye(len(self.positions))


def further_observations(network: Network, unknowns: Unknowns) -> tuple[FurtherObservation, ...]:
    """List all further observations of a validated network."""
    return (
        *_distances(network, unknowns),
        *(distance for _, distance in _fiducial_distances(network, unknowns)),
        *_calibrations(network, unknowns),
    )


class ObservedDistance(FurtherObservation):
    """Distance between two points, stations or fiducials; positions (2 d,): coordinates of both ends."""

    def computed(self, values: Array) -> Array:
        return np.array([np.linalg.norm(self._difference(values))])

    def jacobian(self, values: Array) -> Array:
        difference = self._difference(values)
        direction = difference / np.linalg.norm(difference)
        return np.concatenate([-direction, direction])[None, :]

    def _difference(self, values: Array) -> Array:
        start, end = self.positions.reshape(2, -1)
        return np.asarray(values[end] - values[start])


def _distances(network: Network, unknowns: Unknowns) -> Iterator[ObservedDistance]:
    for each in network.distances:
        name, ends = (f"{each.start} to {each.end}",), (each.start, each.end)
        positions = np.concatenate(
            [unknowns.point[end] if end in unknowns.point else unknowns.exterior[end][:3] for end in ends]
        )
        yield ObservedDistance("distance", name, name, positions, np.array([each.value]), np.array([[each.sigma**2]]))


def _fiducial_distances(network: Network, unknowns: Unknowns) -> Iterator[tuple[FiducialDistance, ObservedDistance]]:
    for camera, each in network.observed_distances:
        positions = np.concatenate([unknowns.fiducial[camera, end] for end in (each.start, each.end)])
        label = (f"{each.name} of camera {camera}",)
        value, variance = np.array([each.value_mm]), np.array([[each.sigma_mm**2]])
        yield each, ObservedDistance("fiducial distance", label, label, positions, value, variance)


@dataclass(frozen=True)
class ObservedCalibration(FurtherObservation):
    """Earlier calibration; parameters (m,): its quantities."""

    parameters: tuple[Parameter, ...]


def _calibrations(network: Network, unknowns: Unknowns) -> Iterator[ObservedCalibration]:
    """Calibrations of the free quantities; a fiducial in no image is held and left out."""
    number = {parameter: i for i, parameter in enumerate(unknowns.parameters)} if network.calibrations else {}
    for each in network.calibrations:
        free = [i for i, key in enumerate(each.parameters) if key in number and unknowns.sigma[number[key]] > 0.0]
        if free:
            parameters = tuple(each.parameters[i] for i in free)
            yield ObservedCalibration(
                "calibration",
                tuple(key.text for key in parameters),
                tuple(key.label for key in parameters),
                np.array([number[key] for key in parameters], dtype=np.intp),
                each.values[free],
                each.covariance[np.ix_(free, free)],
                parameters,
            )


def error_free(network: Network, unknowns: Unknowns, values: Array) -> Network:
    """Replace distances and calibrations of a network by error-free values."""
    of_fiducials = [
        (each, replace(each, value_mm=float(observed.computed(values)[0])))
        for each, observed in _fiducial_distances(network, unknowns)
    ]
    cameras = tuple(
        replace(
            camera, distances=tuple(exact for each in camera.distances for own, exact in of_fiducials if own is each)
        )
        for camera in network.cameras
    )
    distances = tuple(
        replace(each, value=float(observed.computed(values)[0]))
        for each, observed in zip(network.distances, _distances(network, unknowns), strict=True)
    )
    number = {parameter: i for i, parameter in enumerate(unknowns.parameters)}
    calibrations = tuple(
        replace(each, values=np.array([values[number[key]] for key in each.parameters]))
        for each in network.calibrations
    )
    return replace(network, cameras=cameras, distances=distances, calibrations=calibrations)


def square_sum(further: tuple[FurtherObservation, ...], values: Array) -> float:
    """v'Pv of further observations."""
    differences = ((each.observed - each.computed(values), each.covariance) for each in further)
    return float(sum(v @ np.linalg.solve(covariance, v) for v, covariance in differences))
