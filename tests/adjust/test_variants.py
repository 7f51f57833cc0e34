"""Networks of many kinds against a dense second implementation with complex steps (`dense_adjustment`)."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from dense_adjustment import solve_densely
from simulated import Truth, field_points, join_observations, simulated
from studies import parametrize_with_studies

from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Exterior, Image, Network, ObjectPoint, Transformation
from adjust.solution.adjustment import adjust

Case = tuple[Network, Approximations]

STEEP = ((0.02, -1.55, 0.1), (-0.03, 1.53, 3.1), (-1.6, 0.05, 3.139), (0.02, -0.03, -3.141))


def all_free_of_torlegard() -> Case:
    """Every parameter of the family, the decentering terms as printed, r0, and three kinds of scans."""
    truth = Truth(decentering="paper", mirrored=(True, False, True, False))
    free = {"k3": np.inf, "k5": 1e-11, "k7": 1e-15, "p1": np.inf, "p2": 1e-5, "p3": 1e-5, "p4": 1e-9}
    truth = replace(truth, distortion={**truth.distortion, "k7": 1e-17, "p3": 1e-6, "p4": -1e-10})
    return simulated(np.random.default_rng(1), truth, "affine", point_sigma=0.02, free=free)


def mirrored_similarity() -> Case:
    truth = Truth(mirrored=(True, True, False, True))
    return simulated(np.random.default_rng(2), truth, "similarity", free={"k3": np.inf})


def mirrored_congruent() -> Case:
    truth = Truth(mirrored=(False, True, True, False))
    return simulated(np.random.default_rng(3), truth, "congruent", free={"p1": np.inf, "p2": np.inf})


def steep_angles() -> Case:
    """A level camera that looks along +-X (phi near +-90), one upside down (omega beyond 90), kappa past 180."""
    stations = ((-1500.0, 20.0, 30.0), (1500.0, -30.0, 10.0), (40.0, 1500.0, 60.0), (10.0, -20.0, 1500.0))
    truth = Truth(stations=stations, attitudes=STEEP)
    return simulated(
        np.random.default_rng(4), truth, "affine", points=field_points(np.random.default_rng(4), 12, 700.0)
    )


def observed_orientations() -> Case:
    """Every element observed, one image's angles fixed, one with a free element; unknown points."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    rng = np.random.default_rng(50)
    images = []
    for i, image in enumerate(network.images):
        values = start.exterior[image.name].copy()
        sigmas = np.array([2.0, 2.0, 2.0, 0.01, 0.01, 0.01])
        if i == 1:
            sigmas[3:] = 0.0
            values[3:] = Truth().attitudes[1]
        if i == 2:
            sigmas[[2, 5]] = np.inf
        values[:3] = Truth().stations[i] + rng.normal(0, 2.0, 3)
        values[5] += 2 * np.pi * (i == 3)  # a whole turn more is the same angle
        images.append(replace(image, exterior=Exterior(values, sigmas)))
    return replace(network, images=tuple(images)), start


def heights_and_mixtures() -> Case:
    """Points known, known in height, known in plan, roughly known, unknown."""
    network, start = simulated(np.random.default_rng(6), free={"k3": np.inf})
    rng = np.random.default_rng(60)
    kinds = [(0, 0, 0), (None, None, 0.01), (0.01, 0.01, None), (0.05, 0.02, 0.1), (None,) * 3]
    points = []
    for i, point in enumerate(network.points):
        sigmas = kinds[i % 5] if i > 2 else (0, 0, 0)
        given = [
            None if sigma is None else Prior(value + rng.normal(0, sigma or 1e-12), float(sigma))
            for sigma, value in zip(sigmas, start.points[point.id], strict=True)
        ]
        points.append(ObjectPoint(point.id, *given))
    return replace(network, points=tuple(points)), start


