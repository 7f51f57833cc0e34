"""Film transformations from marks, against the transformations that were applied."""

import numpy as np
import pytest
from numpy.typing import NDArray

from adjust.fiducial_fit import fit_transformation
from adjust.network import Transformation
from adjust.transformation import NAMES, affine_from_parameters, apply_affine

Array = NDArray[np.float64]

MARKS_MM = 106.0 * np.array([(1, -1), (-1, -1), (-1, 1), (1, 1), (0, -1), (-1, 0), (0, 1), (1, 0)])
APPLIED: dict[Transformation, Array] = {
    "congruent": np.array([3.0, -2.0, 2.1]),
    "similarity": np.array([3.0, -2.0, -0.6, 0.81]),
    "affine": np.array([3.0, 0.02, -1.001, -2.0, 0.999, 0.015]),
}


@pytest.mark.parametrize("kind", ["congruent", "similarity", "affine"])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("wrong", [(), (2,), (1, 6)], ids=["clean", "one gross error", "two exchanged"])
def test_the_applied_transformation_is_found(kind: Transformation, mirrored: bool, wrong: tuple[int, ...]) -> None:
    parameters = APPLIED[kind].copy()
    if kind == "affine" and mirrored:
        parameters[[1, 4]] *= -1.0
    rng = np.random.default_rng(1)
    comparator = MARKS_MM[:, ::-1] + rng.uniform(-1.0, 1.0, MARKS_MM.shape)
    camera = apply_affine(affine_from_parameters(kind, parameters, mirrored), comparator)
    if wrong:
        camera[list(wrong)] = camera[list(reversed(wrong))] if len(wrong) > 1 else camera[list(wrong)] + 20.0
    found, is_mirrored = fit_transformation(kind, comparator, camera)
    expected = np.linalg.det(affine_from_parameters(kind, parameters, mirrored)[[[1, 2], [4, 5]]]) < 0
    np.testing.assert_allclose(found, parameters, atol=1e-9)
    assert is_mirrored == expected


def test_small_residuals_are_no_gross_errors() -> None:
    rng = np.random.default_rng(2)
    comparator = MARKS_MM + rng.normal(0.0, 0.005, MARKS_MM.shape)
    found, _ = fit_transformation("affine", comparator, MARKS_MM)
    design = np.column_stack([np.ones(8), comparator])
    least_squares = np.linalg.lstsq(design, MARKS_MM)[0]
    np.testing.assert_allclose(found, [*least_squares[:, 0], *least_squares[:, 1]], atol=1e-9)


def test_none_has_no_parameters() -> None:
    found, mirrored = fit_transformation("none", np.zeros((0, 2)), np.zeros((0, 2)))
    assert found.shape == (len(NAMES["none"]),)
    assert not mirrored
