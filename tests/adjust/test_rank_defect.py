"""Singular networks: their null directions, each named with cause and remedy."""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from faults import AXES, CATALOGUE, DEFORMATIONS, DISTANCE, MISHAPS, POINT, sentences
from networks import CONVERGENT, UNKNOWN, Setup, Truth, field_points, give_values, simulated, vertical
from numpy.typing import NDArray
from reference_cases import CAUSES, DROPPED, Case, case_approximations, case_network, load

from adjust import Adjustment, AdjustmentError
from adjust.linear_algebra.factor import BlockFactors, DenseBlocks, Factor
from adjust.linear_algebra.sparse_factor import Fronts, Triangle
from adjust.problem.network import Network, Transformation
from adjust.problem.problem import number
from adjust.rank_defect import diagnosis
from adjust.rank_defect.datum import object_datum
from adjust.solution.adjustment import Datum, Options, adjust

Array = NDArray[np.float64]

GIVEN: dict[str, list[tuple[str, Callable[[Network], Network]]]] = {
    "Shift x": [
        ("x' of one fiducial mark (F5)", lambda network: give_values(network, {"x": 1.0}, 1)),
        ("x0' (F7)", lambda network: give_values(network, {"x0": 1.0})),
    ],
    "Shift y": [
        ("y' of one fiducial mark (F6)", lambda network: give_values(network, {"y": 1.0}, 1)),
        ("y0' (F8)", lambda network: give_values(network, {"y0": 1.0})),
    ],
    "Rotation": [("one coordinate of a fiducial mark", lambda network: give_values(network, {"y": 1.0}, 1))],
    "Scale": [("the principal distance (F9)", lambda network: give_values(network, {"c": 1.0}))],
    "principal point's x0'": [("x0' (F7)", lambda network: give_values(network, {"x0": 1.0}))],
    "principal point's y0'": [("y0' (F8)", lambda network: give_values(network, {"y0": 1.0}))],
    "principal distance of camera K can change": [("it (F9)", lambda network: give_values(network, {"c": 1.0}))],
}

DEAR = ("nearly-flat", "swapped")


@cache
def failed(name: str) -> Adjustment:
    """A network of the catalogue as it is adjusted."""
    return adjust(*CATALOGUE[name].setup.network(), CATALOGUE[name].options)


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_number_words_and_changes_of_the_network_that_mend_it(name: str) -> None:
    failure, result = CATALOGUE[name], failed(name)
    assert result.termination == "singular"
    assert len(result.singular) == len(failure.words)
    for direction, words in zip(result.singular, failure.words, strict=True):
        assert words in direction.cause
        assert direction.remedy.startswith("Give a standard deviation to ")
        assert direction.parameters

    advised = " ".join(direction.remedy for direction in result.singular)
    for words, (setup, gone) in failure.mended.items():
        assert words in advised
        mended = adjust(*setup.network(), failure.options)
        assert not [each.cause for each in mended.singular if any(word in each.cause for word in gone)], words
        assert len(mended.singular) < len(failure.words)


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_each_prior_that_is_requested_ends_one_direction(name: str) -> None:
    """The four of the camera's axes in two networks, all others in theirs."""
    failure = CATALOGUE[name]
    network, start = failure.setup.network()
    alike = () if name in ("known-relief", "known-flat-vertical") else AXES
    for direction in failed(name).singular:
        if direction.cause.startswith(alike):
            continue
        for words, remedy in next((v for k, v in GIVEN.items() if k in direction.cause), []):
            assert words in direction.remedy
            mended = adjust(remedy(network), start, failure.options)
            assert len(mended.singular) == len(failure.words) - 1, f"{words} against {direction.cause}"


@pytest.mark.parametrize("name", [n if n not in DEAR else pytest.param(n, marks=pytest.mark.study) for n in MISHAPS])
def test_other_mishaps_are_reported_in_words(name: str) -> None:
    mishap = MISHAPS[name]
    text = sentences(adjust(*mishap.network(), mishap.options))
    assert len(text) == len(mishap.words)
    for sentence, words in zip(text, mishap.words, strict=True):
        assert words in sentence


