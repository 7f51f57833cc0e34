"""What is observed beside image points and single unknowns: distances, earlier calibrations, antennas.

Each is a group of correlated observations l = f(x) + v of some of the unknowns. One concept serves all: positions of
the unknowns in f, the observed values with their covariance, computed values and derivatives at a state.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.rotation import cross_matrix, rotation_from_angles, vector_by_angles
from adjust.problem.network import Exterior, Network
from adjust.problem.parameter import Parameter
from adjust.problem.unknowns import Unknowns


class FurtherObservation(Protocol):
    """Correlated observations (m,) of functions of some unknowns.

    group: what they are called in the result's groups. names (m,): what each is called in files, labels (m,): in
    messages. positions (k,) of the unknowns that take part. observed (m,) and covariance (m, m) in the units of the
    unknowns.
    """

    @property
    def group(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def labels(self) -> tuple[str, ...]: ...
    @property
    def positions(self) -> Indices: ...
    @property
    def observed(self) -> Array: ...
    @property
    def covariance(self) -> Array: ...

    def computed(self, values: Array) -> Array:
        """What the functions (m,) give for the values (n,) of all unknowns."""
        ...

    def jacobian(self, values: Array) -> Array:
        """Their derivatives (m, k) by the unknowns at `positions`."""
        ...


def further_observations(network: Network, unknowns: Unknowns) -> tuple[FurtherObservation, ...]:
    """All of a validated network."""
    return (
        *_distances(network, unknowns),
        *_calibrations(network, unknowns),
        *_antennas(network, unknowns),
    )


@dataclass(frozen=True)
class ObservedDistance:
    """A distance between two points or stations; positions (6,): the coordinates of one and of the other."""

    names: tuple[str, ...]
    positions: Indices
    observed: Array
    covariance: Array
    group: str = "distance"

    @property
    def labels(self) -> tuple[str, ...]:
        return self.names

    def computed(self, values: Array) -> Array:
        return np.array([np.linalg.norm(self._difference(values))])

    def jacobian(self, values: Array) -> Array:
        difference = self._difference(values)
        direction = difference / np.linalg.norm(difference)
        return np.concatenate([-direction, direction])[None, :]

    def _difference(self, values: Array) -> Array:
        start, end = self.positions.reshape(2, 3)
        return np.asarray(values[end] - values[start])


def _distances(network: Network, unknowns: Unknowns) -> Iterator[ObservedDistance]:
    place = {image: positions[:3] for image, positions in unknowns.exterior.items()} | unknowns.point
    for each in network.distances:
        yield ObservedDistance(
            names=(f"{each.start} to {each.end}",),
            positions=np.concatenate([place[each.start], place[each.end]]),
            observed=np.array([each.value]),
            covariance=np.array([[each.sigma**2]]),
        )


@dataclass(frozen=True)
class ObservedCalibration:
    """An earlier calibration; parameters, positions (m,): the quantities that it gives."""

    parameters: tuple[Parameter, ...]
    positions: Indices
    observed: Array
    covariance: Array
    group: str = "calibration"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(each.text for each in self.parameters)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(each.label for each in self.parameters)

    def computed(self, values: Array) -> Array:
        return np.asarray(values[self.positions])

    def jacobian(self, values: Array) -> Array:
        return np.eye(len(self.positions))


def _calibrations(network: Network, unknowns: Unknowns) -> Iterator[ObservedCalibration]:
    """Those of the quantities that are free: a fiducial that no image shows is held, and has no part here."""
    number = {parameter: i for i, parameter in enumerate(unknowns.parameters)}
    for each in network.calibrations:
        free = [i for i, key in enumerate(each.parameters) if key in number and unknowns.sigma[number[key]] > 0.0]
        if free:
            yield ObservedCalibration(
                parameters=tuple(each.parameters[i] for i in free),
                positions=np.array([number[each.parameters[i]] for i in free], dtype=np.intp),
                observed=each.values[free],
                covariance=each.covariance[np.ix_(free, free)],
            )


@dataclass(frozen=True)
class ObservedAntenna:
    """Coordinates of a point that is fixed to the camera; positions (6,): the exterior orientation of the frame.

    axes (m,): which coordinates are observed; offset (3,) from the projection centre along the camera's axes;
    keeps_angles: whether the attitude moves by its angles and not by a rotation vector.
    """

    frame: str
    positions: Indices
    observed: Array
    covariance: Array
    axes: Indices
    offset: Array
    keeps_angles: bool
    group: str = "antenna"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.frame} {'XYZ'[axis]}" for axis in self.axes)

    @property
    def labels(self) -> tuple[str, ...]:
        return self.names

    def computed(self, values: Array) -> Array:
        rotation = rotation_from_angles(values[self.positions[3:]])
        return np.asarray((values[self.positions[:3]] + rotation.T @ self.offset)[self.axes])

    def jacobian(self, values: Array) -> Array:
        """A rotation by the vector t on top of M takes M' a to M' (a - t x a)."""
        angles = values[self.positions[3:]]
        by_attitude = rotation_from_angles(angles).T @ cross_matrix(self.offset)
        if self.keeps_angles:
            by_attitude = by_attitude @ vector_by_angles(angles)
        return np.hstack([np.eye(3), by_attitude])[self.axes]


def _antennas(network: Network, unknowns: Unknowns) -> Iterator[ObservedAntenna]:
    for image in {image.frame: image for image in network.images}.values():
        exterior = image.exterior
        if exterior is None or not exterior.has_antenna or image.name in network.unoriented:
            continue
        axes = np.flatnonzero(np.isfinite(exterior.sigmas[:3]))
        if len(axes):
            yield ObservedAntenna(
                frame=image.frame,
                positions=unknowns.exterior[image.name],
                observed=exterior.values[axes],
                covariance=np.diag(exterior.sigmas[axes] ** 2),
                axes=axes,
                offset=np.array(exterior.antenna),
                keeps_angles=unknowns.keeps_angles(image.name),
            )


def error_free(network: Network, unknowns: Unknowns, values: Array) -> Network:
    """The network with distances, calibrations and antennas as if they had been observed without error."""
    distances = tuple(
        replace(each, value=float(observed.computed(values)[0]))
        for each, observed in zip(network.distances, _distances(network, unknowns), strict=True)
    )
    number = {parameter: i for i, parameter in enumerate(unknowns.parameters)}
    calibrations = tuple(
        replace(each, values=np.array([values[number[key]] for key in each.parameters]))
        for each in network.calibrations
    )
    antennas = {each.frame: each for each in _antennas(network, unknowns)}
    images = tuple(
        replace(image, exterior=_error_free_antenna(image.exterior, antennas[image.frame], values))
        if image.exterior is not None and image.frame in antennas
        else image
        for image in network.images
    )
    return replace(network, distances=distances, calibrations=calibrations, images=images)


def _error_free_antenna(exterior: Exterior, antenna: ObservedAntenna, values: Array) -> Exterior:
    computed = exterior.values.copy()
    computed[antenna.axes] = antenna.computed(values)
    return replace(exterior, values=computed)


def square_sum(further: tuple[FurtherObservation, ...], values: Array) -> float:
    """Their share of v'Pv."""
    differences = ((each.observed - each.computed(values), each.covariance) for each in further)
    return float(sum(v @ np.linalg.solve(covariance, v) for v, covariance in differences))
