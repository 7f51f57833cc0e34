"""An industrial bundle with a fixed second zero r0 against its published result: 115 images, 150 unknown points.

    python -m benchmarks industrial_bundle FOLDER

FOLDER holds example.ior, .eor, .obc, .phc and .scale of JAICOV (github.com/applied-geodesy/bundle-adjustment, folder
JAICOV/example), which are those of AICON 3D Studio; its own protocol, example.htm, has the published figures below.
The images are of one camera, with no control but one distance; c is negative in these files. Takes half a minute.
"""

import sys
from pathlib import Path

import numpy as np

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Image, Network, ObjectPoint
from adjust.problem.observations import Distance, ObservationKind, Observations
from adjust.solution.adjustment import Options, adjust

SIGMA_MM = 0.0005
PUBLISHED = {  # value and standard deviation
    "c": (28.78507, 2.513178e-4),
    "x0": (1.734892e-2, 3.441658e-4),
    "y0": (5.668731e-2, 3.262600e-4),
    "a1": (-1.096069e-4, 2.978787e-8),
    "a2": (1.495660e-7, 7.655524e-11),
    "b1": (5.798428e-6, 1.190972e-7),
    "b2": (-8.644540e-6, 1.043919e-7),
}
PUBLISHED_SIGMA0_MM, PUBLISHED_REDUNDANCY = 0.000405, 18804


def table(folder: Path, ending: str) -> list[list[str]]:
    lines = (folder / f"example.{ending}").read_text(encoding="utf-8", errors="replace").splitlines()
    return [line.split() for line in lines if line.strip() and not line.startswith("#")]


def network_of(folder: Path, family: str) -> tuple[Network, Approximations]:
    first, (a3,), (b1, b2), (c1, c2), *_ = [[float(word) for word in row] for row in table(folder, "ior")]
    _, _, minus_c, x0, y0, a1, a2, r0 = first
    places = {row[0]: np.array(row[1:4], dtype=float) for row in table(folder, "obc")}
    rows = [row for row in table(folder, "phc") if int(row[9]) > 0 and row[1] in places]
    seen = [row[1] for row in rows]
    rows = [row for row in rows if seen.count(row[1]) > 1]
    stations = {row[0]: np.array(row[2:8], dtype=float) for row in table(folder, "eor")}
    points = sorted({row[1] for row in rows})
    values = {"a1": a1, "a2": a2, "a3": a3, "b1": b1, "b2": b2, "c1": c1, "c2": c2}
    given = {name: Prior(value, np.inf if name in PUBLISHED else 0.0) for name, value in values.items()}
    interior = Prior(-minus_c, np.inf), Prior(x0, np.inf), Prior(y0, np.inf)
    camera = Camera("C", *interior, Distortion(family, given, r0_mm=r0))
    kinds: list[ObservationKind] = ["target"] * len(rows)
    network = Network(
        (camera,),
        tuple(Image(name, "C", "none") for name in stations),
        tuple(ObjectPoint(point, None, None, None) for point in points),
        Observations(
            tuple(row[0] for row in rows),
            tuple(row[1] for row in rows),
            tuple(kinds),
            np.array([row[2:4] for row in rows], dtype=float),
            np.tile(SIGMA_MM**2 * np.eye(2), (len(rows), 1, 1)),
        ),
        distances=tuple(Distance(bar[2], bar[3], float(bar[4]), float(bar[5])) for bar in table(folder, "scale")),
    )
    start = Approximations({"C": np.array([-minus_c, x0, y0])}, stations, {}, {name: places[name] for name in points})
    return network, start


def main() -> None:
    folder = Path(sys.argv[1])
    network, start = network_of(folder, "aicon")
    found = adjust(network, start, Options(datum="free"))
    print(f"{network}: converged {found.converged}, redundancy {found.redundancy} (published {PUBLISHED_REDUNDANCY})")
    print(f"sigma0 {SIGMA_MM * found.sigma0:.6f} mm (published {PUBLISHED_SIGMA0_MM:.6f})\n")
    print(
        "| | published | its sigma | here | differs by, sigmas | sigma here over published |\n|---|---|---|---|---|---|"
    )
    for name, (value, sigma) in PUBLISHED.items():
        here, own = found.value(f"IO.C.{name}"), found.sigma(f"IO.C.{name}")
        print(f"| {name} | {value:.7g} | {sigma:.3g} | {here:.7g} | {(here - value) / sigma:.3f} | {own / sigma:.4f} |")


if __name__ == "__main__":
    main()
