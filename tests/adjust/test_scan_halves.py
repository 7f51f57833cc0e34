"""Frames that were scanned in two overlapping halves: one adjustment with two films and what joins them."""

from dataclasses import replace

import numpy as np
import pytest
from halves import JOIN_SIGMA, Halves, drop_images, halves

from adjust import Adjustment, AdjustmentError, Options, adjust
from adjust.problem.network import Network


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


@pytest.mark.study
def test_errors_are_as_large_as_the_standard_deviations_say() -> None:
    collected: dict[str, list[np.ndarray]] = {}
    for seed in range(16):
        simulated = halves(np.random.default_rng(seed), join_count=12, turned=seed % 2 == 1)
        adjustment = adjust(simulated.network)
        assert adjustment.converged
        for name, each in errors(simulated, adjustment).items():
            collected.setdefault(name, []).append(each)
    joins, orientations = (np.sqrt(np.mean(np.concatenate(each) ** 2)) for each in collected.values())
    assert 0.93 < joins < 1.07
    assert 0.85 < orientations < 1.15  # the elements of one network have the same c and principal point in them


def test_half_the_marks_in_each_scan_suffice_where_joins_say_how_they_lie() -> None:
    """Two corner marks in either half determine no affine film by themselves."""
    simulated = halves(np.random.default_rng(3), join_count=25)
    shown = {
        image.name: sum(
            name == image.name and kind == "fiducial"
            for name, kind in zip(
                simulated.network.observations.image, simulated.network.observations.kind, strict=True
            )
        )
        for image in simulated.network.images
    }
    assert set(shown.values()) == {3}  # two corners, and the mark in the middle of a side that both show
    adjustment = adjust(simulated.network)
    for image in simulated.network.images:
        for id_, mark in simulated.network.camera_by_name["K"].fiducials.items():
            film, true = (
                np.array([adjustment.value(f"T.{image.name}.{name}") for name in ("a1", "a2", "a3", "b1", "b2", "b3")]),
                simulated.films[image.name],
            )
            xy = np.array([mark.x_mm.value, mark.y_mm.value])
            place = np.linalg.solve(np.array([true[1:3], true[4:]]), xy - true[[0, 3]])
            off = np.array([film[1:3], film[4:]]) @ place + film[[0, 3]] - xy
            assert np.linalg.norm(off) < 0.05, (image.name, id_)


def test_frames_without_any_target_are_joined_too() -> None:
    simulated = halves(np.random.default_rng(4))
    adjustment = adjust(replace(drop_images(simulated.network, "target"), points=()))
    assert adjustment.converged
    assert adjustment.groups["join"].redundancy > 50.0
    assert 0.8 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.2


def test_points_as_blocks_give_what_frames_as_blocks_give() -> None:
    """With many unknown points these are eliminated first, and the frames' unknowns are what they share."""
    simulated = halves(np.random.default_rng(5), join_count=5, targets=120)
    points = tuple(
        point if i < 6 else replace(point, **{axis: replace(getattr(point, axis), sigma=np.inf) for axis in "XYZ"})
        for i, point in enumerate(simulated.network.points)
    )
    network = replace(simulated.network, points=points)
    adjustment = adjust(network)
    assert 0.9 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.25
    assert 0.9 < adjustment.sigma0 < 1.1
    # A weight that hardly binds leaves known points what they are, and frames are the blocks.
    loose = replace(
        network,
        points=tuple(
            replace(p, **{a: replace(getattr(p, a), sigma=0.0) for a in "XYZ"}) if i < 6 else p
            for i, p in enumerate(points)
        ),
    )
    assert adjust(loose).value("T.f0.left.a2") == pytest.approx(adjustment.value("T.f0.left.a2"), abs=1e-9)


def test_the_order_of_scans_and_marks_changes_nothing() -> None:
    simulated = halves(np.random.default_rng(6))
    network = simulated.network
    order = np.random.default_rng(0).permutation(len(network.observations))
    shuffled = replace(network, images=network.images[::-1], observations=network.observations.only(order))
    first, second = adjust(network), adjust(shuffled)
    for name in ("IO.K.c", "EO.f1.Z0", "JOIN.f2.j3.x", "T.f3.right.a3"):
        assert second.value(name) == pytest.approx(first.value(name), rel=1e-8, abs=1e-8)
        assert second.sigma(name) == pytest.approx(first.sigma(name), rel=1e-6)


def test_a_gross_error_of_a_join_is_found_and_named() -> None:
    simulated = halves(np.random.default_rng(7))
    network = simulated.network
    xy_mm = network.observations.xy_mm.copy()
    row = next(
        row
        for row, key in enumerate(zip(network.observations.image, network.observations.point, strict=True))
        if key == ("f1.right", "j4")
    )
    xy_mm[row] += 20.0 * JOIN_SIGMA
    adjustment = adjust(
        replace(network, observations=replace(network.observations, xy_mm=xy_mm)), options=Options(snooping=True)
    )
    (found,) = adjustment.suspects
    assert found.tested.name in ("join j4 in image f1.right", "join j4 in image f1.left")


def test_joins_have_a_variance_component_of_their_own() -> None:
    simulated = halves(np.random.default_rng(8), join_count=40)
    observations = simulated.network.observations
    loose = np.array([16.0 if kind == "join" else 1.0 for kind in observations.kind])[:, None, None]
    network = replace(
        simulated.network,
        observations=replace(observations, covariance_mm2=observations.covariance_mm2 * loose),
    )
    factors = adjust(network, options=Options(variance_components=True)).variance_factors
    assert factors["join"] == pytest.approx(1.0 / 16.0, rel=0.3)


def part(network: Network, keep: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> Network:
    return replace(network, observations=network.observations.only(np.flatnonzero(keep)))


def test_scans_without_anything_in_common_are_refused() -> None:
    network = drop_images(halves(np.random.default_rng(9)).network, "join")
    shared = np.array([point == "5" for point in network.observations.point])  # the mark that both halves show
    targets = np.array([kind == "target" for kind in network.observations.kind])
    with pytest.raises(AdjustmentError, match=r"frame f0: its scan f0.right has 0 points in common with f0.left"):
        adjust(part(network, ~shared & ~targets))


def test_a_join_of_one_scan_is_refused() -> None:
    network = halves(np.random.default_rng(10)).network
    keys = zip(network.observations.image, network.observations.point, strict=True)
    with pytest.raises(AdjustmentError, match=r"join j3 is observed in one scan of frame f0 only"):
        adjust(part(network, np.array([key != ("f0.left", "j3") for key in keys])))


def test_halves_of_different_cameras_are_refused() -> None:
    network = halves(np.random.default_rng(11)).network
    images = (replace(network.images[0], transformation="projective"), *network.images[1:])
    with pytest.raises(AdjustmentError, match=r"frame f0: its scans f0.left and f0.right differ"):
        adjust(replace(network, images=images))


def test_a_film_that_nothing_determines_is_named_with_its_frame() -> None:
    """All joins on one line, no mark in the right half: it can stretch across the line."""
    simulated = halves(np.random.default_rng(13), join_count=8, overlap_mm=1e-12, join_sigma=1e-12)
    network = drop_images(simulated.network, "target")
    observations = network.observations
    rows = zip(observations.image, observations.kind, strict=True)
    few = part(network, np.array([not (kind == "fiducial" and image == "f0.right") for image, kind in rows]))
    adjustment = adjust(replace(few, points=()))
    assert not adjustment.converged
    assert any("f0" in each.cause and "scans" in each.cause for each in adjustment.singular), adjustment.singular
