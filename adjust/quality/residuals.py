"""Residuals of the observations, and statistics of their groups."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Mask
from adjust.least_squares.rows import prior_differences
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.problem.further_observations import square_sum
from adjust.problem.problem import ABSENT
from adjust.quality.run import UNCHECKED, Run

UM_PER_MM = 1000.0
NEARLY_ONE = 0.99  # least redundancy of a group with a sigma0 of its own


@dataclass(frozen=True, repr=False)
class Residuals:
    """Residuals of the n observations of the network, in its order.

    v_mm (n, 2): adjusted minus observed comparator coordinates; redundancy (n, 2): redundancy numbers of x and y;
    w (n, 2): standardised residuals, v / sigma_v where the coordinates are uncorrelated (see `Reliability`).
    """

    v_mm: Array
    redundancy: Array
    w: Array

    def __repr__(self) -> str:
        rms_um = 1000.0 * np.sqrt(np.mean(np.square(self.v_mm), axis=0)) if len(self.v_mm) else np.zeros(2)
        return f"Residuals({len(self.v_mm)} of rms {rms_um[0]:.3g}, {rms_um[1]:.3g} µm)"


@dataclass(frozen=True)
class FurtherResidual:
    """Residual of a further observation, such as a distance, in its own unit.

    group, name: see `FurtherObservation`; v: adjusted minus observed; sigma: a-priori standard deviation; redundancy:
    redundancy number; w: v / sigma_v; detectable: smallest detectable error (Baarda), inf if unchecked.
    """

    group: str
    name: str
    observed: float
    v: float
    sigma: float
    redundancy: float
    w: float
    detectable: float


@dataclass(frozen=True)
class Group:
    """Statistics of a group of observations: sigma0 (root of v'Pv over redundancy), rms per axis, redundancy.

    sigma0 is 0, without meaning, where the redundancy is below 1. The rms is in µm for `target`, `fiducial`
    (comparator) and `datum` (given fiducial places, F5 and F6), in millionths of the object unit for `control`, and 0
    for groups of mixed units. `target`, `fiducial` and `control` always exist.
    """

    sigma0: float
    rms_x_um: float
    rms_y_um: float
    redundancy: float


def residuals(run: Run) -> Residuals:
    """Residuals with redundancy numbers and standardised residuals; the latter two are 0 without a solution."""
    v_mm = run.end.v_mm
    if not (run.has_solution and run.is_tested):
        return Residuals(v_mm, np.zeros_like(v_mm), np.zeros_like(v_mm))
    return Residuals(v_mm, run.redundancies[: len(v_mm)], run.statistics.w[: len(v_mm)])


def further_residuals(run: Run, noncentrality: float) -> Iterator[FurtherResidual]:
    """Residuals of further observations; unchecked without a solution.

    With C = L L' and H the cofactor matrix of the adjusted rows in unit weight, Q_vv = L (I - H) L'.
    """
    for each, block in zip(run.problem.further, run.end.rows.further, strict=True):
        v = each.computed(run.end.state.values) - each.observed
        root = np.linalg.cholesky(each.covariance)
        free = surplus(block, run.factor) if run.has_solution else np.zeros_like(root)
        cofactor_v = root @ free @ root.T
        weighted = np.linalg.inv(root).T @ free @ np.linalg.inv(root)
        redundancy = np.einsum("ij,ji->i", cofactor_v, np.linalg.inv(each.covariance))
        checked = redundancy > UNCHECKED
        w = np.where(checked, v / np.sqrt(np.where(checked, np.diag(cofactor_v), 1.0)), 0.0)
        smallest = np.where(checked, noncentrality / np.sqrt(np.where(checked, np.diag(weighted), 1.0)), np.inf)
        sigma = np.sqrt(np.diag(each.covariance))
        for row in zip(each.names, each.observed, v, sigma, redundancy, w, smallest, strict=True):
            yield FurtherResidual(each.group, row[0], *map(float, row[1:]))


def surplus(block: Blocks, factor: Factor) -> Array:
    """(m, m) matrix I - H of a block without own unknowns."""
    roots = (block.matrix / factor.scale[block.shared][:, None, :] @ factor.triangle.group_roots(block.shared))[0]
    return np.asarray(np.eye(len(roots)) - roots @ roots.T)


def groups(run: Run, further: Sequence[FurtherResidual]) -> dict[str, Group]:
    """Statistics by group: marks in the comparator (target, tie, fiducial, join), priors, and further observations.

    See `Group` for units. Rejected observations belong to no group.
    """
    problem, result = run.problem, {}
    for name in ("target", "tie", "fiducial", "join", "control", "datum", "interior", "scanner", "board", "exterior"):
        members = (run.units.groups == name) & run.weighting.used
        if not members.any() and name not in ("target", "fiducial", "control"):
            continue
        sums = run.group_sums(members) if run.has_solution and run.is_tested else (0.0, 0.0)
        result[name] = _group(*sums, *_rms_um(run, name, members))
    for name in dict.fromkeys(each.group for each in problem.further):
        vpv = square_sum(tuple(each for each in problem.further if each.group == name), run.end.state.values)
        result[name] = _group(vpv, sum(each.redundancy for each in further if each.group == name), 0.0, 0.0)
    return result


def _group(vpv: float, redundancy: float, rms_x_um: float, rms_y_um: float) -> Group:
    sigma0 = float(np.sqrt(vpv / redundancy)) if redundancy > NEARLY_ONE else 0.0
    return Group(sigma0, rms_x_um, rms_y_um, redundancy)


def _rms_um(run: Run, group: str, members: Mask) -> tuple[float, float]:
    """Rms of a group by axis, in µm or in millionths of the object unit; 0 for mixed units."""
    problem, v_mm = run.problem, run.end.v_mm
    if group in problem.network.observations.kind or group in ("target", "fiducial"):
        v_um = UM_PER_MM * v_mm[members[: len(v_mm)]]
        return _rms(v_um[:, 0]), _rms(v_um[:, 1])
    if group not in ("control", "datum"):
        return 0.0, 0.0
    given = run.units.positions[members[len(v_mm) :]].ravel()
    given = given[given != ABSENT]
    quantities = np.array([problem.unknowns.parameters[i].quantity for i in given], dtype=np.str_)
    v = (1e6 if group == "control" else UM_PER_MM) * prior_differences(problem, run.end.state)[given]
    x, y = ("X", "Y") if group == "control" else ("x", "y")
    return _rms(v[quantities == x]), _rms(v[quantities == y])


def _rms(v: Array) -> float:
    return float(np.sqrt(np.mean(v**2))) if len(v) else 0.0