@pytest.mark.parametrize("kind", ["affine", "similarity", "congruent", "projective", "bilinear", "conformal(2)"])
def test_priors_that_are_dropped_leave_the_directions_that_they_end(kind: Transformation) -> None:
    """F5..F9 dropped, F5..F8, F5 and F6, F5, F6 and F9, F7..F9, none."""
    network, start = Setup(CONVERGENT, kind=kind).network()
    tilts = ("Tilt x", "Tilt y") if kind == "projective" else ()
    scale = () if kind == "congruent" else ("Scale",)
    marks, c, point = {"x": 1.0, "y": 1.0}, {"c": 1.0}, {"x0": 1.0, "y0": 1.0}
    for kept, words in (
        ({}, (*AXES[:3], *scale, *tilts)),
        (c, (*AXES[:3], *tilts)),
        ({**c, **point}, ("Rotation", *tilts)),
        (point, ("Rotation", *scale, *tilts)),
        (marks, ()),
        ({**marks, **c, **point}, ()),
    ):
        singular = adjust(give_values(network, kept), start).singular
        assert tuple(each.cause.split(":")[0] for each in singular) == words


def test_a_singular_network_tells_too_what_is_nearly_singular() -> None:
    """Axes parallel within half a degree: c is not quite undetermined, but to mend the rest alone is no use."""
    setup = replace(
        CATALOGUE["known-flat-vertical"].setup,
        attitudes=((0.004, 0, 0.1), (0, 0.003, 1.6), (-0.004, 0, 3), (0, -0.003, -1.5)),
    )
    result = adjust(*setup.network())
    assert len(result.singular) == 4
    assert [("Practically singular" in each, DISTANCE[0] in each) for each in result.warnings] == [(True, True)]
    for name in ("known-flat-vertical", "known-flat-two", "unknown-pair"):
        assert failed(name).warnings == ()


def factorise(shared: Array, *blocks: BlockFactors) -> Factor:
    count = len(shared) + sum(block.own.size for block in blocks)
    dense = Triangle(Fronts.single(len(shared)), (shared,), (np.zeros((len(shared), 0)),))
    return Factor(DenseBlocks(blocks), dense, np.zeros(len(shared)), np.ones(count))


def test_a_block_without_its_own_determination_lends_its_rows_to_the_shared() -> None:
    """One unknown of the block is seen by no row; the row it leaves over then determines the first shared unknown."""
    shared = np.diag([0.0, 1.0])
    own = np.array([[1.0, 0.0], [0.0, 0.0]])
    border = np.array([[0.0, 0.5], [0.7, 0.0]])
    block = BlockFactors(np.array([[2, 3]]), np.array([[0, 1]]), own[None], border[None], np.zeros((1, 2)))
    found = diagnosis.null_vectors(factorise(shared, block))
    np.testing.assert_allclose(np.abs(found), [[0.0], [0.0], [0.0], [1.0]], atol=1e-12)


