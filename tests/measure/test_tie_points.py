"""Tie points: multi-image matching, tracks, verification and joins."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from drawn import center
from in_process import Loses
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure.flags import Cause
from measure.tie_points.find_points import Ties
from measure.tie_points.joins import measure_joins
from measure.tie_points.multi_image import RADIUS_PX, SPARE_PX, Piece, match_pieces
from measure.tie_points.tracks import (
    Features,
    TieFrame,
    find_candidates,
    neighbour_outliers,
    tracks_of_pairs,
    verify_pairs,
)

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


@parametrize_with_studies(("radius_px", "limit_px", "rounds"), [(RADIUS_PX, 0.06, 10), (21, 0.035, 30)])
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


@pytest.mark.parametrize(("grey", "words"), [(np.full((55, 55), 7.0), "uniform"), (SLOPE, "texture")])
def test_what_has_no_texture_is_refused(grey: Array, words: str) -> None:
    matched = match_pieces([Piece(grey, (-HALF, -HALF), matrix) for matrix in (MAPS[0],) * 3], 0)
    assert all(words in each.reason for each in matched)


def pairs(*rows: tuple[int, int]) -> np.ndarray:
    return np.array(rows, np.intp).reshape(-1, 2)


def test_a_frame_that_one_pair_alone_shows_is_left_out() -> None:
    shared = {(0, 1): pairs((4, 5)), (0, 2): pairs((4, 6)), (1, 2): pairs((5, 6)), (2, 3): pairs((6, 7))}
    assert tracks_of_pairs(shared) == [{0: 4, 1: 5, 2: 6}]
    chain = {(0, 1): pairs((4, 5)), (1, 2): pairs((5, 6))}
    assert tracks_of_pairs(chain) == []


def test_scans_of_one_exposed_frame_are_one_sight_of_a_point() -> None:
    """Frame a in two scans that overlap, b whole, and c that shows a part of the ground: every candidate is in one scan
    of a, in b and in c. The scans of a are no pair, and a point of theirs that b alone shows has two sights only."""
    rng = np.random.default_rng(4)
    ground = rng.uniform([-300.0, -300.0, 0.0], [300.0, 300.0, 120.0], (400, 3))
    observations = rng.normal(0.0, 1.0, (400, 128))
    frames, features = [], []
    for image, part_of, station, first, end, lower in (
        ("a0", "a", (-60.0, 0.0, 900.0), 0, 700, 0),
        ("a1", "a", (-60.0, 0.0, 900.0), 500, 1200, 0),
        ("b", "", (60.0, 10.0, 920.0), 0, 1200, 0),
        ("c", "", (0.0, 80.0, 890.0), 0, 1200, 500),
    ):
        rays = ground - station
        places = 600.0 + 1300.0 * np.column_stack([rays[:, 0], -rays[:, 1]]) / -rays[:, 2:]
        shown = (places[:, 0] > first) & (places[:, 0] < end) & (places[:, 1] > lower) & (places[:, 1] < 1200)
        places = places[shown] - (first, 0)
        pixel_from_camera = np.array([[100.0, 0.0, 600.0 - first], [0.0, -100.0, 600.0]])
        view = (observations[shown] + rng.normal(0.0, 0.05, (shown.sum(), 128))).astype(np.float32)
        features.append(Features(places, view, np.ones(len(places)), np.ones(len(places)), (end - first, 1200)))
        none = np.zeros((0, 3))
        frames.append(TieFrame(image, Path(f"{image}.tif"), pixel_from_camera, None, none, part_of=part_of))
    assert not any(map(len, verify_pairs(frames, features, Loses(lambda *_: True)).values()))
    shared = verify_pairs(frames, features, None)
    assert set(shared) == {(0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}
    assert min(len(pairs) for pairs in shared.values()) > 40
    found = find_candidates(frames, features, shared, 3)
    sights = [set(candidate.maps) for candidate in found]
    assert all(sight in ({0, 2, 3}, {1, 2, 3}) for sight in sights)
    assert min(sum(k in sight for sight in sights) for k in (0, 1)) > 40
    for candidate in found:  # the scan that shows the place farther inside, unless the other one defines it
        if candidate.reference > 1:
            col = candidate.maps[min(candidate.maps)][0, 2] + 500 * (1 in candidate.maps)
            assert (1 in candidate.maps) == (col > 600) or abs(col - 600) < 5


def view_pairs(rng: np.random.Generator, relief: float, count: int = 200) -> tuple[Array, Array]:
    """Places (count, 2) in two frames of 1500 px, flying along the columns: height moves them along the rows of these,
    by relief px, rms, in hills of some 300 px; 0.1 px of noise."""
    first = rng.uniform(0.0, 1500.0, (count, 2))
    phases = rng.uniform(0.0, 2 * np.pi, 6)
    turns = rng.normal(0.0, 1 / 150.0, (6, 2))
    height = relief * np.sqrt(2 / 6) * np.sin(first @ turns.T + phases).sum(axis=1)
    turned = np.array([[0.0, -1.01], [0.99, 0.0]])
    second = first @ turned.T + [1600.0, -300.0] + np.outer(height, [1.0, 0.0]) + rng.normal(0.0, 0.1, first.shape)
    return first, second


def test_a_false_point_takes_none_of_its_neighbours_with_it() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        first, second = view_pairs(rng, relief=1.0)
        false = np.sort(rng.choice(len(first), 8, replace=False))
        second[false] += rng.choice([-60.0, 60.0, 400.0], (8, 1)) * [1.0, 0.0]
        assert np.flatnonzero(neighbour_outliers(first, second)).tolist() == false.tolist()


def test_hills_are_no_outliers() -> None:
    rng = np.random.default_rng(3)
    alarms = sum(int(neighbour_outliers(*view_pairs(rng, relief)).sum()) for relief in (0, 2, 20) for _ in range(8))
    assert alarms <= 2, "of 4,800 points 0.5 may be"


SIDE, ROWS = 700, 200  # px: of the picture, and of its upper part that is scanned


def picture_joins(blur: float) -> Array:
    """Band-limited noise, whose values between pixels are known: periodic, by its spectrum."""
    rng = np.random.default_rng(2)
    spectrum = np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
    frequencies = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None])
    return np.asarray(np.fft.irfft2(spectrum * np.exp(-2.0 * (np.pi * blur * frequencies) ** 2), s=(SIDE, SIDE)))


def shifted(grey: Array, col: float, row: float) -> Array:
    """The picture moved right and down, exactly."""
    turn = np.exp(-2j * np.pi * (np.fft.fftfreq(SIDE)[:, None] * row + np.fft.rfftfreq(SIDE)[None] * col))
    return np.asarray(np.fft.irfft2(np.fft.rfft2(grey) * turn, s=(SIDE, SIDE)))


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[TieFrame], Array]:
    """The left and the right part of a picture, the right one moved by a broken number of pixels, and how far."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("scans")
    grey = picture_joins(1.2)
    grey = 30000.0 + 6000.0 * grey / grey.std()
    first, move = 230, np.array([0.37, -0.61])
    scans = {"a": grey[:ROWS, :480], "b": shifted(grey, *move)[:ROWS, first:]}
    parts = []
    for name, part in scans.items():
        stored = np.clip(np.rint(part + rng.normal(0.0, 500.0, part.shape)), 0, 65535).astype(np.uint16)
        tifffile.imwrite(folder / f"{name}.tif", stored)
        parts.append(TieFrame(name, folder / f"{name}.tif", np.eye(2, 3), None, np.zeros((0, 3))))
    return parts, move - (first, 0)


