"""One image whose resection fails ends nothing: it is left out and named, and comes in once the lens is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import digital_network
from studies import parametrize_with_studies

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.solution.adjustment import Options, adjust

Array = NDArray[np.float64]

SIGMA_MM = 0.001
C, LENS = 10.0, np.array([-0.25, 0.035, 1e-4, -1e-4, 0.0])
MATRIX = np.array([[C, 0.0, 0.0], [0.0, C, 0.0], [0.0, 0.0, 1.0]])
ROWS, COLUMNS = 6, 9
BOARD = np.array([[25.0 * (i - 4), 25.0 * (j - 2.5), 0.0] for j in range(ROWS) for i in range(COLUMNS)])

EIGHTEEN = list(range(0, 54, 3))


def view_points(turn: Array, shift: Array) -> Array:
    return np.asarray(cv2.projectPoints(BOARD, turn, shift, MATRIX, LENS)[0].reshape(-1, 2) * [1.0, -1.0])


def good_images(count: int, rng: np.random.Generator, nearest: float = 350.0) -> dict[str, Array]:
    images = {}
    for i in range(count):
        azimuth, tilt = 2.4 * i, np.radians(rng.uniform(15.0, 35.0))
        turn = np.array([np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0.1 * rng.normal()])
        images[f"good{i}"] = view_points(
            turn, np.array([*rng.uniform(-40.0, 40.0, 2), nearest * rng.uniform(1.0, 1.4)])
        )
    return images


def make_network(
    images: dict[str, Array], rng: np.random.Generator, points: dict[str, list[int]] | None = None
) -> Network:
    """points: of some images, the corners that they show; all 54 of the others."""
    rows = [
        (name, f"c{k}", xy[k] + rng.normal(0.0, SIGMA_MM, 2))
        for name, xy in images.items()
        for k in (points or {}).get(name, range(len(BOARD)))
    ]
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "p1", "p2")}
    camera = Camera("cam", Prior(1.03 * C, np.inf), Prior(0.0, np.inf), Prior(0.0, np.inf), Distortion("opencv", free))
    return digital_network(camera, rows, {f"c{k}": xyz for k, xyz in enumerate(BOARD)}, SIGMA_MM)


@parametrize_with_studies("robust", [False, True], quick=(1,))
def test_an_image_with_wrong_names_is_left_out(robust: bool) -> None:
    rng = np.random.default_rng(1)
    images = good_images(8, rng)
    network = make_network({**images, "shuffled": rng.permutation(images["good0"])}, rng, {"shuffled": EIGHTEEN})
    with pytest.raises(AdjustmentError, match="image shuffled sees 18 known points, but no orientation"):
        approximate(network)
    result = adjust(network, options=Options(robust=robust))
    assert result.converged
    assert list(result.left_out) == ["shuffled"]
    (warning,) = [each for each in result.warnings if "shuffled" in each]
    assert warning.startswith("Left out of the adjustment: image shuffled sees 18 known points")
    alone = adjust(make_network(images, np.random.default_rng(1)))
    assert {image.name for image in result.network.images} == set(images)
    assert abs(result.value("IO.cam.c") - C) < 4.0 * result.sigma("IO.cam.c")
    assert result.redundancy == alone.redundancy


def test_an_image_whose_points_lie_on_a_line_is_left_out() -> None:
    rng = np.random.default_rng(2)
    images = good_images(6, rng)
    network = make_network({**images, "line": images["good0"]}, rng, {"line": [0, 2, 5, 8]})
    result = adjust(network)
    assert result.converged
    assert list(result.left_out) == ["line"]


def test_an_image_of_the_lens_far_outside_comes_in_with_the_adjusted_lens() -> None:
    """Taken for a pinhole's it leaves more than a twentieth of the principal distance."""
    rng = np.random.default_rng(3)
    images = good_images(8, rng, nearest=120.0)
    wide = view_points(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 60.0]))
    network = make_network({**images, "wide": wide}, rng)
    with pytest.raises(AdjustmentError, match="image wide sees"):
        approximate(network)
    result = adjust(network)
    assert result.converged
    assert not result.left_out
    assert not result.warnings
    assert {image.name for image in result.network.images} == {*images, "wide"}
    assert 0.9 < result.sigma0 < 1.1


@pytest.mark.study
def test_where_half_of_the_images_fail_it_is_no_single_one() -> None:
    rng = np.random.default_rng(4)
    images = good_images(2, rng)
    bad = {f"bad{i}": rng.permutation(images["good0"]) for i in range(2)}
    network = make_network({**images, **bad}, rng, dict.fromkeys(bad, EIGHTEEN))
    with pytest.raises(AdjustmentError, match="image bad0 sees 18 known points"):
        adjust(network)


@pytest.mark.study
@pytest.mark.parametrize("robust", [False, True])
def test_an_image_with_a_point_behind_its_camera_is_left_out(robust: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One number of 55 is wrong: its point, in sight of all others, lies behind that one camera."""
    monkeypatch.setitem(globals(), "BOARD", np.vstack([BOARD, [10.0, 5.0, -170.0]]))
    rng = np.random.default_rng(6)
    images = good_images(8, rng)
    near = view_points(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 120.0]))
    near[-1] = 0.5, 0.3
    result = adjust(make_network({**images, "near": near}, rng), options=Options(robust=robust))
    assert result.converged
    assert result.left_out["near"].startswith("point c54 lies behind the camera in image near.")
    assert list(result.left_out) == ["near"]
    assert any(each.startswith("Left out of the adjustment: point c54 lies behind") for each in result.warnings)
    assert {image.name for image in result.network.images} == set(images)
    assert abs(result.value("IO.cam.c") - C) < 4.0 * result.sigma("IO.cam.c")
    assert 0.9 < result.sigma0 < 1.1


def test_points_that_only_a_left_out_image_shows_go_with_it() -> None:
    rng = np.random.default_rng(5)
    images = good_images(6, rng)
    network = make_network(
        {**images, "shuffled": rng.permutation(images["good0"])}, rng, {f"good{i}": list(range(45)) for i in range(6)}
    )
    unknown = tuple(replace(each, X=None, Y=None, Z=None) if each.id == "c50" else each for each in network.points)
    result = adjust(replace(network, points=unknown))
    assert result.converged
    assert list(result.left_out) == ["shuffled"]
    assert not {"c50", "c51"} & {point.id for point in result.network.points}
