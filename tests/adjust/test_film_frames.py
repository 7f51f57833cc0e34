"""Distances between fiducial marks, and frames scanned in two overlapping halves."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from networks import (
    FILM_CAMERA,
    FRAME_NOISE_MM,
    JOIN_SIGMA,
    NOMINAL_MM,
    UNKNOWN,
    DrawnFrames,
    Halves,
    add_errors,
    draw_frames,
    give_values,
    halves,
    keep_rows,
    observation_row,
    set_camera,
    set_sigma,
)
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from adjust import Adjustment, AdjustmentError, Network, Options, Parameter, Prior, adjust
from adjust.problem.camera import Fiducial, FiducialDistance
from adjust.solution.planning import plan

Array = NDArray[np.float64]
SIGMA_MM = 0.004


def observe_distances(
    drawn: DrawnFrames, rng: np.random.Generator, noise: float = 1.0, sigma_mm: float = np.inf
) -> DrawnFrames:
    """Frames whose marks are given with a standard deviation, and all distances between them."""
    pairs = combinations(range(len(drawn.places_mm)), 2)
    distances = tuple(
        FiducialDistance(
            str(i + 1),
            str(j + 1),
            float(np.linalg.norm(drawn.places_mm[j] - drawn.places_mm[i]) + noise * SIGMA_MM * rng.standard_normal()),
            SIGMA_MM,
        )
        for i, j in pairs
    )
    network = give_values(drawn.network, {"x": sigma_mm, "y": sigma_mm})
    return replace(drawn, network=set_camera(network, distances=distances))


def hold_marks(marks: int) -> list[int]:
    """Which of all coordinates the distances leave open, as a frame of four corners or eight marks has them: both of
    the first of the two marks farthest apart, and the one across of the other."""
    first, last = max(
        combinations(range(marks), 2), key=lambda pair: np.linalg.norm(np.diff(NOMINAL_MM[list(pair)], axis=0))
    )
    along = np.abs(NOMINAL_MM[last] - NOMINAL_MM[first])
    return [2 * first, 2 * first + 1, 2 * last + (1 if along[0] >= along[1] else 0)]


def written_out(drawn: DrawnFrames, similar: bool) -> tuple[Array, Array, float]:
    """Places (m, 2), their standard deviations and v'Pv: each comparator coordinate is a similarity or an affinity of
    the place, each distance that of two places."""
    network, marks = drawn.network, len(drawn.places_mm)
    observed = network.observations.xy_mm.reshape(-1, marks, 2)
    distances = network.cameras[0].distances
    pairs = np.array([(int(each.start) - 1, int(each.end) - 1) for each in distances])
    free = np.setdiff1d(np.arange(2 * marks), hold_marks(marks))
    of_film = 4 if similar else 6

    def split_places(x: Array) -> Array:
        places = NOMINAL_MM[:marks].ravel().copy()
        places[free] = x[: len(free)]
        return places.reshape(-1, 2)

    def weighted(x: Array) -> Array:
        places, rows = split_places(x), []
        for own, p in zip(observed, x[len(free) :].reshape(len(observed), of_film), strict=True):
            matrix = np.array([[p[2], -p[3]], [p[3], p[2]]]) if similar else p[2:].reshape(2, 2)
            rows.append(((places @ matrix.T + p[:2]) - own).ravel() / FRAME_NOISE_MM)
        lengths = np.linalg.norm(places[pairs[:, 1]] - places[pairs[:, 0]], axis=1)
        rows.append((lengths - [each.value_mm for each in distances]) / SIGMA_MM)
        return np.concatenate(rows)

    film = [0.0, 0.0, 1.0, 0.0] if similar else [0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    x = np.concatenate([NOMINAL_MM[:marks].ravel()[free], *[film] * len(observed)])
    for _ in range(6):
        jacobian = approx_fprime(x, weighted, 1e-6)
        x = x - np.linalg.lstsq(jacobian, weighted(x))[0]
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    sigmas = np.zeros(2 * marks)
    sigmas[free] = np.sqrt(np.diag(covariance))[: len(free)]
    return split_places(x), sigmas.reshape(-1, 2), float(weighted(x) @ weighted(x))


def places(result: Adjustment, marks: int) -> tuple[Array, Array]:
    names = [[f"FID.{FILM_CAMERA}.{i + 1}.{axis}" for axis in "xy"] for i in range(marks)]
    values = np.array([[result.value(name) for name in pair] for pair in names])
    sigmas = np.array([[result.sigma(name) for name in pair] for pair in names])
    return values, sigmas


@pytest.mark.parametrize(("marks", "kind"), [(4, "affine"), (8, "affine"), (4, "similarity"), (8, "similarity")])
def test_places_by_distances_are_those_of_the_adjustment_written_out(marks: int, kind: str) -> None:
    rng = np.random.default_rng(marks)
    drawn = observe_distances(draw_frames(kind, 3, marks, 1.0, 0.05, rng), rng)
    result = adjust(drawn.network, drawn.start)
    assert result.converged
    expected, sigmas, vpv = written_out(drawn, kind == "similarity")
    values, claimed = places(result, marks)
    np.testing.assert_allclose(values, expected, atol=2e-7)
    np.testing.assert_allclose(claimed, result.sigma0 * sigmas, rtol=1e-4, atol=1e-9)
    unknowns = 2 * marks - 3 + 3 * (4 if kind == "similarity" else 6)
    redundancy = 3 * 2 * marks + marks * (marks - 1) // 2 - unknowns
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(redundancy, abs=1e-6)
    assert result.sigma0**2 * redundancy == pytest.approx(vpv, rel=1e-5)
    assert result.groups["fiducial distance"].redundancy == pytest.approx(
        sum(row.redundancy for row in result.further if row.group == "fiducial distance")
    )


def test_a_plan_expects_the_form_of_the_distances_and_the_datum_of_the_coordinates() -> None:
    rng = np.random.default_rng(10)
    drawn = observe_distances(draw_frames("affine", 3, 4, 1.0, 0.0, rng, 0.0), rng, 0.0, sigma_mm=1.0)
    planned, result = plan(drawn.network, drawn.start), adjust(drawn.network, drawn.start)
    parameters = [Parameter.fiducial(FILM_CAMERA, str(i + 1), axis) for i in range(4) for axis in "xy"]
    form = np.array([[1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])  # x of the first less that of the second
    assert planned.sigmas(parameters, form)[0] == pytest.approx(SIGMA_MM * np.sqrt(3.0 / 4.0), rel=0.35)
    datum = np.sqrt(3.0 / 8.0)  # mm: two shifts and a turn of eight coordinates known to 1 mm
    np.testing.assert_allclose([planned.sigma(each) for each in parameters], datum, rtol=1e-3)
    redundancy = {row.name: row.redundancy for row in planned.adjustment.further}
    np.testing.assert_allclose(list(redundancy.values()), [row.redundancy for row in result.further], atol=1e-4)


def test_a_distance_to_a_mark_that_no_image_shows_says_nothing() -> None:
    rng = np.random.default_rng(8)
    drawn = observe_distances(draw_frames("affine", 2, 4, 1.0, 0.05, rng), rng)
    camera = drawn.network.cameras[0]
    unseen = {**camera.fiducials, "5": Fiducial(Prior(0.0, np.inf), Prior(112.0, np.inf))}
    distances = (*camera.distances, FiducialDistance("1", "5", 100.0, SIGMA_MM))
    farther = set_camera(drawn.network, fiducials=unseen, distances=distances)
    alone, result = (adjust(network, drawn.start) for network in (drawn.network, farther))
    np.testing.assert_allclose(places(result, 4)[0], places(alone, 4)[0], atol=1e-9)
    assert len(result.further) == len(alone.further)


def errors(halves: Halves, adjustment: Adjustment) -> dict[str, np.ndarray]:
    """Errors over standard deviations of the joins, the films at their fiducials, and the orientations."""
    found: dict[str, list[float]] = {"joins": [], "orientations": []}
    for (frame, point), xy in halves.joins.items():
        for axis, true in zip("xy", xy, strict=True):
            name = f"JOIN.{frame}.{point}.{axis}"
            found["joins"].append((adjustment.value(name) - true) / adjustment.sigma(name))
    if adjustment.network.observed_points:
        for i in range(4):
            true = [*halves.truth.stations[i], *halves.truth.attitudes[i]]
            for element, value in zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), true, strict=True):
                name = f"EO.f{i}.{element}"
                found["orientations"].append((adjustment.value(name) - value) / adjustment.sigma(name))
    return {name: np.array(each) for name, each in found.items() if each}


def drop_targets(network: Network) -> Network:
    return keep_rows(network, lambda image, point, kind: kind != "target")


def test_frames_without_any_target_are_joined_too() -> None:
    simulated = halves(np.random.default_rng(4))
    adjustment = adjust(replace(drop_targets(simulated.network), points=()))
    assert adjustment.converged
    assert adjustment.groups["join"].redundancy > 50.0
    assert 0.8 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.2


def test_points_as_blocks_give_what_frames_as_blocks_give() -> None:
    """With many unknown points these are eliminated first, and the frames' unknowns are what they share."""
    simulated = halves(np.random.default_rng(5), join_count=5, targets=120)
    points = tuple(point if int(point.id) < 6 else set_sigma(point, UNKNOWN) for point in simulated.network.points)
    adjustment = adjust(replace(simulated.network, points=points))
    assert 0.9 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.25
    assert 0.9 < adjustment.sigma0 < 1.1


