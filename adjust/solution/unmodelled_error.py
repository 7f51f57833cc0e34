"""Variance component of unmodelled errors: one standard deviation per camera, added to those of its marks."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adjust.problem.network import Network
from adjust.quality.variance_components import added_variance
from adjust.solution.adjustment import adjust
from adjust.solution.options import Options
from adjust.solution.result import Adjustment

ROUNDS = 6  # two or three suffice: nearly equal weights hardly change the residuals
FIRST = 1e-3  # initial value, fraction of the frame's diagonal: above any lens misfit, below a blunder
PLAUSIBLE = 3e-4  # fraction of the frame's diagonal that lens, board and processing may cause: 1.5 px of 5000 px
SETTLED = 0.01  # relative change of a standard deviation that means convergence


def adjust_unmodelled(network: Network, options: Options | None = None) -> Adjustment:
    """Adjust with a standard deviation of unmodelled errors, estimated for each camera.

    It is added in quadrature to those of the camera's targets and tie points, such that their v'Pv equals their
    redundancy (Förstner's condition for a variance component, here an additive one). It is 0 where the given standard
    deviations explain the residuals. The first adjustment allows FIRST of the frame's diagonal, so that blunders of the
    whole network are refused before an error is attributed to unmodelled effects. An implausibly large one is a
    warning.

    Parameters
    ----------
    network : marks with their standard deviations from image measurement
    options : of each adjustment

    Returns
    -------
    Adjustment
        With the added standard deviations in `unmodelled_mm`. Raises AdjustmentError as `adjust` does.
    """
    diagonal_mm = {each.name: float(np.hypot(*each.frame_mm)) for each in network.cameras}
    sigma_mm = {each: FIRST * diagonal_mm[each] for each in diagonal_mm}
    result = adjust(add_unmodelled(network, sigma_mm), options=options)
    for _ in range(ROUNDS):
        if not result.converged:
            break
        before, sigma_mm = sigma_mm, _components_mm(result, sigma_mm)
        if all(abs(sigma_mm[each] - before[each]) <= SETTLED * sigma_mm[each] for each in sigma_mm):
            break
        result = adjust(add_unmodelled(network, sigma_mm), result.start, options)
    large = [each for each in sigma_mm if sigma_mm[each] > PLAUSIBLE * diagonal_mm[each] > 0.0]
    warnings = (
        f"Camera {each}: errors of {1000.0 * sigma_mm[each]:.3g} µm are not modelled, one part in "
        f"{diagonal_mm[each] / sigma_mm[each]:.0f} of the picture's diagonal. Look for pictures that are blurred or "
        "moved, for a wrong size or count of the board, and whether the lens model suits."
        for each in large
    )
    return replace(result, unmodelled_mm=sigma_mm, remarks=(*result.remarks, *warnings))


def add_unmodelled(network: Network, sigma_mm: Mapping[str, float]) -> Network:
    """Add a standard deviation by camera to the targets and tie points of a network."""
    added = np.array([sigma_mm.get(camera, 0.0) for camera in _cameras(network)]) ** 2
    covariance_mm2 = network.observations.covariance_mm2 + added[:, None, None] * np.eye(2)
    return replace(network, observations=replace(network.observations, covariance_mm2=covariance_mm2))


def _cameras(network: Network) -> NDArray[np.str_]:
    """Camera of every target and tie point; "" for other marks."""
    cameras = np.array([image.camera for image in network.images])[network.image_numbers]
    return np.where(np.isin(network.observations.kind, ("target", "tie")), cameras, "")


def _components_mm(result: Adjustment, before_mm: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations by camera with which v'Pv of its marks equals their redundancy, for the current residuals."""
    found, cameras, residuals = dict[str, float](), _cameras(result.network), result.residuals
    variances = np.diagonal(result.network.observations.covariance_mm2, axis1=1, axis2=2)
    for camera, before in before_mm.items():
        rows = cameras == camera
        redundancy = float(residuals.redundancy[rows].sum())
        squares, given = residuals.v_mm[rows] ** 2, variances[rows] - before**2
        added = added_variance(squares, given, redundancy) if redundancy >= 1.0 else None
        found[camera] = float(np.sqrt(added or 0.0))
    return found
