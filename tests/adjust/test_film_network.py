"""Networks on films of every kind: perfect data, marks that are too few, films that fold over."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import (
    Truth,
    field_points,
    film_parameters,
    simulated,
)

from adjust.errors import AdjustmentError
from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, Transformation
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

BENT = ["projective", "bilinear", "conformal(2)", "conformal(3)", "polynomial(2)", "polynomial(3)"]
SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


@pytest.mark.parametrize("kind", BENT)
def test_perfect_data_leave_nothing_and_give_the_truth_back(kind: Transformation) -> None:
    """Comparator coordinates from 5 to 235 mm, one scan mirrored; three marks more make eight."""
    network, _ = simulated(
        np.random.default_rng(4), SCANS, kind, field_points(np.random.default_rng(5), 25), noise=False
    )
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert np.abs(result.residuals.v_mm).max() < 1e-9
    for i in range(4):
        expected = film_parameters(SCANS, i, kind)
        names = [name for name in result.names if name.startswith(f"T.f{i}.")]
        off = [abs(result.value(name) - value) for name, value in zip(names, expected, strict=True)]
        assert np.all(off <= np.array([1e-5 * result.sigma(name) / result.sigma0 for name in names]))
    assert result.mirrored == {"f1"}


@pytest.mark.parametrize("kind", [pytest.param("polynomial(3)", marks=pytest.mark.study), "polynomial(5)"])
def test_the_origin_of_the_comparator_does_not_matter(kind: Transformation) -> None:
    """A metre and a half off, as on a film strip; with exact observations, which are moved without a rounding."""
    network, _ = simulated(
        np.random.default_rng(4), Truth(), "polynomial(3)", field_points(np.random.default_rng(5), 40), noise=False
    )
    network = replace(network, images=tuple(replace(image, transformation=kind) for image in network.images))
    results = [adjust(each, approximate(each)) for each in (network, moved_origin(network, 1500.0))]
    for result in results:
        assert result.converged
        assert np.abs(result.residuals.v_mm).max() < 1e-10
    for name in ("IO.K.c", "IO.K.x0", "FID.K.3.y", "EO.f2.omega"):
        near, far = (result.sigma(name) / result.sigma0 for result in results)
        assert far == pytest.approx(near, rel=1e-9)


def moved_origin(network: Network, off_mm: float) -> Network:
    observations = network.observations
    return replace(network, observations=replace(observations, xy_mm=observations.xy_mm + off_mm))


@pytest.mark.parametrize(("kind", "marks"), [("projective", 3), ("bilinear", 3), ("conformal(3)", 2)])
def test_targets_determine_what_too_few_marks_leave_open(kind: Transformation, marks: int) -> None:
    network, _ = simulated(
        np.random.default_rng(4), Truth(), kind, field_points(np.random.default_rng(5), 25), noise=False
    )
    network = add_marks(network, marks)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert result.warnings == (
        f"Image f0 shows {marks} fiducial marks, and its {kind} transformation takes 4 of its own: the targets "
        f"determine the rest of it. 3 more images are alike.",
    )


def add_marks(network: Network, count: int, images_of_marks_alone: tuple[str, ...] = ()) -> Network:
    """The network with the first marks only, and some images without targets."""
    rows = network.observations
    keep = [
        i
        for i, (image, point, what) in enumerate(zip(rows.image, rows.point, rows.kind, strict=True))
        if (int(point) <= count if what == "fiducial" else image not in images_of_marks_alone)
    ]
    return replace(network, observations=rows.only(np.array(keep)))


def test_an_image_without_targets_needs_all_marks_of_its_own() -> None:
    network, _ = simulated(np.random.default_rng(4), Truth(), "projective", noise=False)
    with pytest.raises(AdjustmentError, match=r"image f2 shows 3 fiducial marks; its projective .* needs 4\. Measure"):
        approximate(add_marks(network, 3, ("f2",)))
    result = adjust(enough := add_marks(network, 4, ("f2",)), approximate(enough))
    assert result.converged


def test_a_film_that_folds_over_is_reported() -> None:
    network, start = simulated(np.random.default_rng(4), Truth(), "polynomial(2)", noise=False)
    folded = start.transformation["f1"].copy()
    folded[3] = 0.02  # x' turns back at some 15 mm from the middle
    with pytest.raises(
        AdjustmentError, match=r"cannot start: .* polynomial\(2\) transformation of image f1 folds over"
    ):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": folded}))