def test_a_gross_error_of_a_join_is_found_and_named() -> None:
    network = halves(np.random.default_rng(7)).network
    error = {observation_row(network, "join", "f1.right", "j4"): np.full(2, 20.0 * JOIN_SIGMA)}
    (found,) = adjust(add_errors(network, error), options=Options(snooping=True)).suspects
    assert found.tested.name in ("join j4 in image f1.right", "join j4 in image f1.left")


def test_scans_that_cannot_be_joined_are_refused() -> None:
    network = halves(np.random.default_rng(10)).network
    with pytest.raises(AdjustmentError, match=r"frame f0: its scan f0.right has 0 points in common with f0.left"):
        adjust(keep_rows(network, lambda _, point, kind: kind == "fiducial" and point != "5"))  # which both halves show
    with pytest.raises(AdjustmentError, match=r"join j3 is observed in one scan of frame f0 only"):
        adjust(keep_rows(network, lambda image, point, _: (image, point) != ("f0.left", "j3")))
    images = (replace(network.images[0], transformation="projective"), *network.images[1:])
    with pytest.raises(AdjustmentError, match=r"frame f0: its scans f0.left and f0.right differ"):
        adjust(replace(network, images=images))


def test_a_film_that_nothing_determines_is_named_with_its_frame() -> None:
    """All joins on one line, no mark in the right half: it can stretch across the line."""
    simulated = halves(np.random.default_rng(13), join_count=8, overlap_mm=1e-12, join_sigma=1e-12)
    network = replace(drop_targets(simulated.network), points=())
    adjustment = adjust(keep_rows(network, lambda image, _, kind: (image, kind) != ("f0.right", "fiducial")))
    assert not adjustment.converged
    assert any("f0" in each.cause and "scans" in each.cause for each in adjustment.singular), adjustment.singular
