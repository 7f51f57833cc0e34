"""Test whether the standard deviations of the marks are too small everywhere and nothing else is wrong.

The residuals are then pure noise: normally distributed, of equal variance in all images, and independent of their
neighbours. With a standard deviation added to that of all marks, of targets alone or of fiducials alone, every group of
observations agrees.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import KDTree
from scipy.special import chdtr, chdtrc, ndtr

from adjust.array_types import Array, Indices, Mask
from adjust.quality.residuals import residuals
from adjust.quality.run import Run
from adjust.solution.reweighting import again

FEWEST = 30  # coordinates needed to test the distribution of residuals
CHANCE = 0.001  # significance level of each test of the noise hypothesis
NEIGHBOURS = 8  # nearest neighbours searched for one in the same, or in another, image
UNCHECKED = 0.05  # redundancy number below which a residual is not tested
KINDS = (("marks", ("target", "tie", "fiducial")), ("targets", ("target", "tie")), ("fiducials", ("fiducial",)))
STEPS = 20
UM_PER_MM = 1000.0


@dataclass(frozen=True)
class AddedNoise:
    """Noise added to marks.

    Attributes
    ----------
    marks : "marks", "targets" or "fiducials".
    sigma_mm : added standard deviation.
    covariance_mm2 : (n, 2, 2) given covariances of the marks.
    run : adjustment with the added noise.
    """

    marks: str
    sigma_mm: float
    covariance_mm2: Array
    run: Run

    @property
    def words(self) -> tuple[str, str]:
        """Cause and remedy."""
        given_um = UM_PER_MM * float(np.sqrt(np.median(np.trace(self.covariance_mm2, axis1=1, axis2=2) / 2.0)))
        added_um = UM_PER_MM * self.sigma_mm
        key = "sigma_fiducial_um" if self.marks == "fiducials" else "sigma_target_um"
        return (
            f"The standard deviations given to the {self.marks} are too small everywhere: the residuals are plain "
            f"noise, alike in all images; {added_um:.3g} µm added to the {given_um:.3g} µm given (in quadrature) "
            "explains all",
            f"Give film_sigma_um = {added_um:.3g} under [adjust], which is added to the sigma of every mark, or larger "
            f"sigmas in comparator.csv or {key}.",
        )


def added_noise(run: Run, redundancy: int) -> AddedNoise | None:
    """Estimate the standard deviation that, added to those of marks, explains all residuals; None where none does."""
    if not _is_noise(run):
        return None
    network = run.problem.network
    kind, covariance = np.array(network.observations.kind), network.observations.covariance_mm2
    for marks, kinds in KINDS:
        members = np.isin(kind, kinds)
        if marks != "marks" and members.all():
            continue
        sigma_mm = _added_sigma(run, members, redundancy)
        if sigma_mm is None:
            continue
        larger = covariance + np.where(members, sigma_mm**2, 0.0)[:, None, None] * np.eye(2)
        observations = replace(network.observations, covariance_mm2=larger)
        problem = replace(run.problem, network=replace(network, observations=observations))
        noisy = again(replace(run, problem=problem), run.weighting, STEPS, run.end.state)
        if noisy.converged and noisy.is_tested and _groups_agree(noisy):
            return AddedNoise(marks, sigma_mm, covariance, noisy)
    return None


def _is_noise(run: Run) -> bool:
    """Whether standardised residuals are normal, homogeneous over images and independent of neighbours."""
    v = residuals(run)
    checked = (v.redundancy > UNCHECKED).all(axis=1)
    if 2 * checked.sum() < FEWEST:
        return False
    w, images = v.w[checked], run.problem.image_numbers[checked]
    places = run.end.computed_mm[checked]
    points = np.array(run.problem.network.observations.point)[checked]
    in_object = np.einsum("nji,nj->ni", run.end.state.rotations[images][:, :2], w)
    return (
        _is_normal(w)
        and _is_alike(w, v.redundancy[checked], images)
        and not _is_shared(w, places, images, same_image=True)
        and not _is_shared(w, places, images, same_image=False)
        and not _is_shared_by_point(in_object, points, images)
    )


def _is_normal(w: Array) -> bool:
    """Test the kurtosis of all coordinates, with its standard deviation √(24 / n)."""
    w = w.ravel()
    kurtosis = np.mean(w**4) / np.mean(w**2) ** 2 - 3.0
    return bool(ndtr(-abs(kurtosis) / np.sqrt(24.0 / len(w))) > 0.5 * CHANCE)


def _is_alike(w: Array, redundancy: Array, images: Indices) -> bool:
    """Test by chi-square whether all images have the same mean square."""
    shares = np.bincount(images, (w**2 * redundancy).sum(axis=1))
    freedom = np.bincount(images, redundancy.sum(axis=1))
    present = freedom > 1.0
    if present.sum() < 2:
        return True
    variance = shares.sum() / freedom.sum()
    square = ((shares[present] / variance - freedom[present]) ** 2 / (2.0 * freedom[present])).sum()
    return bool(chdtrc(present.sum() - 1, square) > CHANCE)


def _is_shared(w: Array, places: Array, images: Indices, same_image: bool) -> bool:
    """Whether the residuals of nearest neighbours, in the same image or in others, are positively correlated."""
    if same_image:  # a third coordinate separates the images in the tree
        apart = 10.0 * float(np.ptp(places, axis=0).max())
        places = np.column_stack([places, apart * images])
    near = np.asarray(KDTree(places).query(places, min(NEIGHBOURS, len(places)))[1])
    wanted = (images[near] == images[:, None]) == same_image
    wanted &= near != np.arange(len(w))[:, None]
    rows = np.flatnonzero(wanted.any(axis=1))
    nearest = near[rows, wanted[rows].argmax(axis=1)]
    return len(rows) > 2 and _is_positive((w[rows] * w[nearest]).sum(axis=1))


def _is_shared_by_point(in_object: Array, points: NDArray[np.str_], images: Indices) -> bool:
    """Whether a point's residuals, rotated into object axes, are positively correlated between images."""
    order = np.lexsort((images, points))
    follows = points[order][1:] == points[order][:-1]
    products = (in_object[order][1:] * in_object[order][:-1]).sum(axis=1)[follows]
    return len(products) > 2 and _is_positive(products)


