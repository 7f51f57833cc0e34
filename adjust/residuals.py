"""Residuals, redundancy numbers and standardised residuals, and their sums by group."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.elimination import Factor
from adjust.further_observations import square_sum
from adjust.iteration import Linearised
from adjust.numbering import Numbering
from adjust.problem import Problem, State
from adjust.result import Cofactor, FurtherResidual, Group, Residuals
from adjust.rows import prior_differences

Array = NDArray[np.float64]

UNCHECKED = 1e-9  # an observation of a smaller redundancy is not checked by any other
UM_PER_MM = 1000.0


def residuals(numbering: Numbering, end: Linearised, factor: Factor, covariance_mm2: Array) -> Residuals:
    """The residuals with their redundancy numbers, the diagonal of Q_vv P (Förstner; Baarda's w = v / sigma_v).

    With K = C A' L^-T and the whitened rows L^-1 B: Q_vv = K (I - L^-1 B C_xx B' L^-T) K'.
    """
    at, root = end.at, end.rows.root
    roots = factor.row_roots(end.rows)
    adjusted = np.empty((len(end.v_mm), 2, 2))
    for touched, g in zip(numbering.touched, roots, strict=False):  # behind them stand further observations
        pairs = g.reshape(*touched.rows.shape, 2, g.shape[2])
        adjusted[touched.rows] = pairs @ pairs.swapaxes(2, 3)
    k = np.linalg.solve(root, at.by_observation @ covariance_mm2).transpose(0, 2, 1)
    cofactor = k @ (np.eye(2) - adjusted) @ k.transpose(0, 2, 1)
    redundancy = np.einsum("nij,nji->ni", cofactor, np.linalg.inv(covariance_mm2))
    variance = np.einsum("nii->ni", cofactor)
    checked = redundancy > UNCHECKED
    w = np.where(checked, end.v_mm / np.sqrt(np.where(checked, variance, 1.0)), 0.0)
    return Residuals(end.v_mm, redundancy, w)


def further_residuals(problem: Problem, state: State, cofactor: Cofactor) -> Iterator[FurtherResidual]:
    """The residuals of further observations: Q_vv = Q - J C_xx J', redundancy numbers the diagonal of Q_vv Q^-1."""
    for each in problem.further:
        by_unknowns = each.by_unknowns(state.values)
        v = each.computed(state.values) - each.observed
        adjusted = by_unknowns @ cofactor.of(each.positions) @ by_unknowns.T
        cofactor_v = each.covariance - adjusted
        redundancy = np.einsum("ij,ji->i", cofactor_v, np.linalg.inv(each.covariance))
        sigma_v = np.sqrt(np.diag(cofactor_v).clip(0.0))
        sigma = np.sqrt(np.diag(each.covariance))
        checked = (redundancy > UNCHECKED) & (sigma_v > 0.0)
        w = np.where(checked, v / np.where(checked, sigma_v, 1.0), 0.0)
        for row in zip(each.names, each.observed, v, sigma, redundancy, w, strict=True):
            yield FurtherResidual(each.group, row[0], *map(float, row[1:]))


def groups(
    problem: Problem,
    state: State,
    variances: Array,
    observed: Residuals,
    covariance_mm2: Array,
    further: Sequence[FurtherResidual],
) -> dict[str, Group]:
    """The groups of observations: target and fiducial in the comparator, and the priors; variances (n,) of all.

    control: object coordinates, whose rms is in millionths of the object unit; datum: the fiducials' given places
    (F5, F6); interior: c, x0', y0' and distortion; exterior; and those of further observations. All behind datum have
    no rms. target, fiducial and control are always there.
    """
    weighted = np.linalg.solve(covariance_mm2, observed.v_mm[..., None])[..., 0] * observed.v_mm
    result = {}
    for name, rows in (("target", ~problem.is_fiducial), ("fiducial", problem.is_fiducial)):
        rms_um = UM_PER_MM * _rms(observed.v_mm[rows, 0]), UM_PER_MM * _rms(observed.v_mm[rows, 1])
        result[name] = _group(float(weighted[rows].sum()), float(observed.redundancy[rows].sum()), *rms_um)
    result.update(_prior_groups(problem, state, variances))
    for name in dict.fromkeys(each.group for each in problem.further):
        vpv = square_sum(tuple(each for each in problem.further if each.group == name), state.values)
        result[name] = _group(vpv, sum(each.redundancy for each in further if each.group == name), 0.0, 0.0)
    return result


def _prior_groups(problem: Problem, state: State, variances: Array) -> Iterator[tuple[str, Group]]:
    unknowns = problem.unknowns
    v = -prior_differences(problem, state)
    given = np.where(unknowns.has_prior, unknowns.sigma, 1.0) ** 2
    redundancy = 1.0 - variances / given
    kinds = {"control": "PT.", "datum": "FID.", "interior": "IO.", "exterior": "EO."}
    names = np.array(unknowns.names)
    for group, prefix in kinds.items():
        members = unknowns.has_prior & np.char.startswith(names, prefix)
        if not members.any() and group != "control":
            continue
        rms = [0.0, 0.0]
        if group in ("control", "datum"):
            scale = 1e6 if group == "control" else UM_PER_MM
            axes = ("X", "Y") if group == "control" else ("x", "y")
            rms = [scale * _rms(v[members & np.char.endswith(names, f".{axis}")]) for axis in axes]
        vpv = float((v[members] ** 2 / given[members]).sum())
        yield group, _group(vpv, float(redundancy[members].sum()), *rms)


def _group(vpv: float, redundancy: float, rms_x_um: float, rms_y_um: float) -> Group:
    sigma0 = float(np.sqrt(vpv / redundancy)) if redundancy > UNCHECKED else 0.0
    return Group(sigma0, rms_x_um, rms_y_um, redundancy)


def _rms(v: Array) -> float:
    return float(np.sqrt(np.mean(v**2))) if len(v) else 0.0
