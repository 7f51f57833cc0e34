"""Significance tests of camera, scanner and board parameters, and compatibility tests against earlier calibrations.

The null hypothesis is 0 for distortion and the given value for c, x0' and y0'. The difference d of k parameters from it
has the cofactor Q; F = d' Q⁻¹ d / (k sigma0²) is F(k, r) distributed with the redundancy r, its root Student's t for
k = 1. A given value with a prior sigma differs by -v, of the cofactor sigma² - q (Koch 1999, 4.2 and 4.3).

A whole calibration with covariance C = L L' and residuals v is tested by u' S⁺ u, u = L⁻¹ v, S = I - H: chi-square with
the rank of S as degrees of freedom (Baarda 1968; Förstner and Wrobel, 4.6.4).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtr, stdtr

from adjust.array_types import Array, Mask
from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.problem.estimates import Estimates, GivenGroup
from adjust.problem.further_observations import ObservedCalibration
from adjust.problem.parameter import Kind, Parameter
from adjust.quality.run import Run, surplus

LEVEL = 0.01  # significance level: probability of calling a superfluous parameter significant
FIXED = Prior(0.0)
UNCHECKED = 1e-6  # redundancy of a prior below which it cannot be tested


@dataclass(frozen=True)
class SignificanceTest:
    """Significance test of parameters, by their names in the family or c, x0, y0.

    statistic: t of one parameter, F of a group. p: p-value.
    """

    name: str
    parameters: tuple[str, ...]
    statistic: float
    p: float

    @property
    def is_group(self) -> bool:
        return len(self.parameters) > 1

    @property
    def significant(self) -> bool:
        return self.p < LEVEL


def significance_tests(estimates: Estimates) -> dict[tuple[str, str], tuple[SignificanceTest, ...]]:
    """Test every estimated parameter, then groups of at least two.

    Parameters
    ----------
    estimates : of a network; nothing is tested without a solution

    Returns
    -------
    dict
        By kind and owner. "interior": c, x0, y0 where a value is given, the distortion's parameters, every group of its
        family, and "all" of them together. "scanner": the terms of the bend. "board": the bends along both axes.
    """
    if not estimates.converged:
        return {}
    network, tests = estimates.network, dict[tuple[str, str], tuple[SignificanceTest, ...]]()
    for camera in network.cameras:
        if camera.name not in network.idle_cameras:
            interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
            given = (_against_given(estimates, camera.name, name, prior) for name, prior in interior.items())
            lens = family(camera.distortion.family)
            priors = {name: camera.distortion.parameters.get(name, FIXED) for name in lens.parameters}
            own = _against_zero(estimates, "interior", camera.name, priors, dict(lens.groups))
            tests["interior", camera.name] = (*filter(None, given), *own)
    for scanner in network.scanners:
        tests["scanner", scanner.name] = _against_zero(estimates, "scanner", scanner.name, scanner.terms)
    for board in network.boards:
        bends = dict(zip(board.names, board.bends, strict=True))
        tests["board", board.name] = _against_zero(estimates, "board", board.name, bends)
    return tests


def _against_zero(
    estimates: Estimates,
    kind: Kind,
    owner: str,
    priors: Mapping[str, Prior],
    groups: Mapping[str, Sequence[str]] | None = None,
) -> tuple[SignificanceTest, ...]:
    """Tests of the quantities that are not fixed: single, in groups, and all together if no group holds all."""
    estimated = tuple(name for name, prior in priors.items() if prior.sigma > 0.0)
    several = {name: tuple(each for each in members if each in estimated) for name, members in (groups or {}).items()}
    several = {name: members for name, members in several.items() if len(members) > 1}
    if len(estimated) > 1 and list(several.values()) != [estimated]:
        several["all"] = estimated
    tests = []
    for name, quantities in [*((name, (name,)) for name in estimated), *several.items()]:
        tested = [Parameter(kind, owner, "", each) for each in quantities]
        values, cofactor = estimates.values_of(tested), estimates.cofactor_of(tested)
        tests.append(_significance_test(estimates, name, quantities, values, cofactor))
    return tuple(tests)


def _against_given(estimates: Estimates, camera: str, name: str, prior: Prior | None) -> SignificanceTest | None:
    full = Parameter.interior(camera, name)
    if prior is None or prior.sigma == 0.0:
        return None
    cofactor = float(estimates.cofactor_of([full])[0, 0])
    if np.isfinite(prior.sigma):
        given = prior.sigma**2
        if GivenGroup("interior", camera) in estimates.variance.left_out:
            given /= estimates.sigma0**2
        redundancy = 1.0 - cofactor / given
        if redundancy < UNCHECKED:
            return None
        cofactor = given * redundancy
    difference = np.array([estimates.value(full) - prior.value])
    return _significance_test(estimates, name, (name,), difference, np.array([[cofactor]]))


def _significance_test(
    estimates: Estimates, name: str, parameters: tuple[str, ...], difference: Array, cofactor: Array
) -> SignificanceTest:
    scale, count = np.sqrt(np.diag(cofactor)), len(parameters)
    normalised, r = difference / scale, estimates.variance.redundancy
    if count == 1:
        t = float(normalised[0]) / estimates.sigma0
        one_sided = stdtr(r, -abs(t)) if r > 0 else ndtr(-abs(t))
        return SignificanceTest(name, parameters, t, 2.0 * float(one_sided))
    square = float(normalised @ np.linalg.solve(cofactor / np.outer(scale, scale), normalised))
    statistic = square / (count * estimates.sigma0**2)
    p = fdtrc(count, r, statistic) if r > 0 else chdtrc(count, square)
    return SignificanceTest(name, parameters, statistic, float(p))


UNSEEN = 1e-6  # least redundancy of a direction that the other observations determine


@dataclass(frozen=True, eq=False)
class CalibrationTest:
    """Compatibility test of the images with correlated observations."""

    group: str
    parameters: tuple[Parameter, ...]  # (m,)
    # difference, sigma: (m,) value from the images minus observed value, and its a-posteriori standard deviation; nan
    # and inf where the images do not determine it
    difference: Array
    sigma: Array
    statistic: float  # of all together, F with `freedom` and the redundancy of the other observations
    freedom: int
    probability: float  # p-value

    @property
    def direction(self) -> tuple[int, ...]:
        """Indices of the quantities, sorted by the difference in standard deviations, the largest first."""
        size = np.where(np.isfinite(self.difference), np.abs(self.difference) / self.sigma, 0.0)
        return tuple(np.argsort(-size, kind="stable").tolist())


def calibration_tests(run: Run, sigma0: float, redundancy: float) -> Iterator[CalibrationTest]:
    """Test every earlier calibration of several quantities; sigma0, redundancy: of the whole adjustment."""
    vpv = sigma0**2 * redundancy
    for each, block in zip(run.problem.further, run.end.rows.further, strict=True):
        if not isinstance(each, ObservedCalibration) or len(each.observed) < 2:
            continue
        root = np.linalg.cholesky(each.covariance)
        free, directions = np.linalg.eigh(surplus(block, run.factor))
        visible = free > UNSEEN
        freedom = int(visible.sum())
        if not freedom:
            continue
        u = directions.T @ np.linalg.solve(root, each.computed(run.end.state.values) - each.observed)
        chi_square = float((u[visible] ** 2 / free[visible]).sum())
        left = round(redundancy) - freedom
        variance = (vpv - chi_square) / left if left > 0 and vpv > chi_square else 1.0
        along = _as_marks_show(root @ directions, ~visible, each.parameters)
        difference = along[:, visible] @ (u[visible] / free[visible])
        sigma = np.sqrt(variance * (along[:, visible] ** 2 / free[visible]).sum(axis=1))
        hidden = (along[:, ~visible] ** 2).sum(axis=1) > UNSEEN * np.diag(each.covariance)
        test = chi_square / freedom / variance
        yield CalibrationTest(
            group=each.group,
            parameters=each.parameters,
            difference=np.where(hidden, np.nan, difference),
            sigma=np.where(hidden, np.inf, sigma),
            statistic=test,
            freedom=freedom,
            probability=float(fdtrc(freedom, left, test) if left > 0 else chdtrc(freedom, chi_square)),
        )


def _as_marks_show(along: Array, unseen: Mask, parameters: Sequence[Parameter]) -> Array:
    """Combine changes (n, m) of the quantities with undetermined ones such that the fiducial marks move least."""
    # The frame of the marks can shift, rotate and scale together with the camera. As in a comparison of two
    # calibrations, the reported change of c is then the one relative to the marks.
    is_mark = np.array([each.kind == "fiducial" for each in parameters])
    by_marks = np.linalg.pinv(along[:, unseen] * is_mark[:, None], rcond=UNSEEN)
    return np.asarray(along - along[:, unseen] @ (by_marks @ along))
