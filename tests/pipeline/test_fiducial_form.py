"""The form of fiducials that frames of fiducials alone determine: its standard deviations against many realisations."""

from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from studies import parametrize_with_studies

from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Image, Network
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from pipeline.report.fiducials import Figure, figure_of_films
from pipeline.results.adjustment_record import FiducialRecord, GivenQuantity, Quantity

Array = NDArray[np.float64]

GIVEN_MM = np.array(
    [(-106, 106), (106, 106), (106, -106), (-106, -106), (0, 112), (112, 0), (0, -112), (-112, 0)], dtype=np.float64
)
IDS = tuple("12345678")
SIGMA_MM, FRAMES, RUNS = 0.004, 10, 20
TRUE_MM = GIVEN_MM + np.random.default_rng(0).normal(0.0, 0.006, GIVEN_MM.shape)


class Known:
    """The covariance of an adjustment, as the report has it from its file."""

    def __init__(self, adjustment: Adjustment) -> None:
        self.adjustment = adjustment

    def select(self, names: Iterable[str]) -> Array:
        return self.adjustment.sigma0**2 * self.adjustment.cofactor_of(list(names))


def stored(result: Adjustment) -> dict[str, FiducialRecord]:
    """What adjustment.json has of the fiducials."""

    def quantity(id: str, axis: str, given: float) -> Quantity:
        return Quantity(result.value(f"FID.K.{id}.{axis}"), 0.0, GivenQuantity(given, 1.0))

    return {
        id: FiducialRecord(quantity(id, "x", x), quantity(id, "y", y), 0.0)
        for id, (x, y) in zip(IDS, GIVEN_MM.tolist(), strict=True)
    }


def form(kind: str, seed: int) -> Figure:
    """Frames that bear little of what such a film can, with noise."""
    rng = np.random.default_rng(seed)
    names = tuple(f"f{i}" for i in range(FRAMES))
    turn = rng.uniform(-0.5, 0.5, FRAMES)
    linear = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).transpose(2, 0, 1)
    if kind != "similarity":
        linear = linear + rng.normal(0.0, 1e-3, linear.shape)
    xy_mm = TRUE_MM @ linear.transpose(0, 2, 1) + rng.normal(0.0, 5.0, (FRAMES, 1, 2))
    if kind == "projective":
        xy_mm /= 1.0 + np.einsum("nki,ni->nk", xy_mm, rng.normal(0.0, 1e-5, (FRAMES, 2)))[..., None]
    xy_mm = xy_mm + rng.normal(0.0, SIGMA_MM, xy_mm.shape)
    marks = {id: Fiducial(Prior(x, 1.0), Prior(y, 1.0)) for id, (x, y) in zip(IDS, GIVEN_MM.tolist(), strict=True)}
    count = FRAMES * len(IDS)
    kinds: tuple[ObservationKind, ...] = tuple("fiducial" for _ in range(count))
    network = Network(
        (Camera("K", None, None, None, fiducials=marks),),
        tuple(Image(name, "K", kind) for name in names),
        (),
        Observations(
            tuple(np.repeat(names, len(IDS)).tolist()),
            IDS * FRAMES,
            kinds,
            xy_mm.reshape(-1, 2),
            np.tile(SIGMA_MM**2 * np.eye(2), (count, 1, 1)),
        ),
    )
    result = adjust(network, approximate(network))
    films = {name: adjusted_image(result, name).film for name in names}
    found = figure_of_films("K", stored(result), Known(result), films)  # type: ignore[arg-type]
    assert found is not None
    return found


@pytest.mark.study
@parametrize_with_studies(("kind", "taken_up"), [("similarity", 4), ("affine", 6), ("projective", 8)], quick=(1,))
def test_the_sigmas_of_the_form_hold_against_realisations(kind: str, taken_up: int) -> None:
    found = [form(kind, seed) for seed in range(RUNS)]
    changes = np.array([each.change_um.ravel() for each in found])
    claimed = np.mean([each.covariance_um2 for each in found], axis=0)
    assert np.linalg.matrix_rank(claimed, tol=1e-3 * np.trace(claimed)) == 2 * len(IDS) - taken_up
    # What is left of the truth's own form when all that films take up is gone, and the noise about it.
    off = changes - changes.mean(axis=0)
    free = RUNS - 1
    ratio = (off**2).sum(axis=0) / np.diag(claimed)
    assert ratio.min() > chi2.ppf(1e-4 / len(ratio), free)
    assert ratio.max() < chi2.ppf(1 - 1e-4 / len(ratio), free)
    together = (off**2).sum() / np.trace(claimed) / free
    assert together == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / free / (2 * len(IDS) - taken_up)))
    assert np.sqrt(np.diag(claimed)).max() < 1.1e3 * SIGMA_MM / np.sqrt(FRAMES)
    assert not found[0].distances  # no such film keeps any


def test_the_form_is_that_of_the_truth() -> None:
    """Against the truth less its own best affine transformation, by least squares."""
    found = form("affine", 99)
    design = np.column_stack([np.ones(len(IDS)), GIVEN_MM])
    offset = TRUE_MM - GIVEN_MM
    left_um = 1e3 * (offset - design @ np.linalg.lstsq(design, offset)[0])
    sigma_um = np.sqrt(np.diag(found.covariance_um2)).reshape(-1, 2)
    assert np.abs((found.change_um - left_um) / sigma_um).max() < 4.0
    assert np.abs(left_um).max() > 5.0
