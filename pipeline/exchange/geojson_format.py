"""GeoJSON: ground footprints of the images as polygons in longitude and latitude, from UTM or degrees."""

import json
import re
from itertools import pairwise

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import ImageBlock, WholeFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.pinhole import frame_corners_mm
from pipeline.types import Array

# Semi-major axis in m and flattening. ETRS89 (GRS 80) and WGS 84 differ by less than a metre, and by plate motion.
_AXIS_M, _FLATTENING = 6378137.0, 1.0 / 298.257222101
_SCALE, _EASTING_M, _SOUTHERN_M = 0.9996, 500_000.0, 10_000_000.0
_DEGREES = ("EPSG:4326", "EPSG:4258")

GEOJSON = Convention(
    (float("nan"), float("nan")),
    "no pixels: longitude and latitude in degrees, WGS 84, counter-clockwise",
    "RFC 7946, sections 3.1.6 and 4",
)
_SIDE_POINTS = 8  # points per side, since a side of the frame is not a straight line on a map


def lon_lat(xy: Array, crs: str) -> Array:
    """Longitude and latitude (n, 2) in degrees from easting and northing (n, 2) in m, or from longitude and latitude.
    Raises InputError for an unknown coordinate reference system."""
    if crs.upper() in _DEGREES:
        return xy
    if utm := re.fullmatch(r"EPSG:(326|327|258)(\d\d)", crs.upper()):
        zone, is_european = int(utm[2]), utm[1] == "258"
        if 28 <= zone <= 38 if is_european else 1 <= zone <= 60:
            return _from_utm(xy, zone, southern=utm[1] == "327")
    raise InputError(
        f"crs {crs!r} is not known here. Known are UTM zones (EPSG:32601 to 32660, 32701 to 32760 of WGS 84, 25828 "
        f"to 25838 of ETRS89) and degrees of longitude and latitude ({', '.join(_DEGREES)}). Transform the points "
        "to one of them."
    )


def _from_utm(xy: Array, zone: int, southern: bool) -> Array:
    """Longitude and latitude from UTM by Krueger's series in the third flattening, to n^4: exact to some micrometres
    within a zone.

    L. Krueger, Konforme Abbildung des Erdellipsoids in der Ebene (1912); C. F. F. Karney, Transverse Mercator with an
    accuracy of a few nanometers, J. Geodesy 85 (2011), equations 11, 14, 36.
    """
    n = _FLATTENING / (2.0 - _FLATTENING)
    radius = _AXIS_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0)
    beta = (
        n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96 - n**4 / 360,
        n**2 / 48 + n**3 / 15 - 437 * n**4 / 1440,
        17 * n**3 / 480 - 37 * n**4 / 840,
        4397 * n**4 / 161280,
    )
    north, east = xy[:, 1] - (_SOUTHERN_M if southern else 0.0), xy[:, 0] - _EASTING_M
    z = (north + 1j * east) / (_SCALE * radius)
    z = z - sum(b * np.sin(2 * k * z) for k, b in enumerate(beta, 1))
    xi, eta = z.real, z.imag
    lon = np.arctan2(np.sinh(eta), np.cos(xi))
    conformal = np.sin(xi) / np.hypot(np.sinh(eta), np.cos(xi))  # tan of the conformal latitude
    e = np.sqrt(_FLATTENING * (2.0 - _FLATTENING))
    tan = conformal / (1.0 - e**2)
    for _ in range(6):  # Newton's method for the geodetic latitude, by Karney's equations 19 to 21
        sigma = np.sinh(e * np.arctanh(e * tan / np.hypot(1.0, tan)))
        value = tan * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tan)
        step = (conformal - value) / np.hypot(1.0, value) * (1.0 + (1.0 - e**2) * tan**2)
        tan = tan + step / ((1.0 - e**2) * np.hypot(1.0, tan))
    return np.asarray(np.degrees(np.column_stack([lon, np.arctan(tan)])) + np.array([6.0 * zone - 183.0, 0.0]))


def write_geojson(block: ImageBlock, options: ExportOptions) -> Written:
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
    for frame in block.whole(block.oriented_frames()):
        outline = footprint(block, frame)
        if isinstance(outline, str):
            left_out.append(f"{frame.image}: {outline}")
            continue
        ring = lon_lat(outline[:, :2] * block.project.unit_mm / 1000.0, crs)
        x, y = (ring - ring.mean(axis=0)).T
        if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() <= 0.0:  # clockwise: the plane is seen from its other side
            ring = ring[::-1]
        corners = [[round(lon, 9), round(lat, 9)] for lon, lat in [*ring.tolist(), ring[0].tolist()]]
        features.append(
            {
                "type": "Feature",
                "properties": {"image": frame.image, "camera": frame.camera, "ground": float(outline[0, 2])},
                "geometry": {"type": "Polygon", "coordinates": [corners]},
            }
        )
    content = {"type": "FeatureCollection", "features": features}
    notes = ("The terrain is taken as level, at the mean height of the points that an image shows.",)
    lost = ("relief", "all standard deviations")
    return Written({"footprints.geojson": json.dumps(content, ensure_ascii=False) + "\n"}, lost, notes, tuple(left_out))


def footprint(block: ImageBlock, frame: WholeFrame) -> Array | str:
    """Outline (n, 3) in object coordinates of a frame on level ground, counter-clockwise from the lower left corner, or
    the reason why there is none."""
    model = frame.model
    assert model is not None
    heights = [block.points[mark.point][2] for mark in frame.observed_marks(False) if mark.point in block.points]
    if not heights:
        return "none of its points is adjusted, so the height of the terrain is not known."
    (left, bottom), (right, top) = frame_corners_mm(block, frame)
    turns = np.array([(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)])
    share = np.arange(_SIDE_POINTS)[:, None] / _SIDE_POINTS
    outline_mm = np.concatenate([start + share * (end - start) for start, end in pairwise(turns)])
    ideal, found = model.lens.ideal_from_observed(outline_mm)
    c, point = model.lens.interior[0], model.lens.interior[1:]
    # x' = x0' - c U/W: towards the ground W is negative, and the ray is (x' - x0', y' - y0', -c).
    rays = np.column_stack([ideal - point, np.full(len(ideal), -c)]) @ model.rotation
    reach = (float(np.mean(heights)) - model.station[2]) / np.where(rays[:, 2] == 0.0, np.nan, rays[:, 2])
    if not (found.all() and (reach > 0.0).all()):
        return "its frame reaches beyond the horizon, or the lens folds in it."
    return np.asarray(model.station + reach[:, None] * rays)
