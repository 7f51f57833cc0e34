"""A second, dense implementation of the combined model, for comparison: formulas point by point, complex steps only.

It shares nothing with the adjustment but the network and the names of the unknowns. Angles are unknowns themselves, and
all functions F1 to F9 with their priors stand in one full system."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from networks import camera_of_film
from numpy.typing import NDArray

from adjust import Adjustment, Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.problem.network import EXTERIOR_NAMES, Network

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Values = dict[str, complex]

STEP = 1e-40


@dataclass(frozen=True)
class DenseResult:
    """By name of unknown: value and a-priori standard deviation; their cofactors, v'Pv and the redundancy.

    hidden (n, n): I - H of the whitened rows: two of each observation, one of each prior in `given`, the distances."""

    values: dict[str, float]
    sigmas: dict[str, float]
    cofactor: Array
    vpv: float
    redundancy: int
    hidden: Array
    given: list[str]


def solve_densely(network: Network, begun: Adjustment) -> DenseResult:
    """Iterate from the values of a result, of free and of fixed quantities, until nothing moves."""
    start, mirrored = dict(zip(begun.names, begun.values.tolist(), strict=True)), begun.mirrored
    priors = _priors(network)
    names = [name for name in start if name not in priors or priors[name].sigma > 0.0]
    rows = range(len(network.observations))
    touched = {name: [row for row in rows if _touches(network, row, name)] for name in names}
    names, distances = [name for name in names if touched[name]], distances_by_names(network)
    pseudo = [name for name in names if name in priors and np.isfinite(priors[name].sigma)]
    x = dict(start)
    observed = network.observations.xy_mm
    adjusted = observed.copy()
    for _ in range(6):
        values: Values = dict(x)
        f = np.array([_function(network, values, row, adjusted[row], mirrored) for row in rows])
        a = np.array(
            [
                np.column_stack(
                    [
                        _function(network, values, row, adjusted[row] + 1j * STEP * unit, mirrored).imag / STEP
                        for unit in np.eye(2)
                    ]
                )
                for row in rows
            ]
        )
        b = np.zeros((len(observed), 2, len(names)))
        for k, name in enumerate(names):
            moved = values | {name: values[name] + 1j * STEP}
            for row in touched[name]:
                b[row, :, k] = _function(network, moved, row, adjusted[row], mirrored).imag / STEP
        w = -f.real - np.einsum("nij,nj->ni", a, observed - adjusted)
        root = np.linalg.cholesky(a @ network.observations.covariance_mm2 @ a.transpose(0, 2, 1))
        whitened = np.linalg.solve(root, np.concatenate([b, w[..., None]], axis=2)).reshape(-1, len(names) + 1)
        of_priors = np.zeros((len(pseudo), len(names) + 1))
        for i, name in enumerate(pseudo):
            of_priors[i, names.index(name)] = 1.0 / priors[name].sigma
            of_priors[i, -1] = _difference(name, priors[name].value - x[name]) / priors[name].sigma
        of_distances = np.zeros((len(distances), len(names) + 1))
        for equation, (ends, (value, sigma)) in zip(of_distances, distances.items(), strict=True):
            equation[-1] = (value - length(ends, values).real) / sigma
            for name in set(ends) & set(names):
                moved = values | {name: values[name] + 1j * STEP}
                equation[names.index(name)] = length(ends, moved).imag / STEP / sigma
        system = np.vstack([whitened, of_priors, of_distances])
        scale = np.linalg.norm(system[:, :-1], axis=0)
        q, r = np.linalg.qr(system[:, :-1] / scale)
        dx = np.linalg.solve(r, q.T @ system[:, -1]) / scale
        lagrange = np.linalg.solve(
            a @ network.observations.covariance_mm2 @ a.transpose(0, 2, 1), (w - b @ dx)[..., None]
        )
        v = (network.observations.covariance_mm2 @ a.transpose(0, 2, 1) @ lagrange)[..., 0]
        adjusted = observed + v
        x |= {name: x[name] + step for name, step in zip(names, dx.tolist(), strict=True)}
        inverse = np.linalg.inv(r) / scale[:, None]
        sigmas = np.sqrt((inverse**2).sum(axis=1))
        if np.abs(dx / sigmas).max() < 1e-7:
            break
    vpv = float((np.linalg.solve(network.observations.covariance_mm2, v[..., None])[..., 0] * v).sum())
    vpv += sum((_difference(name, priors[name].value - x[name]) / priors[name].sigma) ** 2 for name in pseudo)
    vpv += sum(((length(ends, x).real - value) / sigma) ** 2 for ends, (value, sigma) in distances.items())
    redundancy = len(system) - len(names)
    by_name, hidden = dict(zip(names, sigmas.tolist(), strict=True)), np.eye(len(system)) - q @ q.T
    return DenseResult(x, by_name, inverse @ inverse.T, vpv, redundancy, hidden, pseudo)


def distances_by_names(network: Network) -> dict[tuple[str, ...], tuple[float, float]]:
    """Value and standard deviation of each distance, by the names of its ends' coordinates, those of one end first."""
    found = {}
    for each in network.distances:
        names = [f"PT.{end}.{axis}" if end in network.point_by_id else f"EO.{end}.{axis}0"
                 for end in (each.start, each.end) for axis in "XYZ"]  # fmt: skip
        found[tuple(names)] = each.value, each.sigma
    for camera in network.cameras:
        for measured in camera.distances:
            names = [f"FID.{camera.name}.{end}.{axis}" for end in (measured.start, measured.end) for axis in "xy"]
            found[tuple(names)] = measured.value_mm, measured.sigma_mm
    return found


