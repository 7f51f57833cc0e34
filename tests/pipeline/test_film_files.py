"""Film transformations through the user's files: their spelling, and networks on films of every kind."""

import json
from pathlib import Path

import numpy as np
import pytest
from networks import Truth, field_points, film_parameters, simulated
from studies import parametrize_with_studies

from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import Network, Transformation
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.project_file import read_project

SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


@parametrize_with_studies(
    "kind", ["congruent", "projective", "bilinear", "conformal(2)", "polynomial(2)"], quick=(0, 1)
)
def test_films_of_every_kind_are_adjusted_from_files(kind: Transformation, tmp_path: Path) -> None:
    points = field_points(np.random.default_rng(7), 16)
    network, _ = simulated(np.random.default_rng(4), SCANS, kind, points)
    write_project(network, kind, tmp_path)
    assert run(["adjust", str(tmp_path / "project.toml")]) == (1 if kind == "polynomial(2)" else 0)  # too few marks
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert result["converged"]
    for i in range(4):
        film = result["images"][f"f{i}"]["transformation"]
        assert film["kind"] == kind
        assert film["mirrored"] == (i == 1)
        for name, truth in zip(film_parameter_names(kind), film_parameters(SCANS, i, kind), strict=True):
            found, expected = (film["angle_deg"], np.degrees(truth)) if name == "angle" else (film[name], truth)
            off = (found["value"] - expected + 180.0) % 360.0 - 180.0 if name == "angle" else found["value"] - expected
            assert abs(off) <= 5.0 * found["sigma"]
    assert run(["check", str(tmp_path / "project.toml")]) in (0, 1)
    assert run(["report", str(tmp_path / "project.toml")]) in (0, 1)


@pytest.mark.parametrize(
    ("spelling", "words"),
    [
        ("afine", ['no transformation "afine"', "possible are none, congruent, similarity, affine, projective"]),
        ("polynomial", ["lacks its order", 'as in "polynomial(2)"']),
        ("conformal(9)", ["order must be from 1 to 5"]),
    ],
)
def test_a_wrong_transformation_is_reported_with_its_line(spelling: str, words: list[str], tmp_path: Path) -> None:
    network, _ = simulated(np.random.default_rng(4), noise=False)
    write_project(network, spelling, tmp_path)
    with pytest.raises(InputError) as caught:
        read_project(tmp_path / "project.toml")
    for word in ["project.toml, line 5: [adjust] transformation", *words]:
        assert word in str(caught.value)


def write_project(network: Network, kind: Transformation, folder: Path) -> None:
    """The network as a user would write it."""
    camera = network.cameras[0]
    marks = [
        f'[[fiducial]]\nid = "{id_}"\nxy_mm = [{mark.x_mm.value!r}, {mark.y_mm.value!r}]\nsigma_mm = 1.0'
        for id_, mark in camera.fiducials.items()
    ]
    interior = [prior.value for prior in (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm) if prior]
    values = [f"{name} = {prior.value!r}" for name, prior in camera.distortion.parameters.items()]
    lines = [
        'name = "K"\nframe_mm = [228.0, 228.0]',
        f"principal_distance_mm = {interior[0]!r}\nprincipal_point_mm = {interior[1:]}",
        "[sigma]\nprincipal_distance_mm = 1.0\nprincipal_point_mm = 1.0",
        '[distortion]\nfamily = "torlegard"\n[distortion.value]',
        *values,
        *marks,
    ]
    (folder / "camera.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = ["point,X,Y,Z,sX,sY,sZ"]
    rows += [
        ",".join([point.id, *(repr(q.value) for q in (point.X, point.Y, point.Z) if q), "0,0,0"])
        for point in network.points
    ]
    (folder / "points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    observed = network.observations
    sigmas = np.sqrt(np.diagonal(observed.covariance_mm2, axis1=1, axis2=2))
    for *names, xy, sigma in zip(
        observed.image, observed.point, observed.kind, observed.xy_mm.tolist(), sigmas.tolist(), strict=True
    ):
        rows.append(",".join([*names, *map(repr, xy), *map(repr, sigma)]))
    (folder / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "project.toml").write_text(
        f'camera = "camera.toml"\n[object]\npoints = "points.csv"\n[adjust]\ntransformation = "{kind}"\n',
        encoding="utf-8",
    )