def off_and_sigma(joins: Ties, move: Array) -> tuple[Array, Array]:
    pairs = zip(joins.marks["a"], joins.marks["b"], strict=True)
    off, variance = [], []
    for one, other in pairs:
        assert one.covariance_px2 is not None
        assert other.covariance_px2 is not None
        off.append(center(other) - center(one) - move)
        variance.append(np.trace(one.covariance_px2 + other.covariance_px2) / 2.0)
    return np.array(off), np.sqrt(np.array(variance))[:, None]


def test_marks_that_are_known_are_no_joins(scanned: tuple[list[TieFrame], Array]) -> None:
    (first, second), move = scanned
    taken = np.array([[300.0, 110.0, 60.0]])
    joins = measure_joins([replace(first, taken_px=taken), second], 8)
    off, sigma = off_and_sigma(joins, move)
    assert len(off) == 8
    assert (np.abs(off) < 3.5 * sigma).all()
    for mark in joins.marks["a"]:
        assert mark.covariance
        assert mark.covariance.sigmas_px[Cause.INTERPOLATION] == 0.01
        assert np.hypot(*(center(mark) - (300.0, 110.0))) > 60.0


def test_a_worker_that_is_ended_over_a_place_costs_no_other_join(scanned: tuple[list[TieFrame], Array]) -> None:
    lost = list[object]()

    def is_deadly(_: object, args: tuple[Any, ...]) -> bool:
        matched = args[1] if getattr(args[0], "func", None) is match_pieces else []
        lost[:] = lost or matched[:1]
        return any(each is lost[0] for each in matched)

    parts, _ = scanned
    alone, joins = measure_joins(parts, 4), measure_joins(parts, 4, Loses(is_deadly))
    assert lost
    found, expected = ({tuple(np.asarray(mark.center_px)) for mark in each.marks["a"]} for each in (joins, alone))
    assert len(found) == 4
    assert len(found & expected) == 3


def test_a_scan_that_cannot_be_read_costs_the_other_nothing(
    scanned: tuple[list[TieFrame], Array], tmp_path: Path
) -> None:
    (tmp_path / "b.tif").write_bytes(b"no picture")
    (first, second), _ = scanned
    joins = measure_joins([first, replace(second, scan=tmp_path / "b.tif")])
    assert "It is not joined to the other scans of its frame" in joins.problems["b"][0]
