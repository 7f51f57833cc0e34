"""Tests and reliability as `adjustment.json` holds them."""

import math
from typing import Any

import numpy as np

from adjust.problem.tested import Tested
from adjust.quality.reliability import Reliability
from adjust.quality.snooping import Suspect
from adjust.solution.result import Adjustment

Json = dict[str, Any]

DEG_PER_RAD = 180.0 / math.pi
ANGLES = ("omega", "phi", "kappa")
UM_PER_MM = 1e3


def reliability_json(adjustment: Adjustment) -> Json | None:
    """What the observations check, and what an undetected error would do; null where there is no solution.

    `given` has one row a coordinate of what was given, in mm, object units or degrees; those of the image points stand
    with the residuals. An error is null where nothing checks the coordinate.
    """
    result = adjustment.reliability
    if result is None:
        return None
    return {
        "alpha": result.probabilities.alpha,
        "power": result.probabilities.power,
        "family": result.probabilities.family,
        "critical_tau": result.critical_tau,
        "outer": [
            {"parameter": each.parameter.text, "effect": each.effect, "sigmas": each.in_sigmas, "cause": each.cause}
            for each in result.outer
        ],
        "unchecked": list(result.unchecked),
        "given": [
            _given(result, unit, axis)
            for unit in range(len(adjustment.network.observations), len(result.tested))
            for axis in range(len(result.tested[unit].coordinates))
        ],
    }


def _given(result: Reliability, unit: int, axis: int) -> Json:
    tested = result.tested[unit]
    scale = _scale(tested, axis)
    return {
        "name": tested.coordinate_name(axis),
        "group": tested.group,
        "v": scale * float(result.v[unit, axis]),
        "sigma": scale * float(result.sigma[unit, axis]),
        "redundancy": float(result.redundancy[unit, axis]),
        "w": float(result.w[unit, axis]),
        "tau": float(result.tau[unit, axis]),
        "smallest_error": scale * float(result.smallest[unit, axis]),
        "effect_sigmas": float(result.effect[unit, axis]),
    }


def _scale(tested: Tested, axis: int) -> float:
    return DEG_PER_RAD if tested.coordinates[axis] in ANGLES else 1.0


def point_tests(adjustment: Adjustment) -> list[Json]:
    """What is added to the residual of every image point; nothing where there is no solution."""
    count = len(adjustment.network.observations)
    result = adjustment.reliability
    if result is None:
        return [{} for _ in range(count)]
    smallest_um = UM_PER_MM * result.smallest[:count]
    return [
        {
            "tau_x": float(result.tau[i, 0]),
            "tau_y": float(result.tau[i, 1]),
            "statistic": float(result.statistic[i]),
            "smallest_error_x_um": float(smallest_um[i, 0]),
            "smallest_error_y_um": float(smallest_um[i, 1]),
            "effect_sigmas": float(np.max(result.effect[i])),
        }
        for i in range(count)
    ]


def suspect_json(suspect: Suspect) -> Json:
    """A suspect; its error in mm, object units or degrees."""
    tested = suspect.tested
    return {
        "name": tested.name,
        "group": tested.group,
        "owner": tested.owner,
        "point": tested.point,
        "coordinates": list(tested.coordinates),
        "statistic": suspect.statistic,
        "size": suspect.size,
        "critical": suspect.critical,
        "w": suspect.w,
        "tau": suspect.tau,
        "critical_tau": suspect.critical_tau,
        "error": [_scale(tested, axis) * value for axis, value in enumerate(suspect.error)],
        "alike": list(suspect.alike),
        "removed": suspect.removed,
    }