def two_cameras() -> Case:
    """A film camera and a digital one with Brown's lens, that share the points; correlated observations."""
    film, start = simulated(np.random.default_rng(7), free={"k3": np.inf, "p1": np.inf})
    truth = Truth(
        c=80.0,
        x0=0.1,
        y0=0.2,
        distortion={"k3": 3e-7},
        stations=Truth().stations[::-1],
        attitudes=Truth().attitudes[::-1],
    )
    xyz = np.array([start.points[point.id] for point in film.points])
    other, begin = simulated(np.random.default_rng(70), truth, "none", points=xyz)
    lens = Distortion("brown", {"k1": Prior(3e-7, np.inf), "b1": Prior(0.0, 1e-3), "b2": Prior(0.0, np.inf)})
    camera = Camera("D", Prior(80.5, np.inf), Prior(0.0, 1.0), Prior(0.0, 1.0), lens)
    names = {image.name: f"d{image.name}" for image in other.images}
    rows, turned = other.observations, np.array([[1.0, 0.6], [0.6, 1.5]]) * 0.004**2
    renamed = tuple(names[name] for name in rows.image)
    rows = replace(rows, image=renamed, covariance_mm2=np.tile(turned, (len(rows), 1, 1)))
    observations = join_observations(film.observations, rows)
    images = (*film.images, *(Image(name, "D", "none") for name in names.values()))
    both = Network((*film.cameras, camera), images, film.points, observations)
    return both, Approximations(
        interior={**start.interior, "D": np.array([80.5, 0.0, 0.0])},
        exterior={**start.exterior, **{names[name]: values for name, values in begin.exterior.items()}},
        transformation={**start.transformation, **{name: np.empty(0) for name in names.values()}},
        points=start.points,
    )


def fiducials_fixed_free_and_given() -> Case:
    """Two marks fixed, one free, the others with priors of their own; a mark that one image shows alone."""
    network, start = simulated(np.random.default_rng(8), free={"k3": np.inf}, fiducial_sigma=0.002)
    (camera,) = network.cameras
    marks = dict(camera.fiducials)
    for id_, sigma in {"1": 0.0, "2": 0.0, "3": np.inf, "5": 0.01}.items():
        marks[id_] = replace(
            marks[id_], x_mm=Prior(marks[id_].x_mm.value, sigma), y_mm=Prior(marks[id_].y_mm.value, 2 * sigma)
        )
    return replace(network, cameras=(replace(camera, fiducials=marks),)), start


def bent_films(kind: Transformation) -> Case:
    """Scans far from the comparator's origin, one mirrored."""
    truth = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))
    points = field_points(np.random.default_rng(7), 12)
    return simulated(np.random.default_rng(6), truth, kind, points, free={"k3": np.inf})


CASES = (
    all_free_of_torlegard,
    mirrored_similarity,
    mirrored_congruent,
    steep_angles,
    observed_orientations,
    heights_and_mixtures,
    two_cameras,
    fiducials_fixed_free_and_given,
    *(partial(bent_films, kind) for kind in ("projective", "conformal(2)")),
    *(
        pytest.param(partial(bent_films, kind), marks=pytest.mark.study)
        for kind in ("bilinear", "conformal(3)", "polynomial(2)", "polynomial(3)")
    ),
)


@parametrize_with_studies("case", CASES, quick=(2, 3, 5, 7))
def test_variant(case: Callable[[], Case]) -> None:
    network, start = case()
    result = adjust(network, start)
    assert result.converged
    dense = solve_densely(network, dict(zip(result.names, result.values.tolist(), strict=True)), result.mirrored)
    assert result.redundancy == dense.redundancy
    assert result.vpv == pytest.approx(dense.vpv, rel=1e-8)
    cofactor = result.cofactor_of(list(dense.sigmas)).diagonal()
    for (name, sigma), variance in zip(dense.sigmas.items(), cofactor, strict=True):
        assert abs(result.value(name) - dense.values[name]) < 1e-6 * sigma, name
        assert np.sqrt(variance) == pytest.approx(sigma, rel=1e-6), name


def test_steep_angles_are_the_true_ones() -> None:
    """Whatever the triple, it is the true rotation to the noise."""
    network, start = steep_angles()
    result = adjust(network, start)
    for i, image in enumerate(network.images):
        found = rotation_from_angles(
            np.array([result.value(f"EO.{image.name}.{each}") for each in ("omega", "phi", "kappa")])
        )
        assert np.abs(found - rotation_from_angles(np.array(STEEP[i]))).max() < 2e-3
