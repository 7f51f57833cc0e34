"""The gallery of failures: every network of the catalogue, how many null directions, their words, and the remedies."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mishaps import MISHAPS, sentences
from null_directions import AXES, CATALOGUE, DEFORMATIONS, DISTANCE
from setups import CONVERGENT, Setup, give_values

from adjust.functional_model.lens import Prior
from adjust.problem.network import Approximations, Exterior, Network, Transformation
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

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


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_number_words_and_changes_of_the_network_that_mend_it(name: str) -> None:
    failure = CATALOGUE[name]
    result = adjust(*failure.setup.network(), failure.options)
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
        assert not causes(mended, gone), words
        assert len(mended.singular) < len(failure.words)


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_each_prior_that_is_requested_ends_one_direction(name: str) -> None:
    """The four of the camera's axes in two networks, all others in theirs."""
    failure = CATALOGUE[name]
    network, start = failure.setup.network()
    alike = () if name in ("known-relief", "known-flat-vertical") else AXES
    for direction in adjust(network, start, failure.options).singular:
        if direction.cause.startswith(alike):
            continue
        for words, remedy in next((v for k, v in GIVEN.items() if k in direction.cause), []):
            assert words in direction.remedy
            mended = adjust(remedy(network), start, failure.options)
            assert len(mended.singular) == len(failure.words) - 1, f"{words} against {direction.cause}"


@pytest.mark.parametrize("name", ["known-relief", "known-flat-tilted", "known-flat-two"])
def test_fiducials_with_priors_end_what_they_are_to_end(name: str) -> None:
    """Two marks: shifts, rotation and scale; three: affinity and shear too."""
    failure = CATALOGUE[name]
    network, start = failure.setup.network()
    for marks, gone in ((2, AXES), (3, AXES + DEFORMATIONS)):
        mended = adjust(give_values(network, {"x": 1.0, "y": 1.0}, marks), start, failure.options)
        assert not causes(mended, gone)


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


@pytest.mark.parametrize(
    ("known", "gone"),
    [
        (("7.X",), ("shift in X",)),
        (("7.Y",), ("shift in Y",)),
        (("7.Z",), ("shift in Z",)),
        (("0.Z", "1.Z", "2.Z"), ("shift in Z", "turn about X", "turn about Y")),
        (("0.X", "0.Y", "1.X", "1.Y"), ("shift in X", "shift in Y", "turn about Z", "grow or shrink")),
    ],
)
def test_coordinates_that_are_requested_end_their_part_of_the_datum(
    known: tuple[str, ...], gone: tuple[str, ...]
) -> None:
    """Point 7 lies in the middle: a coordinate of a far point ends a turn or the scale as well as a shift."""
    network, start = MISHAPS["no-datum"].network()
    left = [each.cause for each in adjust(fix_stations(network, start, known), start).singular]
    assert len(left) == 7 - len(gone)
    assert not [cause for cause in left if any(words in cause for words in gone)]


def test_images_and_points_are_mended_as_advised() -> None:
    network, start = MISHAPS["one-ray"].network()
    known = tuple(f"{point}.{axis}" for point in "0123" for axis in "XYZ")
    assert adjust(fix_stations(network, start, known), start).converged
    network, start = MISHAPS["targets-on-a-line"].network()
    oriented = tuple(
        replace(image, exterior=Exterior(start.exterior["f3"], np.array([1.0] * 3 + [1e-3] * 3)))
        if image.name == "f3"
        else image
        for image in network.images
    )
    assert adjust(replace(network, images=oriented), start).converged


def fix_stations(network: Network, start: Approximations, names: tuple[str, ...]) -> Network:
    """The network with some coordinates given as they are, with a standard deviation of a centimetre."""
    points = []
    for point in network.points:
        of_point = {axis: Prior(float(start.points[point.id][i]), 0.01) for i, axis in enumerate("XYZ")}
        x, y, z = (of_point[axis] if f"{point.id}.{axis}" in names else None for axis in "XYZ")
        points.append(replace(point, X=x or point.X, Y=y or point.Y, Z=z or point.Z))
    return replace(network, points=tuple(points))


def test_a_singular_network_tells_too_what_is_nearly_singular() -> None:
    """Axes parallel within half a degree: c is not quite undetermined, but to mend the rest alone is no use."""
    setup = replace(
        CATALOGUE["known-flat-vertical"].setup,
        attitudes=((0.004, 0, 0.1), (0, 0.003, 1.6), (-0.004, 0, 3), (0, -0.003, -1.5)),
    )
    result = adjust(*setup.network())
    assert len(result.singular) == 4
    assert [("Practically singular" in warning, DISTANCE[0] in warning) for warning in result.warnings] == [
        (True, True)
    ]
    for name in ("known-flat-vertical", "known-flat-two", "unknown-pair"):
        assert adjust(*CATALOGUE[name].setup.network(), CATALOGUE[name].options).warnings == ()


def causes(result: Adjustment, words: tuple[str, ...]) -> list[str]:
    """The causes that a result still tells, of those with some words."""
    return [direction.cause for direction in result.singular if any(word in direction.cause for word in words)]
