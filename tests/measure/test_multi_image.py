"""Multi-image matching of analytic texture, whose places in every picture are known."""

import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure.tie_points.multi_image import RADIUS_PX, SPARE_PX, Piece, match_pieces

Array = NDArray[np.float64]

HALF = RADIUS_PX + SPARE_PX
MAPS = (
    np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    np.array([[0.02, -1.03, 0.3], [0.98, 0.05, -0.2]]),  # a quarter turn
    np.array([[-1.01, 0.04, 0.1], [0.03, 0.97, 0.4]]),  # mirrored
)


def texture(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Centres (n, 2), widths (n,) and tones (n,) of spots."""
    return rng.uniform(-28.0, 28.0, (250, 2)), rng.uniform(1.5, 3.5, 250), rng.normal(0.0, 20.0, 250)


def picture(spots: tuple[Array, Array, Array], scan_from_patch: Array, bending: Array | None = None) -> Array:
    """The texture as it looks through a map; its point is where the map's shift puts it, about the middle.

    bending (6,): coefficients of u², uv, v² for the columns and for the rows, px at the patch's rim.
    """
    centers, widths, tones = spots
    edge = np.arange(-HALF, HALF + 1.0)
    pixels = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    patch = (pixels - scan_from_patch[:, 2]) @ np.linalg.inv(scan_from_patch[:, :2]).T
    if bending is not None:
        u, v = patch.T / RADIUS_PX
        patch = patch + np.stack([u * u, u * v, v * v], axis=1) @ bending.reshape(2, 3).T
    # Squared distances over twice the squared widths, as one product of matrices: spot by spot takes far longer.
    spots_by = np.vstack([-2.0 * centers.T, np.ones(len(centers)), (centers**2).sum(axis=1)]) / (2 * widths**2)
    distance = np.column_stack([patch, (patch**2).sum(axis=1), np.ones(len(patch))]) @ spots_by
    grey = 500.0 + np.exp(-distance) @ tones
    return np.asarray(grey.reshape(len(edge), len(edge)))


def pieces(rng: np.random.Generator, noise: float) -> list[Piece]:
    """One point in three pictures of different gain, with approximate maps."""
    spots = texture(rng)
    made = []
    for index, matrix in enumerate(MAPS):
        grey = (1.0 + 0.3 * index) * picture(spots, matrix)
        grey = grey + rng.normal(0.0, noise * (1.0 + 0.3 * index), grey.shape)
        start = matrix.copy()
        if index:
            start[:, :2] += rng.normal(0.0, 0.03, (2, 2))
            start[:, 2] += rng.normal(0.0, 0.7, 2)
        made.append(Piece(grey, (-HALF, -HALF), start))
    return made


@parametrize_with_studies(("radius_px", "limit_px", "rounds"), [(RADIUS_PX, 0.06, 16), (21, 0.035, 30)])
def test_errors_are_as_large_as_their_covariances_say(radius_px: int, limit_px: float, rounds: int) -> None:
    rng = np.random.default_rng(1)
    errors, normalised = [], []
    for _ in range(rounds):
        matched = match_pieces(pieces(rng, 4.0), 0, radius_px)
        assert not any(each.reason for each in matched)
        assert np.all(matched[0].center_px == 0.0)
        for index in (1, 2):
            linear = matched[index].scan_from_patch[:, :2]
            covariance = matched[index].covariance_px2 + linear @ matched[0].covariance_px2 @ linear.T
            error = matched[index].center_px - MAPS[index][:, 2]
            errors.append(error)
            normalised.append(error @ np.linalg.solve(covariance, error) / 2)
    assert np.sqrt(np.mean(np.square(errors))) < limit_px
    assert np.sqrt(np.mean(normalised)) == pytest.approx(1.0, abs=0.15)


def test_clean_pictures_leave_next_to_no_error() -> None:
    matched = match_pieces(pieces(np.random.default_rng(2), 0.0), 0)
    for each, matrix in zip(matched, MAPS, strict=True):
        assert np.abs(each.center_px - matrix[:, 2]).max() < 0.005
        assert np.abs(each.scan_from_patch[:, :2] - matrix[:, :2]).max() < 0.001


def test_bent_ground_moves_the_place_as_its_bending_says() -> None:
    spots = texture(np.random.default_rng(4))
    bending = np.array([0.4, 0.1, 0.3, -0.2, 0.0, -0.1])
    bent = Piece(picture(spots, MAPS[1], bending), (-HALF, -HALF), MAPS[1])
    even = [Piece(picture(spots, matrix), (-HALF, -HALF), matrix) for matrix in (MAPS[0], MAPS[2])]
    found = match_pieces([even[0], bent, even[1]], 0)[1]
    assert found.bending is not None
    off = np.linalg.solve(found.scan_from_patch[:, :2], found.center_px - MAPS[1][:, 2])
    assert np.linalg.norm(off) > 0.05
    assert off == pytest.approx(found.bending.on_place @ bending, abs=0.02)
    shift, _ = found.bending.estimated(np.eye(6))
    assert off == pytest.approx(shift, abs=0.02)


def test_another_picture_stands_out_by_its_variance() -> None:
    rng = np.random.default_rng(3)
    three = pieces(rng, 4.0)
    other = Piece(picture(texture(rng), MAPS[1]), (-HALF, -HALF), MAPS[1])
    matched = match_pieces([three[0], other, three[2]], 0)
    assert any(each.reason for each in matched) or matched[1].variance > 2.0 * matched[2].variance


SLOPE = np.add.outer(np.zeros(55), np.arange(55.0))


@pytest.mark.parametrize(("grey", "words"), [(np.full((55, 55), 7.0), "even"), (SLOPE, "texture")])
def test_what_has_no_texture_is_refused(grey: Array, words: str) -> None:
    matched = match_pieces([Piece(grey, (-HALF, -HALF), matrix) for matrix in (MAPS[0],) * 3], 0)
    assert all(words in each.reason for each in matched)
