"""A published self-calibration of a strong lens: four known points, ninety-six unknown ones, no approximations.

The camera calibration demo of the Damped Bundle Adjustment Toolbox (Börlin and Grussenmeyer 2013), 21 images of a sheet
of circular targets. That program corrects the measured points and adjusts the corrected ones, which is the adjustment
by elements; its aspect parameter scales x before the correction, so that b1 does the same once x has its pixel size,
and its principal point is that before the scale. The strict model, in which the lens's 8 % of distortion changes the
weights of the measured points, differs by some tenths of a sigma.
"""

from pathlib import Path

import numpy as np
import pytest
from real_data import DATA, needs

from adjust.functional_model.lens import Distortion, Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import Options, adjust

FOLDER = DATA / "coded" / "camcal" / "camcaldemo"
pytestmark = needs("coded", "camcal", "camcaldemo")

PIXEL_MM = np.array([5.43764 / 1704 * 1.000389598, 5.43764 / 1704])
SIGMA_PX = 0.1
PUBLISHED = {  # value and standard deviation; brown's signs are the opposite of that program's
    "c": (7.457, 0.00105),
    "x0": (3.61546 * 1.000389598, 0.00082),
    "y0": (-2.61329, 0.00098),
    "k1": (-4.58861e-3, 2.21e-5),
    "k2": (4.51351e-5, 2.65e-6),
    "k3": (2.05253e-6, 1.01e-7),
    "p1": (6.12803e-5, 3.52e-6),
    "p2": (4.41172e-5, 3.94e-6),
}


@pytest.fixture(scope="module")
def network() -> Network:
    return network_of_demo()


def network_of_demo() -> Network:
    known = {row[0]: [float(value) for value in row[2:5]] for row in table(FOLDER / "reference" / "camcal-fixed.txt")}
    marks = table(FOLDER / "measurements" / "markpts.txt")
    images, points = [row[0] for row in marks], [row[1] for row in marks]
    kinds: list[ObservationKind] = ["target"] * len(marks)
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "k3", "p1", "p2", "b1")}
    return Network(
        (Camera("C4040Z", None, None, None, Distortion("brown", free), center_mm=(3.6265, -2.7188)),),
        tuple(Image(name, "C4040Z", "none") for name in sorted(set(images))),
        tuple(ObjectPoint(p, *(Prior(v) for v in known[p])) if p in known else unknown(p) for p in sorted(set(points))),
        Observations(
            tuple(images),
            tuple(points),
            tuple(kinds),
            np.array([[float(row[2]), -float(row[3])] for row in marks]) * PIXEL_MM,
            np.tile((SIGMA_PX * PIXEL_MM[1]) ** 2 * np.eye(2), (len(marks), 1, 1)),
        ),
    )


def unknown(point: str) -> ObjectPoint:
    return ObjectPoint(point, None, None, None)


def table(file: Path) -> list[list[str]]:
    lines = file.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.split(",")] for line in lines if line.strip() and not line.startswith("#")]


@pytest.mark.study  # tests/pipeline/test_published_numbers.py finds the same from files
def test_the_published_result_is_found_from_nothing(network: Network) -> None:
    """By elements: each parameter to a tenth of its sigma, each sigma to half a percent, sigma0 to its last digit."""
    adjustment = adjust(network, approximate(network), Options(method="elements"))
    assert adjustment.converged
    assert adjustment.redundancy == 3725
    assert adjustment.sigma0 * SIGMA_PX == pytest.approx(0.16148, abs=1e-5)
    for name, (value, sigma) in PUBLISHED.items():
        assert abs(adjustment.value(f"IO.C4040Z.{name}") - value) < 0.1 * sigma, name
        assert adjustment.sigma(f"IO.C4040Z.{name}") == pytest.approx(sigma, rel=0.005), name


@pytest.mark.study
def test_the_strict_model_is_near_it(network: Network) -> None:
    adjustment = adjust(network, approximate(network))
    assert adjustment.converged
    assert adjustment.redundancy == 3725
    assert adjustment.sigma0 * SIGMA_PX == pytest.approx(0.1555, abs=2e-4)
    for name, (value, sigma) in PUBLISHED.items():
        assert abs(adjustment.value(f"IO.C4040Z.{name}") - value) < 0.5 * sigma, name
        assert adjustment.sigma(f"IO.C4040Z.{name}") == pytest.approx(sigma, rel=0.03), name
