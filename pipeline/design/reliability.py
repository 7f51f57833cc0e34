"""How well a planned network would find gross errors, and what those that it would not find do to the camera."""

from dataclasses import dataclass

import numpy as np

from adjust.problem.parameter import Parameter
from adjust.solution.planning import Plan

UM_PER_MM = 1000.0
IN_MM = ("target", "tie", "fiducial", "datum", "scanner")


@dataclass(frozen=True)
class GroupReliability:
    """One kind of observation or given quantity.

    redundancy: the mean redundancy number of a coordinate. median, largest: of the smallest gross errors that are
    found, um for what is measured in mm, else object units or rad, without those that nothing checks, `unchecked`.
    """

    group: str
    coordinates: int
    redundancy: float
    median: float
    largest: float
    unchecked: int


@dataclass(frozen=True)
class CameraEffect:
    """What the worst error that is not found does to a camera parameter: in sigmas of it; cause: where the error is."""

    parameter: Parameter
    in_sigmas: float
    cause: str


@dataclass(frozen=True)
class PlannedReliability:
    """Inner reliability by groups, outer reliability by camera parameters (Baarda)."""

    groups: tuple[GroupReliability, ...]
    camera: tuple[CameraEffect, ...]


def planned_reliability(plan: Plan) -> PlannedReliability:
    """The reliability of a plan at its sigma0; empty where there is no redundancy."""
    found = plan.adjustment.reliability
    if found is None:
        return PlannedReliability((), ())
    groups: dict[str, list[tuple[float, float]]] = {}
    for unit, redundancy, smallest in zip(found.tested, found.redundancy, found.smallest, strict=True):
        scale = plan.sigma0 * (UM_PER_MM if unit.group in IN_MM else 1.0)
        rows = groups.setdefault(unit.group, [])
        rows += [(float(redundancy[i]), scale * float(smallest[i])) for i in range(len(unit.coordinates))]
    for each in plan.adjustment.further:
        groups.setdefault(each.group, []).append((each.redundancy, plan.sigma0 * each.detectable))
    camera = tuple(CameraEffect(one.parameter, one.in_sigmas, one.cause) for one in found.outer)
    return PlannedReliability(tuple(_group(name, rows) for name, rows in groups.items()), camera)


def error_unit(group: str) -> str:
    """The unit of a group's gross errors."""
    if group in IN_MM:
        return "um"
    return "object unit" if group in ("control", "distance") else "mixed"


def _group(name: str, rows: list[tuple[float, float]]) -> GroupReliability:
    redundancy, smallest = np.array(rows).T
    checked = smallest[np.isfinite(smallest)]
    return GroupReliability(
        name,
        len(rows),
        float(redundancy.mean()),
        float(np.median(checked)) if len(checked) else np.inf,
        float(checked.max(initial=0.0)) if len(checked) else np.inf,
        len(rows) - len(checked),
    )