def test_a_network_of_many_images_is_named_like_a_small_one() -> None:
    """Sixteen parallel images of a hundred unknown points: 205 shared unknowns, nine null directions as with four."""
    rng = np.random.default_rng(2)
    stations = tuple((300.0 * (i % 4) - 450.0, 300.0 * (i // 4) - 450.0, 1500.0 + 10.0 * i) for i in range(16))
    setup = Setup(vertical(*[0.0] * 16), stations, points=field_points(rng, 100), sigma=UNKNOWN)
    result = adjust(*setup.network(), Options(datum="minimal"))
    words = (*AXES, *DEFORMATIONS, *POINT, *DISTANCE)
    assert len(result.singular) == len(words)
    assert all(word in each.cause for word, each in zip(words, result.singular, strict=True))


SINGULAR = ("K2D_vert0", "K3D_conv", "U3D_vert0", "H2D_vertcross")


def dropped(case: Case, functions: set[int]) -> Case:
    """The case with priors of 1 mm, but for the pseudo-observations that are dropped."""
    case = copy.deepcopy(case)
    sigma = {number: None if number in functions else 1.0 for number in range(5, 10)}
    case["input"]["fid_sigma"] = [[sigma[5], sigma[6]]] * len(case["input"]["fid_obs"])
    case["input"]["io_sigma"][:3] = [sigma[7], sigma[8], sigma[9]]
    return case


def adjust_network(case: Case, options: Options | None = None) -> Adjustment:
    return adjust(case_network(case), case_approximations(case, case["state"]), options)


@pytest.mark.parametrize("priors", list(DROPPED))
@pytest.mark.parametrize("name", SINGULAR)
def test_null_directions_are_counted_and_named(name: str, priors: str) -> None:
    case = load(f"v_singular_{name}_affine")
    expected = case["expected_defects_by_dropped_pseudo_observations"][priors]
    result = adjust_network(dropped(case, DROPPED[priors]))

    assert len(result.singular) == expected["total_defect"]
    assert result.termination == ("singular" if expected["total_defect"] else "converged")
    datum, camera = np.split(np.array(result.singular, dtype=object), [expected["object_datum_defect"]])
    assert all("object space" in direction.cause for direction in datum)
    for direction, row in zip(camera, expected["directions"], strict=True):
        assert CAUSES[row["lead"]] in direction.cause
        assert direction.remedy
        named = {"T" if each.kind == "film" else kind(each.text) for each in direction.parameters}
        assert named - {"FID"} <= set(row["involved"]) | {"IO.x0", "IO.y0", "IO.c"}


def kind(name: str) -> str:
    """`EO.3.X0` is of the kind EO.X0, a fiducial of the kind FID."""
    owner, quantity = name.split(".")[0], name.rsplit(".", 1)[1]
    return "FID" if owner == "FID" else f"{owner}.{quantity}"


@pytest.mark.parametrize("datum", ["minimal", "free"])
def test_a_datum_for_the_object_leaves_the_camera_directions(datum: Datum) -> None:
    case = load("v_singular_U3D_vert0_affine")
    result = adjust_network(dropped(case, {9}), Options(datum=datum))
    assert [CAUSES["IO.c"] in direction.cause for direction in result.singular] == [True]


def camera_part(result: Adjustment) -> tuple[Array, Array]:
    """Values and sigmas of everything that does not depend on the object datum."""
    names = [name for name in result.names if name.split(".")[0] in ("IO", "FID", "T")]
    values = np.array([result.value(name) for name in names])
    return values, np.array([result.cofactor.variances[result.index(name)] ** 0.5 for name in names])


CHOICES = (
    Options(datum="minimal"),
    Options(datum="minimal", datum_coordinates=("0.X", "0.Y", "0.Z", "1.X", "1.Y", "1.Z", "2.Z")),
    Options(datum="minimal", datum_coordinates=("3.X", "4.Y", "5.Z", "6.X", "7.Y", "8.Z", "9.X")),
    Options(datum="free"),
    Options(datum="free", datum_points=("1", "5", "7")),
)
HEIGHTS_CHOICES = (
    Options(datum="minimal"),
    Options(datum="minimal", datum_coordinates=("3.X", "4.Y", "5.X")),
    Options(datum="free"),
    Options(datum="free", datum_points=("1", "5")),
)


@pytest.mark.parametrize(("heights", "choices"), [(np.inf, CHOICES), (0.0, HEIGHTS_CHOICES), (0.02, HEIGHTS_CHOICES)])
def test_every_choice_of_the_datum_gives_the_same_calibration(heights: float, choices: tuple[Options, ...]) -> None:
    """To 1e-9 of the standard deviations, in self-calibration and with known heights only (Juhl)."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf, "p1": np.inf})
    points = tuple(replace(p, Z=replace(p.Z, sigma=heights)) for p in network.points if p.Z is not None)
    network = replace(network, points=points)
    results = [adjust(network, start, options) for options in choices]
    values, sigmas = camera_part(results[0])
    for result in results:
        assert result.converged
        assert result.redundancy == results[0].redundancy
        other_values, other_sigmas = camera_part(result)
        np.testing.assert_allclose((other_values - values) / np.where(sigmas > 0, sigmas, 1.0), 0.0, atol=1e-9)
        np.testing.assert_allclose(other_sigmas, sigmas, rtol=1e-9)


@pytest.mark.parametrize("heights", [np.inf, 0.0])
def test_coordinates_that_the_program_chooses_are_held_where_they_are_given(heights: float) -> None:
    """They were held where the approximations had them: a field 2 % too large, with standard deviations of nearly 0."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    points = tuple(replace(p, Z=replace(p.Z, sigma=heights)) for p in network.points if p.Z is not None)
    network = replace(network, points=points)
    scale = 30.0 if heights else 1.0  # in another unit, and aside, where nothing fixes that
    points_there = {name: scale * xyz + [1e4, 0.0, 0.0] for name, xyz in start.points.items()}
    stations_there = {
        name: np.concatenate([scale * values[:3] + [1e4, 0.0, 0.0], values[3:]])
        for name, values in start.exterior.items()
    }
    result = adjust(network, replace(start, points=points_there, exterior=stations_there), Options(datum="minimal"))
    assert result.converged
    given = {
        f"PT.{p.id}.{axis}": prior.value for p in points for axis, prior in zip("XYZ", p.priors, strict=True) if prior
    }
    held = [name for name in given if result.sigma(name) == 0.0 and (heights or not name.endswith("Z"))]
    assert len(held) == (7 if heights else 3)  # heights determine the scale
    np.testing.assert_allclose([result.value(name) for name in held], [given[name] for name in held], atol=1e-9)


def test_chosen_coordinates_are_held_where_they_are_given() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    moved = replace(start, points={name: xyz + 0.3 for name, xyz in start.points.items()})
    result = adjust(network, moved, CHOICES[2])
    for name in CHOICES[2].datum_coordinates:
        point, axis = name.split(".")
        given = getattr(network.point_by_id[point], axis).value
        assert (result.value(f"PT.{name}"), result.sigma(f"PT.{name}")) == (given, 0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (Options("minimal", ("0.X", "0.Y", "0.Z", "1.X", "1.Y", "1.Z")), ("can turn about", "leave the choice")),
        (Options("minimal", ("0.X", "0.Y", "0.Z")), ("can turn about X", "can turn about Y", "can grow or shrink")),
        (Options("minimal", (*CHOICES[1].datum_coordinates, "3.Z")), ("over-constrained", "3.Z", "7 values", "strain")),
        (Options("minimal", ("0.X", "0.Y", "0.X")), ("over-constrained", "hold 0.X already")),
        (Options("minimal", ("0.W",)), ("0.W", "12.X")),
        (Options("minimal", ("99.X",)), ("Point 99", "not among the object points")),
        (Options("free", (), ("0", "1")), ("datum points 0, 1", "can turn about")),
        (Options("free", (), ("0", "no")), ("Point no",)),
    ],
)
def test_a_datum_that_cannot_be_is_refused(options: Options, words: tuple[str, ...]) -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    with pytest.raises(AdjustmentError) as error:
        adjust(network, start, options)
    for word in words:
        assert word in str(error.value)


def test_a_flat_field_of_heights_needs_a_fourth_chosen_coordinate() -> None:
    """With noisy heights three would do formally, and noise would make the scale."""
    case = load("v_singular_H2D_vertcross_affine")
    rng = np.random.default_rng(1)
    for row, sigma in zip(case["input"]["pts_obs"], case["input"]["pts_sigma"], strict=True):
        row[2] += rng.normal(0.0, 0.02)
        sigma[2] = 0.02
    network, start = case_network(case), case_approximations(case, case["state"])
    first, last = network.points[0].id, network.points[-1].id
    with pytest.raises(AdjustmentError, match="leave datum defects of the object space"):
        adjust(network, start, Options("minimal", (f"{first}.X", f"{first}.Y", f"{last}.X")))
    four = Options("minimal", (f"{first}.X", f"{first}.Y", f"{last}.X", f"{last}.Y"))
    assert adjust(network, start, four).unknowns == adjust(network, start, Options("minimal")).unknowns


def test_a_coordinate_that_is_given_needs_no_holding() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=0.05)
    with pytest.raises(AdjustmentError, match="X is given with the standard deviation"):
        adjust(network, start, Options("minimal", ("0.X",)))


def test_a_generator_moves_a_point_at_the_fields_root_mean_square_distance_by_one_unit() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    problem = number(network, start)
    datum = object_datum(problem, problem.start())
    points = np.array(list(start.points.values()))
    spread = np.sqrt(((points - points.mean(axis=0)) ** 2).sum() / len(points))
    assert datum.extent == pytest.approx(spread, rel=1e-9)
    positions = np.array([problem.unknowns.point[name] for name in start.points])
    motions = datum.generators[positions, 6]
    np.testing.assert_allclose(motions, (points - points.mean(axis=0)) / spread, atol=1e-9)


@pytest.mark.parametrize("carrying", [(), ("1", "5", "7")], ids=["all", "some"])
def test_inner_constraints_have_the_least_trace_and_leave_centre_turn_and_size(carrying: tuple[str, ...]) -> None:
    """The pseudo-inverse of the points' normal equations: no datum gives a smaller trace of their cofactors."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    free = adjust(network, start, Options("free", datum_points=carrying))
    others = [adjust(network, start, each) for each in (CHOICES[0], CHOICES[4], CHOICES[3])]
    names = [f"PT.{one.id}.{axis}" for one in network.points if one.id in carrying or not carrying for axis in "XYZ"]
    part = free.cofactor_of(names)
    assert all(np.trace(part) <= (1.0 + 1e-9) * np.trace(each.cofactor_of(names)) for each in others)
    assert np.trace(part) < 0.99 * np.trace(others[0].cofactor_of(names))
    values = free.values_of(names).reshape(-1, 3)
    given = np.array([start.points[name.split(".")[1]] for name in names[::3]])
    centred, change = values - values.mean(axis=0), values - given
    np.testing.assert_allclose(change.mean(axis=0), 0.0, atol=1e-8)
    np.testing.assert_allclose(np.cross(centred, change).sum(axis=0), 0.0, atol=1e-5 * np.abs(centred).max())
    assert abs((centred * change).sum()) < 1e-5 * np.abs(centred).max()
    # The seven similarity directions are exactly those that the cofactor matrix does not contain.
    directions = [np.tile(axis, len(values)) for axis in np.eye(3)]
    directions += [np.cross(axis, centred).ravel() for axis in np.eye(3)] + [centred.ravel()]
    for direction in directions:
        assert np.linalg.norm(part @ direction) < 1e-9 * np.linalg.norm(part) * np.linalg.norm(direction)
    eigenvalues = np.linalg.eigvalsh(part)
    assert eigenvalues[6] < 1e-9 * eigenvalues[7]


def test_no_attitude_is_singular() -> None:
    """phi of 90 degrees: omega and kappa are not defined one by one, everything else is."""
    half = np.pi / 2
    truth = Truth(
        attitudes=((0.0, half, 0.0), (0.0, half - 0.3, 0.1), (0.0, half + 0.3, 1.5), (0.3, half, -1.5)),
        stations=((1500.0, 0.0, 0.0), (1400.0, 100.0, 500.0), (1450.0, 30.0, -480.0), (1400.0, -520.0, 60.0)),
    )
    rng = np.random.default_rng(10)
    points = rng.uniform([-200.0, -800.0, -800.0], [200.0, 800.0, 800.0], (14, 3))
    network, start = simulated(rng, truth, points=points, noise=False)
    result = adjust(network, start)
    assert result.converged
    assert result.vpv < 1e-12
    assert np.isfinite(result.cofactor_of(result.names)).all()
    assert result.value("EO.f0.phi") == pytest.approx(half, abs=1e-6)
