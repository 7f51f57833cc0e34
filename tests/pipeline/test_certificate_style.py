"""The report's certificate: the same lens as a certificate would print it, with standard deviations that hold."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from pipeline.exchange.certificate import fit, read_certificate
from pipeline.report.lens import ANGLES_DEG, certificate

C, K3, K5 = 153.02, 2.0e-8, -1.5e-12
NAMES = parameter_names("torlegard")
SIGMAS = {"c": 0.01, "k3": 4e-9, "k5": 3e-13}
LENS = Lens(
    Distortion("torlegard"),
    np.array([C, 0.1, -0.2]),
    np.array([{"k3": K3, "k5": K5, "p1": 3e-7}.get(name, 0.0) for name in NAMES]),
    np.diag([SIGMAS.get(name, 0.0) ** 2 for name in ("c", "x0", "y0", *NAMES)]),
)
REACH_MM = 140.0


def distortion_um(c: float, angle_deg: Any, lens: tuple[float, float, float] = (C, K3, K5)) -> Any:
    """By fixed-point iteration, of the lens at angles against c."""
    equivalent, k3, k5 = lens
    tangent = np.tan(np.radians(angle_deg))
    r = equivalent * tangent
    for _ in range(20):
        r = equivalent * tangent + k3 * r**3 + k5 * r**5
    return 1000.0 * (r - c * tangent)


def balanced(lens: tuple[float, float, float]) -> float:
    """By bisection over a dense table."""
    largest = REACH_MM - lens[1] * REACH_MM**3 - lens[2] * REACH_MM**5
    angles = np.degrees(np.arctan(np.linspace(0.0, largest / lens[0], 800)))
    own = distortion_um(0.0, angles, lens)
    low, high = lens[0] - 1.0, lens[0] + 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        off = own - 1000.0 * middle * np.tan(np.radians(angles))
        low, high = (middle, high) if off.max() + off.min() > 0.0 else (low, middle)
    return (low + high) / 2.0


def test_the_table_is_that_of_the_lens() -> None:
    view = certificate(LENS, REACH_MM)
    calibrated = balanced((C, K3, K5))
    assert view.calibrated[0] == pytest.approx(calibrated, abs=2e-5)
    assert view.equivalent[0] == pytest.approx(C, abs=2e-5)
    assert view.equivalent[1] == pytest.approx(SIGMAS["c"], rel=0.05)
    assert [row.angle_deg for row in view.rows] == list(ANGLES_DEG)
    for row in view.rows:
        there = distortion_um(calibrated, row.angle_deg)
        assert row.radial[0] == pytest.approx(there, abs=0.01)


def test_its_standard_deviations_are_those_of_lenses_drawn_at_random() -> None:
    rng = np.random.default_rng(2)
    drawn = [rng.normal((C, K3, K5), list(SIGMAS.values())) for _ in range(300)]
    view = certificate(LENS, REACH_MM)
    distances = [balanced((float(c), float(k3), float(k5))) for c, k3, k5 in drawn]
    assert view.calibrated[1] == pytest.approx(np.std(distances), rel=0.15)
    for row in view.rows[1:]:
        angle = row.angle_deg
        values = [
            distortion_um(own, angle, (float(c), float(k3), float(k5)))
            for own, (c, k3, k5) in zip(distances, drawn, strict=True)
        ]
        assert row.radial[1] == pytest.approx(np.std(values), rel=0.2)


@pytest.mark.parametrize(
    ("c", "k3", "k5", "reach_mm"), [(C, K3, K5, REACH_MM), (60.3344, -5.991e-6, 1.995e-9, 33.0), (210.4, K3, K5, 155.0)]
)
def test_the_printed_table_gives_the_lens_back(tmp_path: Path, c: float, k3: float, k5: float, reach_mm: float) -> None:
    """Typed as a certificate, the camera comes out again, to the tenths of a micrometre that are printed."""
    powers = np.array([{"k3": k3, "k5": k5}.get(name, 0.0) for name in NAMES])
    lens = replace(LENS, interior=np.array([c, 0.0, 0.0]), parameters=powers, covariance=1e-4 * LENS.covariance)
    view = certificate(lens, reach_mm)
    (tmp_path / "c.toml").write_text(
        f"calibrated_principal_distance_mm = {view.calibrated[0]:.4f}\n"
        f"angle_deg = {[row.angle_deg for row in view.rows]}\n"
        f"radial_um = {[round(row.radial[0], 1) for row in view.rows]}\n",
        encoding="utf-8",
    )
    fitted = fit(read_certificate(tmp_path / "c.toml"))
    assert fitted.equivalent_mm == pytest.approx(c, abs=0.002)
    at = np.linspace(0.2, 1.0, 5) * reach_mm
    gone = (fitted.equivalent_mm - c) * at / c + (fitted.coefficients[0] - k3) * at**3
    gone += (fitted.coefficients[1] - k5) * at**5 + fitted.coefficients[2] * at**7
    assert np.abs(gone).max() < 0.001


def test_a_narrow_camera_has_angles_of_its_own() -> None:
    view = certificate(replace(LENS, interior=np.array([600.0, 0.0, 0.0])), 140.0)
    angles = [row.angle_deg for row in view.rows]
    assert len(angles) == 6
    assert angles[-1] == pytest.approx(np.degrees(np.arctan(140.0 / 600.0)), abs=0.1)


def test_the_report_shows_it(finished: tuple[Path, int]) -> None:
    text = (finished[0] / "out" / "report.html").read_text(encoding="utf-8")
    assert "The calibrated principal distance" in text
