"""A board whose two bends are unknown: found with honest standard deviations, and said where they cannot be."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from faults import center_of_gravity
from networks import digital_network, view_rows
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adjust import Adjustment, AdjustmentError, Camera, Distortion, Prior, adjust, approximate
from adjust.functional_model.board import disk_directions
from adjust.model_selection.model_choice import choose
from adjust.problem.estimates import adjusted_places
from adjust.problem.network import Board, Network, ObjectPoint

Array = NDArray[np.float64]

COLUMNS, ROWS, SPACING_MM = 10, 7, 30.0
BENDS_MM = np.array([0.9, -0.5])
SIGMA_MM = 0.0005
C_MM, K1 = 20.0, -0.08
TURNS = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.3), (-0.5, 0.1, 1.2), (0.1, 0.55, -0.7), (0.0, -0.5, 2.0), (0.4, -0.4, -2.1)]


def flat_board() -> Array:
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    return np.stack([SPACING_MM * x.ravel(), SPACING_MM * y.ravel(), np.zeros(x.size)], axis=1)


def bent_board() -> Array:
    """4 k (t - t²) along each axis, t from 0 to 1, as mrcal's ref_calibration_object says."""
    board = flat_board()
    t = board[:, :2] / (SPACING_MM * np.array([COLUMNS - 1, ROWS - 1]))
    board[:, 2] = 4.0 * (t - t**2) @ BENDS_MM
    return board


def make_network(rng: np.random.Generator | None, turned: Array | None = None, bent: bool = True) -> Network:
    """Six views by OpenCV of the bent board; turned (3, 3): how the board lies in the object's axes."""
    turn = np.eye(3) if turned is None else turned
    flat, real = flat_board(), bent_board()
    middle = flat.mean(axis=0)
    places = []
    for angles in TURNS:
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        shift = np.array([0.0, 0.0, 420.0]) - rotation @ middle
        matrix = np.array([[C_MM, 0.0, 0.1], [0.0, C_MM, 0.05], [0.0, 0.0, 1.0]])
        projected, _ = cv2.projectPoints(real, cv2.Rodrigues(rotation)[0], shift, matrix, np.array([K1, 0.0, 0.0, 0.0]))
        places.append(np.reshape(projected, (-1, 2)) * [1.0, -1.0])
    views = np.array(places)
    views = views if rng is None else views + rng.normal(0.0, SIGMA_MM, views.shape)
    points = {f"p{k}": turn @ place for k, place in enumerate(flat)}
    camera = Camera("C", Prior(20.5, np.inf), None, None, Distortion("opencv", {"k1": Prior(0.0, np.inf)}))
    network = digital_network(camera, view_rows(views, list(points)), points, SIGMA_MM)
    return replace(network, boards=(Board("board", points),) if bent else ())


def bends(found: Adjustment) -> Array:
    return np.array([found.value("BD.board.bend_x"), found.value("BD.board.bend_y")])


def test_the_bends_of_exact_views_are_found() -> None:
    network = make_network(None)
    found = adjust(network, approximate(network))
    assert found.converged
    np.testing.assert_allclose(bends(found), BENDS_MM, atol=1e-7)
    assert found.value("IO.C.c") == pytest.approx(C_MM, abs=1e-7)
    np.testing.assert_allclose(adjusted_places(found, [f"p{k}" for k in range(70)]), bent_board(), atol=1e-6)
    flat = adjust(make_network(None, bent=False), approximate(network))
    assert flat.sigma0 > 5.0  # without them the board does not fit


@pytest.mark.parametrize("turn", [(0.0, 90.0, 0.0), (40.0, -25.0, 70.0), (10.0, 20.0, -30.0)])
def test_a_board_lies_anyhow_in_the_object(turn: tuple[float, float, float]) -> None:
    """The same images, the board on another plane and turned in it: the same places but for that turn."""
    turned = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    found = adjust(make_network(None, turned), approximate(make_network(None, turned)))
    places = adjusted_places(found, [f"p{k}" for k in range(70)])
    np.testing.assert_allclose(places, bent_board() @ turned.T, atol=1e-6)
    assert found.vpv < 1e-10


def test_the_centre_of_gravity_of_an_imaged_disk() -> None:
    """By an outline of 400 points through OpenCV's strong lens."""
    rotation, shift, radius = np.array([0.5, -0.3, 0.2]), np.array([10.0, 20.0, 400.0]), 3.0
    lens, matrix = np.array([-0.3, 0.1, 2e-3, -1e-3]), np.diag([C_MM, C_MM, 1.0])
    centres, angles = flat_board() - [100.0, 60.0, 0.0], np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)

    def image(points: Array) -> Array:
        return np.reshape(
            cv2.projectPoints(points.reshape(-1, 3), rotation, shift, matrix, lens)[0], (*points.shape[:-1], 2)
        )

    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    gravity = center_of_gravity(image(centres[:, None] + circle))
    axes = np.eye(3)[:2]
    at = {(i, j): image(centres + radius * (np.array([i, j]) @ axes)) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    moved = image(centres + radius**2 * disk_directions(at, axes, radius)[:, 0])
    np.testing.assert_allclose(moved - at[0, 0], gravity - at[0, 0], atol=0.01 * np.abs(gravity - at[0, 0]).max())


def test_what_is_no_board_is_refused() -> None:
    network = make_network(None)
    unknown = replace(network, points=(ObjectPoint("p0", None, None, None), *network.points[1:]))
    with pytest.raises(AdjustmentError, match="point p0 of board board is not known"):
        adjust(unknown, approximate(network))
    twice = replace(network, boards=(*network.boards, Board("other", dict(network.boards[0].places))))
    with pytest.raises(AdjustmentError, match="is on the boards board and other"):
        adjust(twice, approximate(network))


@pytest.mark.study
def test_a_choice_of_models_knows_the_bend() -> None:
    """k1 is chosen, and left-out points are predicted where the bent board has them."""
    own = adjust(make_network(np.random.default_rng(3)), approximate(make_network(None)))
    chosen = choose(own).chosen
    assert chosen is not None
    assert chosen.model.parameters == ("k1",)
    assert chosen.cross_validation is not None
    assert 0.9 < chosen.cross_validation.sigmas < 1.15
