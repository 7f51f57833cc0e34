"""Claimed against realised standard deviations of frames that show fiducials alone, for every film transformation.

python -m benchmarks fiducials_alone [TRIALS [SEED]]

In every trial the true places of the marks, the films and the noise are drawn anew; the given coordinates stay. Dense
normal equations of all trials at once stand for the adjustment; some trials of every row go through `adjust` and the
report's corrections and distances, and the largest difference in standard deviations stands behind the row. A figure is
the rms error over the rms claim of all quantities of a kind, in brackets how far that is from 1 in standard deviations
(from the scatter between trials). Of sigma0 it is the root of the mean square; 1 is right.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from film_realisations import CAMERA, NOISE_MM, NOMINAL_MM, drawn_film, network_of
from numpy.typing import NDArray
from scipy.special import fdtr
from scipy.stats import norm

from adjust.functional_model.film_kinds import FilmKind
from adjust.functional_model.transformation import film_kind
from adjust.problem.images import adjusted_image
from adjust.problem.network import Approximations, Transformation
from adjust.quality.variance_factor import LEAST_REDUNDANCY, NO_EVIDENCE, TOO_GOOD
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from pipeline.report.fiducials import figure_of_films
from pipeline.results.adjustment_record import FiducialRecord, GivenQuantity, Quantity
from pipeline.results.covariance_file import Covariance

Array = NDArray[np.float64]
Figures = dict[str, tuple[Array, Array]]  # by kind of quantity: errors and claims (trials, quantities)

KINDS: tuple[tuple[Transformation, int], ...] = (
    ("congruent", 4),
    ("similarity", 4),
    ("affine", 4),
    ("affine", 8),
    ("bilinear", 8),
    ("projective", 8),
    ("conformal(2)", 8),
    ("conformal(3)", 8),
    ("polynomial(2)", 8),
)
FRAMES = (1, 2, 5, 20)
GIVEN = {"drawn from 1 mm": (1.0, 1.0), "1 mm, right to 10 µm": (1.0, 0.01), "certificate, 5 µm": (0.005, 0.005)}
FREE_OF_DATUM = ("corrections", "distances", "sigma0", "sigma0 of fiducials")  # right whatever is given
LEVEL = 0.01  # probability that any figure of the whole table is called wrong by chance
HALF_MM = 100.0
STEPS = 6
THROUGH_ADJUST = 2  # trials of every row


def main() -> None:
    """Print a row for every film, number of frames and precision of the given coordinates."""
    trials, seed = [*map(int, sys.argv[1:]), *(400, 1)[len(sys.argv) - 1 :]]
    figures = []
    cells = product(GIVEN.items(), FRAMES, KINDS)
    for number, ((words, (stated, true)), count, (kind, marks)) in enumerate(cells):
        batch = Batch.drawn(kind, marks, count, stated, true, trials, np.random.default_rng([seed, number]))
        found = {name: compared(*each) for name, each in batch.figures().items()}
        if true < stated:
            found = {name: figure for name, figure in found.items() if name in FREE_OF_DATUM}
        where = f"{words}, {kind}, {marks} marks, {count} frames"
        figures += [(off, f"{where}: {name}") for name, (_, off) in found.items()]
        row = "  ".join(f"{name} {ratio:.3f} ({off:+.1f})" for name, (ratio, off) in found.items())
        print(f"{where}: {row}  [adjust: {largest_difference(batch):.1g}]", flush=True)
    offs = np.array([off for off, _ in figures])
    limit = norm.isf(LEVEL / 2 / len(figures))
    beyond = [each for each in figures if abs(each[0]) > limit]
    print(
        f"{len(figures)} figures, mean square of how far off {np.mean(offs**2):.3f}, largest {np.abs(offs).max():.2f}"
    )
    print(f"limit at {100 - 100 * LEVEL:g} % for all together {limit:.2f}, beyond it {len(beyond)}: {beyond}")


def compared(errors: Array, claims: Array) -> tuple[float, float]:
    """rms over rms, and how far it is from 1; what is never uncertain has no part."""
    scale = (claims**2).mean(axis=0)
    kept = scale > 0.0
    realised, claimed = (each[:, kept] ** 2 / scale[kept] for each in (errors, claims))
    apart = (realised - claimed).mean(axis=1)
    return float(np.sqrt(realised.mean())), float(apart.mean() / (apart.std(ddof=1) / np.sqrt(len(apart))))


@dataclass(frozen=True)
class Batch:
    """t trials of n frames of m marks.

    true (t, m, 2): places of the marks; films (t, n, k): parameters; xy (t, n, m, 2): measured in the comparator,
    true_xy: without noise.
    """

    transformation: Transformation
    stated_mm: float
    given: Array
    true: Array
    films: Array
    true_xy: Array
    xy: Array

    @staticmethod
    def drawn(
        kind: Transformation,
        marks: int,
        count: int,
        stated: float,
        true_mm: float,
        trials: int,
        rng: np.random.Generator,
    ) -> "Batch":
        given = NOMINAL_MM[:marks]
        true = given + true_mm * rng.standard_normal((trials, marks, 2))
        films = np.array([[drawn_film(kind, rng).parameters for _ in range(count)] for _ in range(trials)])
        true_xy = inverse(film_kind(kind), films[:, :, None], true[:, None])
        xy = true_xy + NOISE_MM * rng.standard_normal(true_xy.shape)
        return Batch(kind, stated, given, true, films, true_xy, xy)

    @property
    def kind(self) -> FilmKind:
        return film_kind(self.transformation)

    def figures(self) -> Figures:
        """Errors and claims of all that is printed of an adjustment of fiducials alone."""
        solved = Solved.of(self)
        films = solved.films - self.films
        shifts = np.isin(self.kind.names, ("a1", "b1"))
        found = {
            "fiducials": (_flat(solved.places - self.true), _sigmas(solved.covariance)),
            "shifts": (_flat(films[..., shifts]), _flat(_sigmas(solved.film_covariance)[..., shifts])),
            "other film parameters": (_flat(films[..., ~shifts]), _flat(_sigmas(solved.film_covariance)[..., ~shifts])),
        }
        corrections, by_unknowns = corrected(self, solved.films[:, 0], solved.places)
        true, _ = corrected(self, self.films[:, 0], self.true)
        claims = _sigmas(by_unknowns @ solved.joint_covariance @ by_unknowns.swapaxes(1, 2))
        found["corrections"] = (_flat(corrections - true), claims)
        if self.transformation == "congruent":
            found["distances"] = self._distances(solved)
        if solved.is_checked.any():
            found["sigma0"] = _column(solved.sigma0[solved.is_checked])
        if (solved.group_redundancy >= LEAST_REDUNDANCY).all():
            found["sigma0 of fiducials"] = _column(solved.group_sigma0)
        return found

    def _distances(self, solved: "Solved") -> tuple[Array, Array]:
        errors, claims = [], []
        for i, j in zip(*np.triu_indices(len(self.given), 1), strict=True):
            vector, true = solved.places[:, j] - solved.places[:, i], self.true[:, j] - self.true[:, i]
            length = np.linalg.norm(vector, axis=1)
            by_places = np.zeros((*solved.places.shape,))
            by_places[:, j], by_places[:, i] = vector / length[:, None], -vector / length[:, None]
            row = _flat(by_places)
            errors.append(length - np.linalg.norm(true, axis=1))
            claims.append(np.sqrt(np.einsum("ti,tij,tj->t", row, solved.covariance, row)))
        return np.array(errors).T, np.array(claims).T


@dataclass(frozen=True)
class Solved:
    """Adjusted places (t, m, 2) with their covariances (t, 2m, 2m), films (t, n, k) with theirs (t, n, k, k).

    joint_covariance (t, 2m + k, 2m + k): of the places and the first film.
    """

    places: Array
    covariance: Array
    films: Array
    film_covariance: Array
    joint_covariance: Array
    sigma0: Array
    is_checked: NDArray[np.bool_]
    group_sigma0: Array
    group_redundancy: Array

    @staticmethod
    def of(batch: Batch) -> "Solved":
        """Gauss and Newton from the truth, and the rules of `adjust.quality.variance_factor` again."""
        kind, count = batch.kind, batch.films.shape[1]
        places, films = batch.true.copy(), batch.films.copy()
        center, half = np.zeros((*films.shape[:2], 2)), np.full(films.shape[:2], HALF_MM)
        size = 2 * places.shape[1]
        prior = np.eye(size) / batch.stated_mm**2
        for step in range(STEPS + 1):
            computed = inverse(kind, films[:, :, None], places[:, None])
            gradient = np.broadcast_to(kind.gradient(films[:, :, None], computed), (*computed.shape, 2))
            back = np.linalg.inv(gradient) / NOISE_MM
            right = ((computed - batch.xy) / NOISE_MM).reshape(*films.shape[:2], size)
            design = kind.design(films[:, :, None], computed, np.zeros(2), np.array(HALF_MM))
            by_film = (back @ design).reshape(*films.shape[:2], size, -1)
            by_place = np.zeros((*films.shape[:2], size, size))
            for mark in range(size // 2):
                at = slice(2 * mark, 2 * mark + 2)
                by_place[..., at, at] = -back[:, :, mark]
            own = np.linalg.inv(by_film.swapaxes(-1, -2) @ by_film)
            through = own @ by_film.swapaxes(-1, -2) @ by_place
            images = (by_place.swapaxes(-1, -2) @ (by_place - by_film @ through)).sum(axis=1)
            if step == STEPS:
                break
            given = _flat(batch.given - places)
            pull = (by_place - by_film @ through).swapaxes(-1, -2) @ right[..., None]
            moved = np.linalg.solve(images + prior, pull.sum(axis=1)[..., 0][..., None] + (prior @ given[..., None]))
            of_films = own @ by_film.swapaxes(-1, -2) @ right[..., None] - through @ moved[:, None]
            places = places + moved.reshape(places.shape)
            films = films + (kind.centred_jacobian(films, center, half) @ of_films)[..., 0]
        vpv = (right**2).sum(axis=(1, 2))
        datum = ((batch.given - places) ** 2).sum(axis=(1, 2)) / batch.stated_mm**2
        free = np.eye(size) - np.linalg.inv(images + prior) @ prior
        of_datum = np.einsum("tii->t", free)
        evidence = 1.0 - np.linalg.eigvalsh(free)[:, -1]
        whole = count * (size - films.shape[2])
        rest = whole - of_datum
        is_checked = rest >= LEAST_REDUNDANCY
        variance = np.where(is_checked, vpv / np.maximum(rest, 1e-9), 1.0)
        too_good = fdtr(of_datum, np.maximum(rest, 1e-9), datum / of_datum / np.minimum(variance, 1.0)) < TOO_GOOD
        left_out = is_checked & ((evidence < NO_EVIDENCE) | too_good)
        common = np.where(is_checked & ~left_out, (vpv + datum) / whole, variance)
        scaled = np.where(left_out, common, 1.0)[:, None, None] * prior
        covariance = common[:, None, None] * np.linalg.inv(images + scaled)
        of_films = common[:, None, None, None] * own + through @ covariance[:, None] @ through.swapaxes(-1, -2)
        by = kind.centred_jacobian(films, center, half)
        of_films = by @ of_films @ by.swapaxes(-1, -2)
        across = -by[:, 0] @ through[:, 0] @ covariance
        joint = np.block([[covariance, across.swapaxes(1, 2)], [across, of_films[:, 0]]])
        return Solved(
            places,
            covariance,
            films,
            of_films,
            joint,
            np.sqrt(common),
            is_checked,
            np.sqrt(vpv / np.maximum(rest, 1e-9)),
            rest,
        )


def corrected(batch: Batch, films: Array, places: Array) -> tuple[Array, Array]:
    """What the transformation of the first films' comparators to the given places leaves (t, m, 2), and derivatives."""
    kind, size = batch.kind, 2 * places.shape[1]
    source = inverse(kind, films[:, None], places)
    fitted = films.copy()
    center, half = np.zeros((len(films), 2)), np.full(len(films), HALF_MM)
    for _ in range(STEPS):
        left = _flat(batch.given - kind.apply(fitted[:, None], source))
        design = kind.design(fitted[:, None], source, np.zeros(2), np.array(HALF_MM))
        design = np.broadcast_to(design, (*source.shape, design.shape[-1])).reshape(len(films), size, -1)
        inverse_design = np.linalg.pinv(design)
        fitted = fitted + (kind.centred_jacobian(fitted, center, half) @ inverse_design @ left[..., None])[..., 0]
    projector = np.eye(size) - design @ inverse_design
    back = np.linalg.inv(np.broadcast_to(kind.gradient(films[:, None], source), (*source.shape, 2)))
    by_film = kind.design(films[:, None], source, np.zeros(2), np.array(HALF_MM))
    by_film = back @ by_film @ np.linalg.inv(kind.centred_jacobian(films, center, half))[:, None]
    turned = np.broadcast_to(kind.gradient(fitted[:, None], source), (*source.shape, 2))
    by_source = np.einsum("tinj,tnjk->tink", projector.reshape(len(films), size, size // 2, 2), turned)
    by_places = np.einsum("tinj,tnjk->tink", by_source, back).reshape(len(films), size, size)
    by_films = -np.einsum("tinj,tnjk->tik", by_source, by_film)
    return kind.apply(fitted[:, None], source) - batch.given, np.concatenate([by_places, by_films], axis=2)


def inverse(kind: FilmKind, films: Array, places: Array) -> Array:
    """Comparator coordinates (..., 2) of places (..., 2), films (..., k) broadcast along."""
    shape = np.broadcast_shapes(films.shape[:-1], places.shape[:-1])
    of_each = np.broadcast_to(films, (*shape, films.shape[-1])).reshape(-1, films.shape[-1])
    xy, regular = kind.inverse(
        of_each, np.broadcast_to(places, (*shape, 2)).reshape(-1, 2), np.zeros((len(of_each), 2))
    )
    assert regular.all()
    return np.asarray(xy.reshape(*shape, 2))


def largest_difference(batch: Batch) -> float:
    """Between the first trials here and through `adjust`, of values, standard deviations and corrections, in these."""
    solved = Solved.of(batch)
    corrections, by_unknowns = corrected(batch, solved.films[:, 0], solved.places)
    claims = _sigmas(by_unknowns @ solved.joint_covariance @ by_unknowns.swapaxes(1, 2))
    different = [0.0]
    for trial in range(THROUGH_ADJUST):
        network = network_of(batch.transformation, batch.given, batch.stated_mm, batch.xy[trial])
        films = {image.name: each for image, each in zip(network.images, batch.films[trial], strict=True)}
        result = adjust(network, Approximations({}, {}, films, {}))
        names = [f"FID.{CAMERA}.{id_}.{axis}" for id_ in network.cameras[0].fiducials for axis in "xy"]
        names += [f"T.{image.name}.{name}" for image in network.images for name in batch.kind.names]
        values = np.concatenate([solved.places[trial].ravel(), solved.films[trial].ravel()])
        sigmas = np.concatenate([_sigmas(solved.covariance)[trial], _sigmas(solved.film_covariance)[trial].ravel()])
        own = np.array([result.sigma(name) for name in names])
        different += [np.abs((result.values_of(names) - values) / sigmas).max(), np.abs(own / sigmas - 1.0).max()]
        printed = _printed(result, batch.given)
        if printed is not None:
            kept = claims[trial] > 1e-9
            different += [np.abs((printed[0] - corrections[trial].ravel())[kept] / claims[trial][kept]).max()]
            different += [np.abs(printed[1][kept] / claims[trial][kept] - 1.0).max()]
    return float(max(different))


def _printed(result: Adjustment, given: Array) -> tuple[Array, Array] | None:
    """Corrections and their standard deviations (2m,) in mm as the report prints them."""
    marks = dict(_marks(result, given))
    films = {image.name: adjusted_image(result, image.name).film for image in result.network.images}
    matrix = result.sigma0**2 * result.cofactor_of(result.parameters)
    form = figure_of_films(CAMERA, marks, Covariance(tuple(result.parameters), result.values, matrix), films)
    if form is None:
        return None
    return 1e-3 * form.change_um.ravel(), 1e-3 * np.sqrt(np.maximum(np.diag(form.covariance_um2), 0.0))


def _marks(result: Adjustment, given: Array) -> Iterator[tuple[str, FiducialRecord]]:
    for id_, place in zip(result.network.cameras[0].fiducials, given.tolist(), strict=True):
        values = [result.value(f"FID.{CAMERA}.{id_}.{axis}") for axis in "xy"]
        x, y = (Quantity(value, 0.0, GivenQuantity(own, 0.0)) for value, own in zip(values, place, strict=True))
        yield id_, FiducialRecord(x, y, 0.0)


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))


def _flat(values: Array) -> Array:
    return values.reshape(len(values), -1)


def _column(sigma0: Array) -> tuple[Array, Array]:
    return sigma0[:, None], np.ones((len(sigma0), 1))


if __name__ == "__main__":
    main()
