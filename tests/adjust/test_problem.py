"""Bad input, one thing at a time, and the keys of quantities."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from networks import Name, Truth, add_errors, simulated, two_cameras

from adjust import Distortion, Exterior, Network, ObjectPoint, Prior
from adjust.errors import AdjustmentError, DatumError
from adjust.problem.parameter import (
    CODES,
    Parameter,
    description,
    object_coordinate,
    parameter_from_text,
    parameters_from_texts,
)
from adjust.solution.adjustment import Datum, Options, adjust

Change = Callable[[Network], Network]


def rows(network: Network, keep: list[int]) -> Network:
    """The network with some of its observations; a row may be repeated."""
    return replace(network, observations=network.observations.only(np.array(keep, dtype=np.intp)))


def drop_observations(network: Network, image: str, kind: str, left: int) -> Network:
    """All but some marks of a kind in an image."""
    observations = network.observations
    places = [i for i in range(len(observations)) if (observations.image[i], observations.kind[i]) == (image, kind)]
    return rows(network, [i for i in range(len(observations)) if i not in places[left:]])


def drop_fiducial(network: Network) -> Network:
    camera = network.cameras[0]
    marks = {id_: mark for id_, mark in camera.fiducials.items() if id_ != "3"}
    return replace(network, cameras=(replace(camera, fiducials=marks),))


def strange_parameter(network: Network) -> Network:
    distortion = Distortion("torlegard", {"k9": Prior(1.0)})
    return replace(network, cameras=(replace(network.cameras[0], distortion=distortion),))


def bad_covariance(network: Network) -> Network:
    covariance = network.observations.covariance_mm2.copy()
    covariance[8] = [[1e-6, 2e-6], [2e-6, 1e-6]]
    return replace(network, observations=replace(network.observations, covariance_mm2=covariance))


GALLERY: dict[str, tuple[Change, list[str]]] = {
    "no images": (lambda n: replace(n, images=()), ["nothing to adjust", "no image"]),
    "no observations": (lambda n: rows(n, []), ["nothing to adjust", "statuses"]),
    "camera twice": (lambda n: replace(n, cameras=n.cameras * 2), ["camera K", "more than once"]),
    "image twice": (lambda n: replace(n, images=(*n.images, n.images[2])), ["image f2", "more than once"]),
    "point twice": (lambda n: replace(n, points=(*n.points, n.points[4])), ["object point 4", "more than once"]),
    "unknown camera": (
        lambda n: replace(n, images=(replace(n.images[0], camera="RMK"), *n.images[1:])),
        ["image f0", "camera RMK", "given: K"],
    ),
    "unknown image": (lambda n: replace(n, images=n.images[1:]), ["image f0", "Add the image"]),
    "unknown point": (lambda n: replace(n, points=n.points[1:]), ["target 0", "image f0", "Add it to the points"]),
    "unknown fiducial": (drop_fiducial, ["fiducial 3", "image f0", "camera K"]),
    "observed twice": (lambda n: rows(n, [*range(len(n.observations)), 7]), ["point 2", "2 times", "image f0"]),
    "covariance": (bad_covariance, ["target 3", "image f0", "not positive definite"]),
    "nan": (lambda n: add_errors(n, {9: np.array([0.0, np.nan])}), ["target 4", "image f0", "not a finite number"]),
    "two targets": (lambda n: drop_observations(n, "f1", "target", 2), ["image f1", "2 object points", "needs 3"]),
    "two fiducials": (
        lambda n: drop_observations(n, "f3", "fiducial", 2),
        ["image f3", "2 fiducial", "affine", "needs 3"],
    ),
    "two of four": (
        lambda n: drop_observations(
            replace(n, images=tuple(replace(each, transformation="projective") for each in n.images)),
            "f3",
            "fiducial",
            2,
        ),
        ["image f3", "2 fiducial", "projective transformation needs 3", "4 where its targets tell nothing of it"],
    ),
    "no fiducials": (lambda n: drop_observations(n, "f3", "fiducial", 0), ["image f3", "0 fiducial", "needs 3"]),
    "parameter": (strange_parameter, ["camera K", "torlegard", "k9", "k3, k5"]),
    "rows do not go together": (
        lambda n: replace(n, observations=replace(n.observations, point=n.observations.point[:-1])),
        ["do not go together"],
    ),
}


@pytest.mark.parametrize("name", list(GALLERY))
def test_gallery(name: str) -> None:
    change, words = GALLERY[name]
    network, start = simulated(np.random.default_rng(1))
    with pytest.raises(AdjustmentError) as caught:
        adjust(change(network), start)
    for word in words:
        assert word in str(caught.value)


def test_a_negative_principal_distance() -> None:
    network, start = simulated(np.random.default_rng(1))
    camera = replace(network.cameras[0], principal_distance_mm=Prior(-153.0, 1.0))
    with pytest.raises(AdjustmentError, match=r"camera K: the principal distance must be positive"):
        adjust(replace(network, cameras=(camera,)), start)


def test_an_image_turned_away() -> None:
    """The station below the field: every point is behind the camera."""
    network, start = simulated(np.random.default_rng(1))
    below = dict(start.exterior) | {"f2": start.exterior["f2"] * np.array([1, 1, -1, 1, 1, 1])}
    with pytest.raises(AdjustmentError, match=r"point 0 lies behind the camera in image f2"):
        adjust(network, replace(start, exterior=below))


def test_a_missing_approximation() -> None:
    network, start = simulated(np.random.default_rng(1))
    with pytest.raises(AdjustmentError, match=r"X0 of image f1 has neither a value nor an approximation"):
        adjust(network, replace(start, exterior={k: v for k, v in start.exterior.items() if k != "f1"}))
    with pytest.raises(AdjustmentError, match=r"image f1: .*affine has 6 parameters .*but 4"):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": np.zeros(4)}))


def test_an_image_with_two_targets_and_a_known_orientation_is_adjusted() -> None:
    truth = Truth()
    network, start = simulated(np.random.default_rng(1), truth)
    known = Exterior(np.array([*truth.stations[1], *truth.attitudes[1]]), np.full(6, 0.01))
    images = tuple(replace(image, exterior=known) if image.name == "f1" else image for image in network.images)
    result = adjust(drop_observations(replace(network, images=images), "f1", "target", 2), start)
    assert result.converged


def test_bad_options_are_refused() -> None:
    with pytest.raises(ValueError, match=r"datum must be one of control, minimal, free"):
        Options(datum=cast(Datum, "fixed"))
    with pytest.raises(ValueError, match="iteration limit must be at least 1"):
        Options(iteration_limit=0)


def test_bad_values_are_refused_when_they_are_made() -> None:
    with pytest.raises(ValueError, match="finite number"):
        Prior(np.nan)
    with pytest.raises(ValueError, match=r"0 \(fixed\), positive or inf"):
        Prior(1.0, -1.0)
    with pytest.raises(ValueError, match="six elements"):
        Exterior(np.zeros(5))
    with pytest.raises(ValueError, match=r"0 \(fixed\), positive or inf"):
        Exterior(np.zeros(6), np.array([1.0, 1.0, 1.0, 1.0, 1.0, np.nan]))
    with pytest.raises(ValueError, match="one of none, torlegard"):
        Distortion("fisheye")
    with pytest.raises(ValueError, match="r0 must be"):
        Distortion("torlegard", r0_mm=-80.0)


ROOT = Path(__file__).parents[2]
CODE = re.compile(rf"({'|'.join(CODES.values())})\.")


def test_ordinary_names_are_written_as_they_always_were() -> None:
    keys = {
        "IO.Wild RC8 13.5.k3": Parameter.interior("Wild RC8 13.5", "k3"),
        "FID.Wild RC8 13.5.3.x": Parameter.fiducial("Wild RC8 13.5", "3", "x"),
        "SC.S 1.a20": Parameter.scanner("S 1", "a20"),
        "BD.board.bend_x": Parameter.board("board", "bend_x"),
        "PT.12.4.X": Parameter.point("12.4", "X"),
        "EO.roll 7/frame.8.Z0": Parameter.exterior("roll 7/frame.8", "Z0"),
        "T.f1.a1": Parameter.film("f1", "a1"),
        "JOIN.f.1.p3.y": Parameter.join("f.1", "p3", "y"),
    }
    assert {key.text: key for key in keys.values()} == keys
    assert parameters_from_texts(list(keys)) == tuple(keys.values())


def random_name(rng: np.random.Generator) -> str:
    """Of pieces that separators, escapes and codes are made of."""
    pieces = [*"Ab1.%*ß点x /,;=", "..", "%2E", "%25", "2E", "25", "IO.", "\\", '"']
    return "".join(rng.choice(pieces, rng.integers(1, 6)))


def test_texts_of_any_names_are_unique_and_are_read_back() -> None:
    rng = np.random.default_rng(38)
    keys: set[Parameter] = set()
    while len(keys) < 4000:
        owner, id, quantity = random_name(rng), random_name(rng), str(rng.choice(["c", "x", "k3", "X0"]))
        if owner != "*":  # many owners in a list of what moves together
            keys |= {Parameter.fiducial(owner, id, quantity), Parameter.join(owner, id, quantity)}
        keys |= {
            Parameter.interior(owner, quantity),
            Parameter.point(id, quantity),
            Parameter.exterior(owner, quantity),
        }
    assert len({each.text for each in keys}) == len(keys)
    assert all(parameter_from_text(each.text) == each for each in keys)


def test_one_of_many_is_read_back_too() -> None:
    of = [Parameter.fiducial("K.1", "2.3", "x"), Parameter.point("2", "X"), Parameter.exterior("f", "Z0")]
    of += [Parameter.film("f", "a1"), Parameter.join("f", "2.3", "x"), Parameter.interior("K", "c")]
    texts = [each.any_owner.text for each in of]
    assert texts == ["FID.K.1.*.x", "PT.*.X", "EO.*.Z0", "T.*.a1", "JOIN.*.x", "IO.K.c"]
    assert [parameter_from_text(text) for text in texts] == [each.any_owner for each in of]


@pytest.mark.parametrize("text", ["", "IO", "IO.K", "XX.K.c", "FID.K.x", "IO.K.", "f1 X", "IO.f.1 X", "K.c"])
def test_what_names_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="names no quantity"):
        parameter_from_text(text)


def test_fiducials_of_earlier_files_are_known_by_their_camera() -> None:
    texts = ["IO.K.c", "IO.W.1.c", "FID.K.7.1.x", "FID.K.7.y", "FID.W.1.3.x", "FID.K.8%2E1.x"]
    marks = [(each.owner, each.id) for each in parameters_from_texts(texts)[2:]]
    assert marks == [("K", "7.1"), ("K", "7"), ("W.1", "3"), ("K", "8.1")]


def test_messages_name_quantities_in_words() -> None:
    mark = Parameter.fiducial("Wild RC8", "3", "x")
    assert mark.label == "x of fiducial 3, camera Wild RC8"
    assert Parameter.interior("Wild RC8", "k3").label == "k3 of camera Wild RC8"
    assert Parameter.exterior("f.1", "omega").label == "omega of image f.1"
    assert Parameter.film("f1", "a2").label == "a2 of the film transformation of image f1"
    moved = [Parameter.interior("K", "c"), mark, mark._replace(quantity="y"), Parameter.exterior("*", "Z0")]
    assert description(moved) == "c of camera K; x and y of fiducial 3, camera Wild RC8; Z0 of several images"


def test_a_coordinate_is_called_by_its_point() -> None:
    assert object_coordinate("roll.1.X") == Parameter.point("roll.1", "X")
    with pytest.raises(DatumError, match=r"a dot and X, Y or Z"):
        object_coordinate("12")


HOSTILE = "a, b=c; d.e ß点.1"


@pytest.mark.parametrize(
    ("cameras", "prefixes"), [(("A", "A.B"), ("B.", "")), ((HOSTILE, f"{HOSTILE}.{HOSTILE}"), (f"{HOSTILE}.", ""))]
)
def test_names_that_would_run_together_have_values_of_their_own(
    cameras: tuple[str, str], prefixes: tuple[str, str]
) -> None:
    """The same network under plain names gives the same values, standard deviations and covariances."""
    plain = adjust(*two_cameras(("K", "W"), (str, str), str, str))
    of: tuple[Name, Name] = (f"{prefixes[0]}{{}}".format, f"{prefixes[1]}{{}}".format)
    other = adjust(*two_cameras(cameras, of, lambda name: f"{HOSTILE}.{name}", lambda id: f"{HOSTILE}.{id}"))
    assert plain.converged
    assert other.converged
    assert len(set(other.names)) == len(other.names)
    np.testing.assert_array_equal(other.values, plain.values)
    own, alike = ([] for _ in range(2))
    for camera, name, mark in zip("KW", cameras, of, strict=True):
        own += [Parameter.fiducial(camera, id, axis) for id in "1234" for axis in "xy"]
        alike += [Parameter.fiducial(name, mark(id), axis) for id in "1234" for axis in "xy"]
    np.testing.assert_array_equal(other.values_of(alike), plain.values_of(own))
    np.testing.assert_array_equal(other.cofactor_of(alike), plain.cofactor_of(own))
    assert [other.sigma(each) for each in alike] == [plain.sigma(each) for each in own]
    assert min(plain.sigma(each) for each in own) > 1e-4


def test_approximations_are_no_known_coordinates() -> None:
    points = (
        ObjectPoint("1", Prior(1.0), Prior(2.0, 0.1), Prior(3.0, np.inf)),
        ObjectPoint("2", None, Prior(5.0), None),
        ObjectPoint("3", Prior(6.0), Prior(7.0), Prior(8.0, 0.5)),
    )
    network = replace(simulated(np.random.default_rng(0))[0], points=points)
    np.testing.assert_array_equal(network.coordinates(firm=True)["1"], [1.0, 2.0, np.nan])
    np.testing.assert_array_equal(network.coordinates(firm=False)["1"], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(network.coordinates(firm=False)["2"], [np.nan, 5.0, np.nan])
    assert list(network.known_places) == ["3"]
