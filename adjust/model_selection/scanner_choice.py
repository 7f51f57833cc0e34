"""Selection of scanner terms: the few significant ones among those that are estimable.

One adjustment with all terms, constrained by a weak prior, gives their normal equations with all other unknowns
eliminated: G = Q⁻¹ - I / sigma², g = Q⁻¹ x, with Q the cofactor matrix of the terms and x their values. The solution
for any subset A follows from these: x_A = G_AA⁻¹ g_A, which lowers v'Pv by g_A' G_AA⁻¹ g_A. Terms are added one at a
time (forward selection), smooth terms before carriage terms, the one with the largest decrease first, while its F-test
is significant after Bonferroni correction for all candidates.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import carriage_terms, smooth_terms
from adjust.problem.network import Network, Scanner
from adjust.problem.parameter import Parameter
from adjust.quality.significance import LEVEL, f_probability
from adjust.rank_defect.directions import HARDLY, scan_poses, undetermined_term_sentences
from adjust.solution.result import Adjustment

WEAK_MM = 0.1  # weak prior of every term in the trial, removed afterwards; it keeps terms not estimable small


def bent_network(network: Network, terms: Sequence[str], sigma_mm: float = np.inf) -> Network:
    """Add terms to every scanner of a network's images, over the extent of their observations.

    sigma_mm: standard deviation of every term, given as 0.
    """
    return network_with_terms(network, dict.fromkeys(_scanners(network), terms), sigma_mm)


def network_with_terms(network: Network, terms: Mapping[str, Sequence[str]], sigma_mm: float = np.inf) -> Network:
    """Set the terms of the scanners of a network's images, each given as 0.

    terms: names by scanner; a missing scanner has none. Lenses of digital cameras used as scanners are kept.
    """
    scanners = []
    lenses = {scanner.name: scanner.lens for scanner in network.scanners}
    for name in _scanners(network):
        scanned = np.array([image.scanner == name for image in network.images])[network.image_numbers]
        lowest, highest = (edge(network.observations.xy_mm[scanned], axis=0) for edge in (np.min, np.max))
        x, y = (lowest + highest) / 2.0
        half_x, half_y = np.maximum(highest - lowest, 1e-3) / 2.0
        priors = dict.fromkeys(terms.get(name, ()), Prior(0.0, sigma_mm))
        extent = (float(x), float(y)), (float(half_x), float(half_y))
        scanners.append(Scanner(name, priors, *extent, lenses.get(name)))
    return replace(network, scanners=tuple(scanners))


def choose_bends(
    network: Network, adjusted: Callable[[Network], Adjustment], sigma_mm: float = np.inf
) -> tuple[Network, tuple[str, ...]]:
    """Select the significant terms of every scanner; also return remarks on terms that are not estimable.

    adjusted: adjusts a network; called once, with all candidates. sigma_mm: as in `bent_network`.
    """
    films = {image.transformation for image in network.images if image.scanner}
    smooth, carriage = smooth_terms(films), carriage_terms(films)
    candidates = (*smooth, *carriage)
    trial = adjusted(network_with_terms(network, dict.fromkeys(_scanners(network), candidates), WEAK_MM))
    if not trial.converged:
        causes = "".join(f" {each.cause}" for each in trial.singular)
        remark = (
            "No bend of the scanner was estimated: the adjustment with all of its terms ended with "
            f"{trial.termination}.{causes}"
        )
        return network_with_terms(network, {}), (remark,)
    chosen: dict[str, tuple[str, ...]] = {}
    remarks: list[str] = []
    cameras = trial.network.cameras
    distortion = [Parameter.interior(camera.name, name) for camera in cameras for name in camera.distortion.parameters]
    distortion = [key for key in distortion if trial.has(key) and trial.sigma(key) > 0.0]
    for scanner in trial.network.scanners:
        equations, taken = _equations(trial, scanner), list[str]()
        for among in (smooth, carriage):
            while (best := equations.next(taken, among)) is not None and best[1] < LEVEL / len(candidates):
                taken.append(best[0])
        chosen[scanner.name] = needed = tuple(term for term in candidates if term in taken)
        undetermined_terms = [term for term in equations.undetermined_terms(needed) if term in smooth]
        with_lens = _equations(trial, scanner, distortion).undetermined_terms(needed)
        poses = scan_poses(trial.run.problem, trial.run.end.state, scanner.name)
        remarks += undetermined_term_sentences(
            scanner.name, undetermined_terms, set(undetermined_terms) - set(with_lens), poses
        )
    return network_with_terms(network, chosen, sigma_mm), tuple(remarks)


def _scanners(network: Network) -> list[str]:
    return sorted({image.scanner for image in network.images} - {""})


@dataclass(frozen=True)
class _Equations:
    """Normal equations of the terms of one scanner, all other unknowns eliminated."""

    terms: tuple[str, ...]  # names
    # normal, right: (k, k), (k,)
    normal: Array
    right: Array
    known: Array  # (k,) diagonal of `normal` if everything else were known
    # vpv, redundancy: of the adjustment without a term
    vpv: float
    redundancy: int

    def undetermined_terms(self, taken: Sequence[str]) -> list[str]:
        """Terms not estimable separately from the other unknowns and the terms taken."""
        left, _ = self._reduced(taken)
        return [term for term, determined in zip(self.terms, left, strict=True) if term not in taken and not determined]

    def next(self, taken: Sequence[str], among: Collection[str]) -> tuple[str, float] | None:
        """Return the term that lowers v'Pv most in addition to those taken, and its p-value."""
        determined, explained = self._reduced(taken)
        open_ = np.array([each in among and each not in taken for each in self.terms]) & determined
        if not open_.any():
            return None
        best = int(np.argmax(np.where(open_, explained, -np.inf)))
        redundancy, at = self.redundancy - len(taken) - 1, [self.terms.index(each) for each in taken]
        by_taken = self.right[at] @ np.linalg.solve(self.normal[np.ix_(at, at)], self.right[at])
        left = self.vpv - float(by_taken) - float(explained[best])
        variance, redundancy = (left / redundancy, redundancy) if redundancy > 0 and left > 0.0 else (1.0, 0)
        return self.terms[best], f_probability(float(explained[best]) / variance, 1, redundancy)

    def _reduced(self, taken: Sequence[str]) -> tuple[Mask, Array]:
        """For every term, given those taken: whether it is estimable, and its decrease of v'Pv."""
        at = [self.terms.index(each) for each in taken]
        solved = np.linalg.solve(self.normal[np.ix_(at, at)], np.column_stack([self.normal[at], self.right[at]]))
        normal = np.diag(self.normal) - (self.normal[:, at] * solved[:, :-1].T).sum(axis=1)
        right = self.right - self.normal[:, at] @ solved[:, -1]
        determined = normal > self.known / HARDLY**2
        return determined, np.where(determined, right**2 / np.where(determined, normal, 1.0), 0.0)


