"""What explains the misfits of a camera's frames: ordinary film, one frame's bent film, a mark that lies elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, fdtrc

from measure.checks.doubts import TOLD
from measure.checks.misfits import Misfit, Pattern, log_densities_wider
from measure.film import SCATTER_DEGREES
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.probabilities import FALSE_DOUBT

Array = NDArray[np.float64]

_AS_ODD = 0.5  # of the logarithm of the least probability: frames that stand out as well are looked at together
_LEAST_CHANCE = 1e-300
_ROUNDS = 3


@dataclass(frozen=True)
class Film:
    """How marks scatter by film and scanner beside what all frames share: sigma_mm along an axis, known with so many
    degrees of freedom. is_more: whether that is more than was believed beforehand, beyond chance."""

    sigma_mm: float
    degrees: float
    is_more: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame's misfit, with its marks' own variances, and what explains it. chance: the probability that ordinary
    film makes as much; film_mm: of film that stands out, None of ordinary film; off_mm: by how much marks are off, by
    their number in the misfit, and variances_mm2 (n,), what that adds to theirs."""

    misfit: Misfit
    variances_mm2: Array
    chance: float = 1.0
    film_mm: float | None = None
    off_mm: Mapping[int, float] = field(default_factory=dict)

    def under(self, film: Film) -> Misfit:
        """The misfit with all variances."""
        return self.misfit.widened(self.variances_mm2 + (film.sigma_mm if self.film_mm is None else self.film_mm) ** 2)


@dataclass(frozen=True, eq=False)
class Explanation:
    """Of all frames of a camera, by their places, with the pattern that they share."""

    frames: Mapping[int, Frame]
    pattern: Pattern
    film: Film

    def expected_mm(self, place: int) -> tuple[Array, Array]:
        """The pattern at a frame's marks, by all others, and its covariance."""
        return self.pattern.without(self.frames[place].under(self.film))

    @property
    def log_evidence(self) -> float:
        """What is strange costs as much as it is rare."""
        strange = sum((each.film_mm is not None) + len(each.off_mm) for each in self.frames.values())
        misfits = [each.under(self.film) for each in self.frames.values()]
        return self.pattern.log_density(misfits) + strange * float(np.log(FALSE_DOUBT))

    @property
    def chance_of_pattern(self) -> float:
        """That what the frames share is no more than its sites' standard deviations say."""
        statistic = self.pattern.chi_square() / max(self.pattern.degrees, 1)
        return float(fdtrc(max(self.pattern.degrees, 1), self.film.degrees, statistic))


def explained(misfits: Mapping[int, Misfit], sigma_mm: Array, free_mm: float, believed_mm: float) -> Explanation:
    """The frames beside what the others have: those that stand out beyond chance, the worst first, are explained by one
    of their marks, where that alone does it far better than all else, or by their film.

    sigma_mm: of the pattern's sites; free_mm: by how much it may differ from that beforehand; believed_mm: of film.
    """
    frames = {place: Frame(each, np.zeros(len(each.index))) for place, each in misfits.items()}
    film = Film(believed_mm, SCATTER_DEGREES)
    while True:
        for _ in range(_ROUNDS):  # film tells the weights of the pattern, and the pattern what is left for film
            own = {place: each.under(film) for place, each in frames.items()}
            pattern = Pattern.of(list(own.values()), sigma_mm, free_mm)
            ordinary = [own[place] for place, each in frames.items() if each.film_mm is None]
            film = _film(ordinary, pattern, film, believed_mm)
        pattern = Pattern.of([each.under(film) for each in frames.values()], sigma_mm, free_mm)
        result = Explanation(frames, pattern, film)
        open_ = [place for place, each in frames.items() if each.film_mm is None]
        chances = {place: _chance(frames[place], pattern, film, believed_mm) for place in open_}
        least = min(chances.values(), default=1.0)
        if least * len(frames) >= FALSE_DOUBT:
            return result
        odd = [p for p in open_ if chances[p] * len(frames) < FALSE_DOUBT and _log(chances[p]) < _AS_ODD * _log(least)]
        frames = {
            place: _explained(replace(each, chance=chances[place]), result, place) if place in odd else each
            for place, each in frames.items()
        }


def _log(chance: float) -> float:
    return float(np.log(max(chance, _LEAST_CHANCE)))


def _chance(frame: Frame, pattern: Pattern, film: Film, believed_mm: float) -> float:
    """That film as it is believed, or as the other frames show it, makes as large a misfit, or one mark lie so far from
    where the others have it."""
    expected, covariance = pattern.without(frame.under(film))
    chances = [1.0]
    for sigma_mm, known in ((film.sigma_mm, film.degrees), (believed_mm, SCATTER_DEGREES)):
        own = frame.under(Film(sigma_mm, known))
        whole, degrees = own.chi_square(expected, covariance), own.degrees
        chances.append(float(fdtrc(degrees, known, whole / degrees)))
        if degrees > 2:
            rest = np.array([own.free(mark).chi_square(expected, covariance) for mark in range(len(own.index))])
            known += degrees - 2
            ratios = (whole - rest) / 2 / ((known - degrees + 2 + rest) / known)
            chances.append(len(rest) * float(fdtrc(2, known, ratios.max())))
    return min(chances)


def _explained(frame: Frame, result: Explanation, place: int) -> Frame:
    """A frame that stands out."""
    expected, covariance = result.expected_mm(place)
    own, film = frame.under(result.film), result.film
    densities = log_densities_wider(own, expected, covariance, film.sigma_mm)
    mark = int(densities[1:].argmax())
    if densities[mark + 1] - np.delete(densities, mark + 1).max() > TOLD:
        off_mm = float(own.free(mark).distances_mm(expected)[mark])
        variances = frame.variances_mm2 + np.where(np.arange(len(own.index)) == mark, off_mm**2, 0.0)
        return replace(frame, variances_mm2=variances, off_mm={**frame.off_mm, mark: off_mm})
    shown = _film_mm2(own.widened(-(film.sigma_mm**2)), expected, covariance)
    known = SCATTER_DEGREES * film.sigma_mm**2 + own.degrees * shown
    return replace(frame, film_mm=float(np.sqrt(known / (SCATTER_DEGREES + own.degrees))))


def _film_mm2(misfit: Misfit, expected: Array, covariance: Array) -> float:
    """What of the misfit's mean square its marks' own variances and the pattern's do not make."""
    n = misfit.beyond_affine
    made = 2 * float(np.trace(n.T @ (np.diag(misfit.variance_mm2) + covariance) @ n))
    return max(float(((misfit.z - n.T @ expected) ** 2).sum()) - made, 0.0) / misfit.degrees


def _film(misfits: list[Misfit], pattern: Pattern, before: Film, believed_mm: float) -> Film:
    """From the lower median of the frames, which those that stand out do not widen, beside what is believed."""
    if len(misfits) < 2:
        return Film(believed_mm, SCATTER_DEGREES)
    shown = sorted(
        _film_mm2(each.widened(-(before.sigma_mm**2)), *pattern.without(each))
        * each.degrees
        / float(chdtri(each.degrees, 0.5))
        for each in misfits
    )[(len(misfits) - 1) // 2]
    degrees = MEDIAN_EFFICIENCY * sum(each.degrees for each in misfits)
    variance = (SCATTER_DEGREES * believed_mm**2 + degrees * shown) / (SCATTER_DEGREES + degrees)
    is_more = bool(chdtrc(degrees, degrees * shown / believed_mm**2) < FALSE_DOUBT)
    return Film(float(np.sqrt(variance)), SCATTER_DEGREES + degrees, is_more)