def _is_positive(products: Array) -> bool:
    """Whether the sum of products of residuals, of expectation 0 if independent, is significantly positive."""
    z = products.sum() / np.sqrt(2.0 * (products**2).sum())  # factor 2: most pairs of neighbours occur twice
    return bool(ndtr(-z) < 0.5 * CHANCE)


def _added_sigma(run: Run, members: Mask, redundancy: int) -> float | None:
    """Standard deviation in mm with which v'Pv of the same residuals equals the redundancy."""
    given = run.problem.network.observations.covariance_mm2 / run.weighting.weights[: len(members), None, None]
    v = run.end.v_mm
    rest = run.end.vpv - float(np.einsum("ni,nij,nj->n", v, np.linalg.inv(given), v)[members].sum())

    def excess(variance: float) -> float:
        weight = np.linalg.inv(given[members] + variance * np.eye(2))
        return float(np.einsum("ni,nij,nj->", v[members], weight, v[members])) + rest - redundancy

    largest = float((v**2).max())
    if excess(largest) >= 0.0:
        return None
    return float(np.sqrt(brentq(excess, 0.0, largest, rtol=1e-6)))


def _groups_agree(run: Run) -> bool:
    """Whether every group of observations agrees with its standard deviations in a two-sided test."""
    for name in np.unique(run.units.groups):
        vpv, freedom = run.group_sums((run.units.groups == name) & run.weighting.used)
        if freedom > 1.0 and min(chdtr(freedom, vpv), chdtrc(freedom, vpv)) < CHANCE:
            return False
    return True