def _equations(trial: Adjustment, scanner: Scanner, held: Sequence[Parameter] = ()) -> _Equations:
    """Normal equations of one scanner's terms, with those of other scanners free; held: other unknowns held fixed."""
    terms = tuple(scanner.terms)
    keys = [Parameter.scanner(scanner.name, term) for term in terms]
    values = trial.values_of(keys)
    cofactor, count = trial.cofactor_of([*keys, *held]), len(keys)
    by_held = cofactor[:count, count:]
    taken = by_held @ np.linalg.solve(cofactor[count:, count:], by_held.T) if held else 0.0
    normal = np.linalg.inv(cofactor[:count, :count] - taken)
    right = normal @ values
    observations, rows = trial.network.observations, trial.network.rows_by_scanner[scanner.name]
    weights = np.linalg.inv(observations.covariance_mm2[rows])
    if len(trial.weights):
        weights = weights * trial.weights[rows][:, None, None]
    design = scanner.bend.displacement(np.zeros(len(terms)), observations.xy_mm[rows]).parameter_jacobian
    known = np.einsum("nik,nij,njk->k", design, weights, design)
    without = trial.vpv + float(values @ normal @ values)
    return _Equations(
        terms, normal - np.eye(len(terms)) / WEAK_MM**2, right, np.asarray(known), without, trial.redundancy
    )
