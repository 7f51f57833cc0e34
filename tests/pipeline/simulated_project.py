"""A simulated network as the files a user would write."""

from pathlib import Path

import numpy as np

from adjust.functional_model.lens import Prior
from adjust.problem.network import Network


def write_project(network: Network, folder: Path) -> Path:
    """camera.toml, points.csv, comparator.csv and project.toml; the path of the last."""
    camera, points, observed = network.cameras[0], network.points, network.observations
    c, x0, y0 = camera.principal_distance_mm, camera.x0_mm, camera.y0_mm
    assert c is not None
    assert x0 is not None
    assert y0 is not None
    given = camera.distortion.parameters
    lines = [
        f'name = "{camera.name}"',
        "frame_mm = [228.0, 228.0]",
        f"principal_distance_mm = {c.value!r}",
        f"principal_point_mm = [{x0.value!r}, {y0.value!r}]",
        "[sigma]",
        f"principal_distance_mm = {sigma(c)}",
        f"principal_point_mm = [{sigma(x0)}, {sigma(y0)}]",
        "[distortion]",
        f'family = "{camera.distortion.family}"',
        f"r0_dm = {camera.distortion.r0_mm / 100.0!r}"
        if camera.distortion.family == "juhl"
        else f"r0_mm = {camera.distortion.r0_mm!r}",
        "[distortion.value]",
        *(f"{name} = {prior.value!r}" for name, prior in given.items()),
        "[distortion.sigma]",
        *(f"{name} = {sigma(prior)}" for name, prior in given.items()),
    ]
    for id, mark in camera.fiducials.items():
        x, y = mark.x_mm, mark.y_mm
        lines += ["[[fiducial]]", f'id = "{id}"', f"xy_mm = [{x.value!r}, {y.value!r}]"]
        lines.append(f"sigma_mm = [{sigma(x)}, {sigma(y)}]")
    (folder / "camera.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = ["point,X,Y,Z,sX,sY,sZ"]
    for point in points:
        axes = [axis for axis in (point.X, point.Y, point.Z) if axis is not None]
        rows.append(",".join([point.id, *(repr(a.value) for a in axes), *(bare(a.sigma) for a in axes)]))
    (folder / "points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for i, (x_mm, y_mm) in enumerate(observed.xy_mm.tolist()):
        sx, sy = np.sqrt(np.diag(observed.covariance_mm2[i])).tolist()
        rows.append(f"{observed.image[i]},{observed.point[i]},{observed.kind[i]},{x_mm!r},{y_mm!r},{sx!r},{sy!r}")
    (folder / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "project.toml").write_text(
        'camera = "camera.toml"\n[object]\npoints = "points.csv"\n'
        f'[adjust]\ntransformation = "{network.images[0].transformation}"\n',
        encoding="utf-8",
    )
    return folder / "project.toml"


def sigma(prior: Prior) -> str:
    return repr(prior.sigma) if np.isfinite(prior.sigma) else '"free"'


def bare(value: float) -> str:
    return repr(value) if np.isfinite(value) else ""
