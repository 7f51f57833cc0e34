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
from scipy.special import chdtrc, fdtrc, ndtr, stdtr

from adjust.array_types import Array
from adjust.functional_model.board import BOARD_NAMES
from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.estimates import Estimates, GivenGroup
from adjust.problem.parameter import Kind, Parameter

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
    def is_group(self) -> bool:
        return len(self.parameters) > 1

    @property
    def significant(self) -> bool:
        return self.p < LEVEL


def significance_tests(estimates: Estimates) -> dict[tuple[str, str], tuple[SignificanceTest, ...]]:
    """Tests of every parameter that was estimated, then of groups of at least two.

    Parameters
    ----------
    estimates : of a network; without a solution nothing is tested

    Returns
    -------
    dict
        By kind and owner. "interior": c, x0, y0 where a value is given, the distortion's parameters, every group of its
        family, and "all" of them together. "scanner": the terms of the bend. "board": the bends along both axes.
    """
    if not estimates.converged:
        return {}
    network = estimates.network
    cameras = (camera for camera in network.cameras if camera.name not in network.idle_cameras)
    tests = {("interior", camera.name): _camera_tests(estimates, camera) for camera in cameras}
    tests |= {
        ("scanner", each.name): _term_tests(estimates, "scanner", each.name, each.terms) for each in network.scanners
    }
    for board in network.boards:
        bends = dict(zip(BOARD_NAMES, board.bends, strict=True))
        tests["board", board.name] = _term_tests(estimates, "board", board.name, bends)
    return tests


def _camera_tests(estimates: Estimates, camera: Camera) -> tuple[SignificanceTest, ...]:
    interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
    given = (_against_given(estimates, camera.name, name, prior) for name, prior in interior.items())
    estimated = _estimated(camera)
    groups = dict(family(camera.distortion.family).groups) | {"all": estimated}
    present = {name: tuple(each for each in members if each in estimated) for name, members in groups.items()}
    several = {name: members for name, members in present.items() if len(members) > 1}
    if len(several) == 2 and len(set(several.values())) == 1:
        del several["all"]
    tested = [(name, (name,)) for name in estimated] + list(several.items())
    own = (_against_zero(estimates, "interior", camera.name, *each) for each in tested)
    return (*filter(None, given), *own)


def _term_tests(
    estimates: Estimates, kind: Kind, owner: str, terms: Mapping[str, Prior]
) -> tuple[SignificanceTest, ...]:
    estimated = tuple(name for name, prior in terms.items() if prior.sigma > 0.0)
    tested = [(name, (name,)) for name in estimated] + ([("all", estimated)] if len(estimated) > 1 else [])
    return tuple(_against_zero(estimates, kind, owner, *each) for each in tested)


def _estimated(camera: Camera) -> tuple[str, ...]:
    given = camera.distortion.parameters
    names = family(camera.distortion.family).parameters
    return tuple(name for name in names if name in given and given[name].sigma > 0.0)


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
    return _tested(estimates, name, (name,), np.array([estimates.value(full) - prior.value]), np.array([[cofactor]]))


def _against_zero(
    estimates: Estimates, kind: Kind, owner: str, name: str, quantities: Sequence[str]
) -> SignificanceTest:
    tested = [Parameter(kind, owner, "", each) for each in quantities]
    return _tested(estimates, name, tuple(quantities), estimates.values_of(tested), estimates.cofactor_of(tested))


def _tested(
    estimates: Estimates, name: str, parameters: tuple[str, ...], difference: Array, cofactor: Array
) -> SignificanceTest:
    scale = np.sqrt(np.diag(cofactor))
    normalised = difference / scale
    variance = estimates.sigma0**2
    r = estimates.variance.redundancy
    if len(parameters) == 1:
        t = float(normalised[0]) / float(np.sqrt(variance))
        one_sided = stdtr(r, -abs(t)) if r > 0 else ndtr(-abs(t))
        return SignificanceTest(name, parameters, t, 2.0 * float(one_sided))
    count = len(parameters)
    square = float(normalised @ np.linalg.solve(cofactor / np.outer(scale, scale), normalised))
    statistic = square / (count * variance)
    p = fdtrc(count, r, statistic) if r > 0 else chdtrc(count, square)
    return SignificanceTest(name, parameters, statistic, float(p))
