"""High correlations in words, against the cofactor matrix itself."""

from dataclasses import replace

import numpy as np
import pytest
from mishaps import MISHAPS, sentences
from setups import CONVERGENT, FREE, Setup, give_values, vertical
from simulated import STATIONS

from adjust.solution.adjustment import adjust

LOW_RELIEF = Setup(vertical(0.0, 0.0, 0.0, 0.0), relief=20.0, prior=1.0)


def test_flying_height_and_principal_distance_are_reported() -> None:
    """With fixed fiducials nothing is taken out: the correlation is that of the cofactor matrix."""
    network, start = LOW_RELIEF.network()
    result = adjust(give_values(network, {"x": 0.0, "y": 0.0}), start)
    first = result.correlations[0]
    assert [each.text for each in first.parameters] == ["IO.K.c", "EO.*.Z0"]
    assert "c of camera K and Z0 of all images are correlated by" in first.cause
    assert "flying height and principal distance are correlated" in first.cause
    assert "tilted in different directions" in first.remedy
    rho = []
    for i in range(4):
        q = result.cofactor_of(["IO.K.c", f"EO.f{i}.Z0"])
        rho.append(q[0, 1] / np.sqrt(q[0, 0] * q[1, 1]))
    assert first.rho == pytest.approx(max(rho, key=abs), rel=1e-9)


def test_the_datum_of_the_fiducials_does_not_hide_a_correlation() -> None:
    """Priors of 1 mm, of 0.1 mm or of 10 mm on fiducials that no image contradicts: the same correlations."""
    network, start = LOW_RELIEF.network()
    found = [
        adjust(give_values(network, {"x": s, "y": s, "c": FREE, "x0": FREE, "y0": FREE}), start).correlations
        for s in (0.1, 1.0, 10.0)
    ]
    assert [each.parameters for each in found[0]] == [each.parameters for each in found[2]]
    for first, second, third in zip(*found, strict=True):
        assert first.rho == pytest.approx(third.rho, abs=1e-4)
        assert second.rho == pytest.approx(third.rho, abs=1e-4)


def test_the_remedy_lowers_the_correlation() -> None:
    """Relief of 500 m, and images tilted by 20 degrees: c and Z0 are no longer told."""
    tilted = replace(LOW_RELIEF, attitudes=CONVERGENT, relief=500.0)
    for setup, result in ((LOW_RELIEF, True), (tilted, False)):
        pairs = [each.parameters[0].text for each in adjust(*setup.network()).correlations]
        assert ("IO.K.c" in pairs) == result


def test_a_wider_field_tells_the_principal_point_from_tilts_and_decentering() -> None:
    text = " ".join(sentences(adjust(*MISHAPS["narrow-field"].network())))
    assert "x0' and p1 of camera K are correlated by" in text
    assert "Targets out to the corners of the frame" in text
    points = np.random.default_rng(4).uniform(-1.0, 1.0, (20, 3)) * [1100.0, 1100.0, 300.0]
    free = {"k3": FREE, "p1": FREE, "p2": FREE}
    wide = Setup(vertical(0.0, 0.0, 0.0, 0.0), prior=10.0, points=points, distortion=free)
    assert adjust(*wide.network()).correlations == ()


def test_a_turn_of_the_camera_about_its_axis_changes_nothing() -> None:
    """Directions are those of the camera: kappa of 90 degrees takes X0 for Y0 and leaves the correlation."""
    one, other = (
        list(adjust(*Setup(vertical(k), STATIONS[:1], 20.0, prior=1.0).network()).correlations)
        for k in (0.0, np.pi / 2)
    )
    by_x0 = [next(each for each in found if each.parameters[0].text == "IO.K.x0") for found in (one, other)]
    assert [each.parameters[1].text for each in by_x0] == ["EO.f0.X0", "EO.f0.Y0"]


def test_powers_of_the_radius_and_decentering_are_reported() -> None:
    setup = Setup(CONVERGENT, prior=1.0, distortion={"k3": FREE, "k5": FREE, "k7": FREE})
    found = adjust(*setup.network()).correlations
    powers = [each for each in found if each.parameters[0].text.startswith("IO.K.k")]
    assert powers
    assert all("neighbouring powers of the radius" in each.cause for each in powers)
    assert all("Compare the curve" in each.remedy for each in powers)


def test_nothing_is_reported_without_a_solution() -> None:
    assert adjust(*Setup(CONVERGENT).network()).correlations == ()
