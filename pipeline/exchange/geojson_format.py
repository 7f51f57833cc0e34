"""GeoJSON: ground footprints of the images as polygons in longitude and latitude."""

import json
from itertools import pairwise

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import Block, WholeFrame
from pipeline.exchange.fitted_lens import frame_corners_mm
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.map_projection import lon_lat
from pipeline.types import Array

CONVENTION = Convention(
    (float("nan"), float("nan")),
    "no pixels: longitude and latitude in degrees, WGS 84, counter-clockwise",
    "RFC 7946, sections 3.1.6 and 4",
)
_SIDE_POINTS = 8  # points per side, since a side of the frame is not a straight line on a map


def write(block: Block, options: ExportOptions) -> Written:
    """Write footprints.geojson: outlines of the frames, projected by the adjusted lens and orientation to the mean
    height of their points."""
    crs = block.project.crs
    if not crs:
        raise InputError(
            f"{block.project.path}: geojson needs to know what the object coordinates are. Give crs in [object], such "
            'as "EPSG:25832".'
        )
    block.needs_orientation("geojson")
    features, left_out = [], list(block.unoriented_note())
    for frame in block.whole(block.oriented()):
        outline = footprint(block, frame)
        if isinstance(outline, str):
            left_out.append(f"{frame.image}: {outline}")
            continue
        features.append(_feature(frame, lon_lat(outline[:, :2] * block.project.unit_mm / 1000.0, crs), outline[0, 2]))
    content = {"type": "FeatureCollection", "features": features}
    notes = ("The terrain is taken as level, at the mean height of the points that an image shows.",)
    lost = ("relief", "all standard deviations")
    return Written({"footprints.geojson": json.dumps(content, ensure_ascii=False) + "\n"}, lost, notes, tuple(left_out))


def footprint(block: Block, frame: WholeFrame) -> Array | str:
    """Outline (n, 3) in object coordinates of a frame on level ground, or the reason why there is none."""
    model = frame.model
    assert model is not None
    heights = [block.points[mark.point][2] for mark in frame.observed(False) if mark.point in block.points]
    if not heights:
        return "none of its points is adjusted, so the height of the terrain is not known."
    outline_mm = _outline(frame_corners_mm(block, frame))
    ideal, found = model.lens.ideal_from_observed(outline_mm)
    c, point = model.lens.interior[0], model.lens.interior[1:]
    # x' = x0' - c U/W: towards the ground W is negative, and the ray is (x' - x0', y' - y0', -c).
    rays = np.column_stack([ideal - point, np.full(len(ideal), -c)]) @ model.rotation
    reach = (float(np.mean(heights)) - model.station[2]) / np.where(rays[:, 2] == 0.0, np.nan, rays[:, 2])
    if not (found.all() and (reach > 0.0).all()):
        return "its frame reaches beyond the horizon, or the lens folds in it."
    return np.asarray(model.station + reach[:, None] * rays)


def _outline(corners_mm: Array) -> Array:
    """Points along a rectangle between two opposite corners, counter-clockwise from the lower left one."""
    (left, bottom), (right, top) = corners_mm
    turns = np.array([(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)])
    share = np.arange(_SIDE_POINTS)[:, None] / _SIDE_POINTS
    return np.concatenate([start + share * (end - start) for start, end in pairwise(turns)])


def _feature(frame: WholeFrame, outline: Array, height: float) -> dict[str, object]:
    ring = outline if _area(outline) > 0.0 else outline[::-1]  # clockwise if the plane is seen from its other side
    closed = [*ring.tolist(), ring[0].tolist()]
    return {
        "type": "Feature",
        "properties": {"image": frame.image, "camera": frame.camera, "ground": float(height)},
        "geometry": {"type": "Polygon", "coordinates": [[[round(lon, 9), round(lat, 9)] for lon, lat in closed]]},
    }


def _area(ring: Array) -> float:
    x, y = (ring - ring.mean(axis=0)).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2.0
