"""Whether the data need a parameter: of distortion, interior orientation and scanner, one by one and in groups.

A parameter, or a group of k, is compared with a value x0 that would make it superfluous: 0 for distortion, the given
value for c, x0' and y0'. With d = x - x0 and Q the cofactor matrix of d,

    t = d / (sigma0 √Q)  ~  Student's t with the redundancy r,       F = d' Q⁻¹ d / (k sigma0²)  ~  F(k, r),

where sigma0 and r are those of the variance factor; without redundancy sigma0 is 1 and t normal. What has a prior is no
free quantity: the difference from its given value, -v of that observation, has the cofactor sigma² - q (Koch, Parameter
estimation and hypothesis testing in linear models, 1999, chapters 4.2 and 4.3).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc, ndtr, stdtr

from adjust.functional_model.board import BOARD_NAMES
from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Board, Scanner
from adjust.problem.parameter import Kind, Parameter
from adjust.problem.result import Adjustment, GivenGroup

Array = NDArray[np.float64]

LEVEL = 0.01  # probability of calling a superfluous parameter significant
UNCHECKED = 1e-6  # redundancy of a prior below which the data say nothing against it


@dataclass(frozen=True)
class SignificanceTest:
    """A test of some parameters of a camera, by their names in the family or c, x0, y0.

    statistic: t of one parameter, F of a group. p: the probability of a larger one, in size, by chance alone.
    """

    name: str
    parameters: tuple[str, ...]
    statistic: float
    p: float

    @property
    def significant(self) -> bool:
        return self.p < LEVEL


def parameter_tests(adjustment: Adjustment, camera: Camera) -> tuple[SignificanceTest, ...]:
    """Of every parameter that was estimated: c, x0, y0 where a value is given, and the distortion's."""
    if not _has_tests(adjustment, camera):
        return ()
    interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
    tests = [_against_given(adjustment, camera.name, name, prior) for name, prior in interior.items()]
    found = [test for test in tests if test is not None]
    return (*found, *(_against_zero(adjustment, "interior", camera.name, name, (name,)) for name in _estimated(camera)))


def group_tests(adjustment: Adjustment, camera: Camera) -> tuple[SignificanceTest, ...]:
    """Of every group of the family of which at least two parameters were estimated, and of all of them together."""
    if not _has_tests(adjustment, camera):
        return ()
    estimated = _estimated(camera)
    groups = dict(family(camera.distortion.family).groups) | {"all": estimated}
    present = {name: tuple(each for each in members if each in estimated) for name, members in groups.items()}
    several = {name: members for name, members in present.items() if len(members) > 1}
    if len(several) == 2 and len(set(several.values())) == 1:
        del several["all"]
    return tuple(_against_zero(adjustment, "interior", camera.name, name, members) for name, members in several.items())


def scanner_tests(adjustment: Adjustment, scanner: Scanner) -> tuple[SignificanceTest, ...]:
    """Of every term of a scanner's bend that was estimated, and of all of them together."""
    return _of_terms(adjustment, "scanner", scanner.name, scanner.terms)


def board_tests(adjustment: Adjustment, board: Board) -> tuple[SignificanceTest, ...]:
    """Of the bends of a board along each axis that were estimated, and of both together."""
    return _of_terms(adjustment, "board", board.name, dict(zip(BOARD_NAMES, board.bends, strict=True)))


def _of_terms(
    adjustment: Adjustment, kind: Kind, owner: str, terms: Mapping[str, Prior]
) -> tuple[SignificanceTest, ...]:
    estimated = tuple(name for name, prior in terms.items() if prior.sigma > 0.0)
    if not adjustment.converged or not estimated:
        return ()
    several = {"all": estimated} if len(estimated) > 1 else {}
    tested = {name: (name,) for name in estimated} | several
    return tuple(_against_zero(adjustment, kind, owner, name, members) for name, members in tested.items())


def _has_tests(adjustment: Adjustment, camera: Camera) -> bool:
    return adjustment.converged and camera.name not in adjustment.network.idle_cameras


def _estimated(camera: Camera) -> tuple[str, ...]:
    given = camera.distortion.parameters
    names = family(camera.distortion.family).parameters
    return tuple(name for name in names if name in given and given[name].sigma > 0.0)


def _against_given(adjustment: Adjustment, camera: str, name: str, prior: Prior | None) -> SignificanceTest | None:
    full = Parameter.interior(camera, name)
    if prior is None or prior.sigma == 0.0:
        return None
    cofactor = float(adjustment.cofactor_of([full])[0, 0])
    if np.isfinite(prior.sigma):
        given = prior.sigma**2
        if GivenGroup("interior", camera) in adjustment.variance.left_out:
            given /= adjustment.sigma0**2
        redundancy = 1.0 - cofactor / given
        if redundancy < UNCHECKED:
            return None
        cofactor = given * redundancy
    return _tested(adjustment, name, (name,), np.array([adjustment.value(full) - prior.value]), np.array([[cofactor]]))


def _against_zero(
    adjustment: Adjustment, kind: Kind, owner: str, name: str, quantities: Sequence[str]
) -> SignificanceTest:
    tested = [Parameter(kind, owner, "", each) for each in quantities]
    return _tested(adjustment, name, tuple(quantities), adjustment.values_of(tested), adjustment.cofactor_of(tested))


def _tested(
    adjustment: Adjustment, name: str, parameters: tuple[str, ...], difference: Array, cofactor: Array
) -> SignificanceTest:
    scale = np.sqrt(np.diag(cofactor))
    normalised = difference / scale
    variance = adjustment.sigma0**2
    r = adjustment.variance.redundancy
    if len(parameters) == 1:
        t = float(normalised[0]) / float(np.sqrt(variance))
        one_sided = stdtr(r, -abs(t)) if r > 0 else ndtr(-abs(t))
        return SignificanceTest(name, parameters, t, 2.0 * float(one_sided))
    count = len(parameters)
    square = float(normalised @ np.linalg.solve(cofactor / np.outer(scale, scale), normalised))
    statistic = square / (count * variance)
    p = fdtrc(count, r, statistic) if r > 0 else chdtrc(count, square)
    return SignificanceTest(name, parameters, statistic, float(p))
