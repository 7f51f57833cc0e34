"""Everything that goes out, as tables in this program's own conventions: csv and parquet write the same ones."""

import math
from collections.abc import Mapping, Sequence

from adjust.problem.parameter import Parameter
from pipeline.exchange.block import Block, OutFrame
from pipeline.exchange.convention import Convention
from pipeline.results.comparator_file import ComparatorPoint

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; comparator and camera mm with x right and y up; rotation R3(kappa) R2(phi) R1(omega)",
    "this program's own, docs/method/theory.md",
)

Cell = str | float | bool | None
Table = dict[str, list[Cell]]


def tables(block: Block) -> Mapping[str, Table]:
    """By name; a cell that has no value is None. Angles in degrees, their covariances in rad as in adjustment.npz."""
    made = {"marks": _marks(block)}
    if block.adjustment is not None:
        made |= {
            "images": _images(block),
            "transformations": _transformations(block),
            "covariances": _covariances(block),
            "points": _points(block),
            "cameras": _cameras(block),
        }
    return made


def _marks(block: Block) -> Table:
    rows = [_mark(frame, mark) for frame in block.frames for mark in frame.marks]
    return _table(rows)


def _mark(frame: OutFrame, mark: ComparatorPoint) -> dict[str, Cell]:
    assert mark.xy_mm is not None
    place, sigma = mark.xy_mm, mark.sigma_mm
    col, row = frame.pixels((mark,))[0].tolist() if frame.pitch_um else (None, None)
    camera = (None, None) if frame.model is None else frame.model.camera_from_comparator(place[None])[0].tolist()
    return {
        "image": mark.image,
        "camera": frame.camera,
        "point": mark.point,
        "kind": mark.kind,
        "status": str(mark.status),
        "x_mm": float(place[0]),
        "y_mm": float(place[1]),
        "sx_mm": None if sigma is None else float(sigma[0]),
        "sy_mm": None if sigma is None else float(sigma[1]),
        "rho": mark.rho,
        "col_px": col,
        "row_px": row,
        "camera_x_mm": camera[0],
        "camera_y_mm": camera[1],
        "reason": mark.reason,
    }


def _images(block: Block) -> Table:
    assert block.adjustment is not None
    rows: list[Mapping[str, Cell]] = []
    for frame in block.oriented():
        elements = block.adjustment.images[frame.image].exterior.elements
        values = {name: element.value for name, element in elements.items()}
        sigmas = {f"s{name}": _number(element.sigma) for name, element in elements.items()}
        rows.append({"image": frame.image, "camera": frame.camera, **values, **sigmas})
    return _table(rows)


def _transformations(block: Block) -> Table:
    assert block.adjustment is not None
    rows: list[Mapping[str, Cell]] = []
    for frame in block.frames:
        if frame.model is None:
            continue
        film = block.adjustment.images[frame.image].transformation
        known: dict[str, Cell] = {"image": frame.image, "kind": film.kind, "mirrored": film.mirrored}
        rows += [
            {**known, "parameter": name, "value": each.value, "sigma": _number(each.sigma)}
            for name, each in film.parameters.items()
        ]
    return _table(rows)


def _covariances(block: Block) -> Table:
    """Of each image's orientation and film transformation: the lower triangle, mm, object units and rad."""
    of_image: dict[str, list[Parameter]] = {}
    for each in block.covariance.parameters:
        if each.kind in ("exterior", "film"):
            of_image.setdefault(each.owner, []).append(each)
    rows: list[Mapping[str, Cell]] = []
    for frame in block.frames:
        own = of_image.get(frame.image, [])
        matrix = block.covariance.of(own)
        rows += [
            {"image": frame.image, "first": first.text, "second": second.text, "covariance": float(matrix[i, j])}
            for i, first in enumerate(own)
            for j, second in enumerate(own[: i + 1])
        ]
    return _table(rows)


def _points(block: Block) -> Table:
    assert block.adjustment is not None
    rows: list[Mapping[str, Cell]] = []
    for id, point in block.adjustment.points.items():
        values = {axis: each.value for axis, each in zip("XYZ", point.axes, strict=True)}
        sigmas = {f"s{axis}": _number(each.sigma) for axis, each in zip("XYZ", point.axes, strict=True)}
        rows.append({"point": id, **values, **sigmas})
    return _table(rows)


def _cameras(block: Block) -> Table:
    assert block.adjustment is not None
    rows: list[Mapping[str, Cell]] = []
    for name, camera in block.adjustment.cameras.items():
        point, distortion = camera.principal_point_mm, camera.distortion
        quantities = {"c_mm": camera.principal_distance_mm, "x0_mm": point.x, "y0_mm": point.y}
        quantities |= distortion.parameters
        for id, fiducial in camera.fiducials.items():
            quantities |= {f"fiducial {id} x_mm": fiducial.x_mm, f"fiducial {id} y_mm": fiducial.y_mm}
        known = {"camera": name, "distortion": distortion.family}
        rows += [
            {**known, "parameter": key, "value": _number(each.value), "sigma": _number(each.sigma)}
            for key, each in quantities.items()
        ]
    return _table(rows)


def _number(value: float) -> Cell:
    return value if math.isfinite(value) else None


def _table(rows: Sequence[Mapping[str, Cell]]) -> Table:
    return {column: [row[column] for row in rows] for column in (rows[0] if rows else ())}