def length(names: Sequence[str], values: Mapping[str, complex]) -> complex:
    start, end = np.array([values[name] for name in names]).reshape(2, -1)
    return complex(np.sqrt(((end - start) ** 2).sum()))


def _priors(network: Network) -> dict[str, Prior]:
    priors: dict[str, Prior | None] = {}
    for camera in network.cameras:
        owner = f"IO.{camera.name}"
        priors |= {f"{owner}.c": camera.principal_distance_mm, f"{owner}.x0": camera.x0_mm, f"{owner}.y0": camera.y0_mm}
        priors |= {f"{owner}.{name}": Prior(0.0) for name in _LENS}
        priors |= {f"{owner}.{name}": prior for name, prior in camera.distortion.parameters.items()}
        for id_, mark in camera.fiducials.items():
            priors |= {f"FID.{camera.name}.{id_}.x": mark.x_mm, f"FID.{camera.name}.{id_}.y": mark.y_mm}
    for point in network.points:
        priors |= {f"PT.{point.id}.{axis}": getattr(point, axis) for axis in "XYZ"}
    for image in network.images:
        if image.exterior is not None:
            for name, value, sigma in zip(EXTERIOR_NAMES, image.exterior.values, image.exterior.sigmas, strict=True):
                priors[f"EO.{image.name}.{name}"] = Prior(float(value), float(sigma))
    return {name: prior for name, prior in priors.items() if prior is not None}


def _touches(network: Network, row: int, name: str) -> bool:
    observations = network.observations
    image = network.image_by_name[observations.image[row]]
    kind, owner = name.split(".")[0], name.split(".")[1]
    target = observations.kind[row] != "fiducial"
    match kind:
        case "T":
            return owner == image.name
        case "EO":
            return target and owner == image.name
        case "IO":
            return target and owner == image.camera
        case "PT":
            return target and owner == observations.point[row]
    return not target and (owner, name.split(".")[2]) == (image.camera, observations.point[row])


def _difference(name: str, difference: float) -> float:
    is_angle = name.startswith("EO.") and name.endswith(("omega", "phi", "kappa"))
    return float(np.angle(np.exp(1j * difference))) if is_angle else difference


def _function(network: Network, x: Values, row: int, xy: Array | Complex, mirrored: frozenset[str]) -> Complex:
    """F1 and F2 of a target, F3 and F4 of a fiducial."""
    observations = network.observations
    image = network.image_by_name[observations.image[row]]
    point = observations.point[row]
    film = np.array([x[f"T.{image.name}.{name}"] for name in film_parameter_names(image.transformation)])
    place = np.array(camera_of_film(image.transformation, film, image.name in mirrored, xy[0] + 0j, xy[1] + 0j))
    if observations.kind[row] == "fiducial":
        return np.asarray(place - np.array([x[f"FID.{image.camera}.{point}.{axis}"] for axis in "xy"]))
    o, p, k = (x[f"EO.{image.name}.{name}"] for name in ("omega", "phi", "kappa"))
    so, co, sp, cp, sk, ck = (f(angle) for angle in (o, p, k) for f in (np.sin, np.cos))
    m = np.array(
        [
            [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
            [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
            [sp, -so * cp, co * cp],
        ]
    )
    station = np.array([x[f"EO.{image.name}.{axis}"] for axis in ("X0", "Y0", "Z0")])
    u, v, w = m @ (np.array([x[f"PT.{point}.{axis}"] for axis in "XYZ"]) - station)
    io = {name: x[f"IO.{image.camera}.{name}"] for name in ("c", "x0", "y0")}
    d = _distortion(network, image.camera, x, place - np.array([io["x0"], io["y0"]]), place)
    return np.asarray(place - np.array([io["x0"], io["y0"]]) + io["c"] * np.array([u / w, v / w]) - d)


_LENS = ("k3", "k5", "k7", "p1", "p2", "p3", "p4")


def _distortion(network: Network, camera: str, x: Values, r: Complex, place: Complex) -> Complex:
    distortion = network.camera_by_name[camera].distortion
    q = {name: x[f"IO.{camera}.{name}"] for name in _LENS}
    r2, z = r[0] ** 2 + r[1] ** 2, distortion.r0_mm**2
    radial = q["k3"] * (r2 - z) + q["k5"] * (r2**2 - z**2) + q["k7"] * (r2**3 - z**3)
    growth = 1 + q["p3"] * r2 + q["p4"] * r2**2
    ex, ey = place if distortion.decentering == "paper" else r
    dx = r[0] * radial + (q["p1"] * (r2 + 2 * ex**2) + 2 * q["p2"] * ex * ey) * growth
    dy = r[1] * radial + (2 * q["p1"] * ex * ey + q["p2"] * (r2 + 2 * ey**2)) * growth
    return np.array([dx, dy])


def row_roots(factor: Factor, blocks: Iterable[Blocks]) -> Iterator[NDArray[np.float64]]:
    """G (b, m, k) of blocks as these were factorised: G G' are the cofactor matrices of each one's adjusted rows."""
    for rows in factor.reduced_rows(blocks):
        yield np.concatenate([rows.own, rows.through @ factor.triangle.group_roots(rows.shared)], axis=2)
