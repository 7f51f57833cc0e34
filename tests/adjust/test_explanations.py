"""What makes sigma0 too large is named, and nothing else is blamed; what no photograph shows is named too."""

from dataclasses import replace

import numpy as np
import pytest
from misfits import KINDS, NOTHING, Effects, Kind, describe, draw_network, network, outcome, scene
from simulated import with_errors

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Network
from adjust.solution.adjustment import adjust

QUICK = ("lens: no radial term", "mm for m, stations in m", "noise too small")
SOUND = KINDS[NOTHING]


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.study) for name in KINDS]
)
def test_what_the_model_lacks_is_named(name: str) -> None:
    sentences, _ = describe(draw_network(name, 4))
    assert outcome(name, sentences) == "named", sentences


@pytest.mark.study
@pytest.mark.parametrize("name", list(KINDS))
def test_what_the_model_of_a_deep_field_lacks_is_named(name: str) -> None:
    sentences, _ = describe(draw_network(name, 5))
    assert outcome(name, sentences) == "named", sentences


def test_figures_are_those_that_were_planted() -> None:
    made = scene(6, flat=True)
    kind = KINDS["pixels not square"]
    result = adjust(network(made, Effects(b1=2e-3), kind, np.random.default_rng(1)))
    (found,) = result.explanations
    ratio = float(found.cause.split("their width is ")[1].split(" ")[0])
    assert ratio == pytest.approx(1.0 / 1.002, abs=3e-4)  # marks stand farther apart in x: a pixel's width is less
    assert found.sigma0[0] == pytest.approx(result.sigma0)
    assert found.sigma0[1] == pytest.approx(1.0, abs=0.1)
    assert found.p < 1e-6


def test_standard_deviations_of_figures_grow_with_the_noise_that_is_left() -> None:
    made, kind = scene(6, flat=True), KINDS["pixels not square"]
    sigmas = []
    for noise in (1.0, 2.0):
        result = adjust(network(made, Effects(b1=5e-3, noise=noise), kind, np.random.default_rng(1)))
        found = result.explanations[0]
        sigmas.append(float(found.cause.split(" ± ")[1].split(" ")[0]))
    assert sigmas[1] / sigmas[0] == pytest.approx(2.0, rel=0.1)


@pytest.mark.study
def test_gross_errors_of_single_marks_are_no_fault_of_the_model() -> None:
    given = network(scene(6, flat=True), Effects(), SOUND, np.random.default_rng(1))
    result = adjust(with_errors(given, dict.fromkeys((3, 40, 90), np.array([0.05, -0.04]))))
    assert result.explanations == ()
    assert len(result.suspects) == 3


def sound(frame_mm: tuple[float, float] = (12.8, 9.6), seed: int = 6) -> Network:
    given = network(scene(seed, flat=True), Effects(), SOUND, np.random.default_rng(1))
    return replace(given, cameras=(replace(given.cameras[0], frame_mm=frame_mm),))


@pytest.mark.study
def test_a_sound_network_has_nothing_implausible() -> None:
    assert describe(sound())[0] == []


@pytest.mark.study
def test_a_board_that_is_transparent_shows_from_both_sides() -> None:
    kind = replace(KINDS["one image mirrored, frame_mm"])
    given = network(scene(6, flat=True), Effects(mirrored=True), kind, np.random.default_rng(1))
    (finding,) = adjust(given).misread
    assert "is mirrored" in finding
    assert "With it mirrored, all stations lie on one side" in finding
    assert adjust(replace(given, transparent=True)).misread == ()


@pytest.mark.study
def test_marks_outside_the_picture_are_named() -> None:
    given = sound()
    assert any("marks lie outside the picture" in each for each in describe(sound((10.0, 9.6)))[0])
    centered = given.observations.xy_mm - [6.4, -4.8]
    camera = replace(given.cameras[0], center_mm=(0.0, 0.0))
    moved = replace(given, cameras=(camera,), observations=replace(given.observations, xy_mm=centered))
    assert describe(moved)[0] == []  # coordinates that count from the middle of the picture


@pytest.mark.study
@pytest.mark.parametrize(
    ("given_mm", "words"),
    [((6.4, -4.8), ""), ((6.9, -4.8), "from (6.9, -4.8) ± (0.05, 0.05)"), ((6.4, 4.8), "The sign of y looks wrong")],
)
def test_a_principal_point_far_from_where_it_is_given_is_named(given_mm: tuple[float, float], words: str) -> None:
    given = sound()
    x0, y0 = (Prior(value + 0.0, 0.2 if not words else 0.05) for value in given_mm)
    sentences, _ = describe(replace(given, cameras=(replace(given.cameras[0], x0_mm=x0, y0_mm=y0),)))
    named = [each for each in sentences if "principal point" in each.lower() and words in each]
    assert bool(named) == bool(words), sentences


@pytest.mark.study
def test_a_principal_point_outside_the_picture_is_named() -> None:
    """The picture is cut from the left part of the sensor's: its size says where it ends."""
    given = sound()
    kept = given.observations.only(np.flatnonzero(given.observations.xy_mm[:, 0] < 5.5))
    camera = replace(given.cameras[0], frame_mm=(5.6, 9.6))
    sentences, _ = describe(replace(given, observations=kept, cameras=(camera,)))
    assert any("outside the picture (x from 0 to 5.6" in each for each in sentences), sentences


@pytest.mark.study
def test_images_that_point_straight_at_a_board_are_named() -> None:
    made = scene(6, flat=True)
    count = len(made.rotations)
    stations = np.column_stack([made.stations[:, :2] * 0.1 + 60.0, 330.0 + 20.0 * np.arange(count)])
    straight = replace(made, rotations=np.tile(np.eye(3), (count, 1, 1)), stations=stations)
    with pytest.raises(AdjustmentError, match="look straight at a flat field"):
        adjust(network(straight, Effects(), Kind(lambda e: Effects(), ()), np.random.default_rng(1)))


@pytest.mark.study
def test_derivatives_of_cameras_with_different_families() -> None:
    """What only one of them has, the other has no derivative by."""
    given = network(scene(4, flat=True), Effects(), SOUND, np.random.default_rng(1))
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "s1")}
    first = replace(given.cameras[0], distortion=Distortion("opencv", free))
    second = replace(given.cameras[0], name="other", distortion=Distortion("brown", {"k1": Prior(0.0, np.inf)}))
    images = tuple(replace(image, camera="other") if i % 2 else image for i, image in enumerate(given.images))
    assert adjust(replace(given, cameras=(first, second), images=images)).converged
