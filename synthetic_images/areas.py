"""Areas bounded by outlines, and their exact coverage of pixels.

An area is a tuple of closed outlines, each an (n, 2) array. Outlines of one area must not overlap; one of opposite
orientation is a hole. Different areas may overlap.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cover = NDArray[np.float32]
Point = tuple[float, float]
Area = tuple[Array, ...]

CIRCLE_VERTICES = 256  # the outline of a disk of 100 px radius is accurate to 0.008 px, its centre is exact


def coverage(areas: tuple[Area, ...], col0: int, row0: int, width: int, height: int, fold: int = 1) -> Cover:
    """Coverage of the pixels of a window by the union of areas.

    Parameters
    ----------
    areas : outlines in (column, row), px; the centre of the top-left pixel is (0, 0).
    fold : each pixel is divided into fold x fold.

    Returns
    -------
    (height * fold, width * fold) covered fractions, 0 to 1.

    Notes
    -----
    A single area is integrated exactly, by the signed area to the right of each piece of outline. For several areas,
    pixels crossed by edges of two of them are approximate.
    """
    covered = _exact(areas[0], col0, row0, width, height, fold)
    for area in areas[1:]:
        covered += (1.0 - covered) * _exact(area, col0, row0, width, height, fold)
    return covered


def bounds(areas: tuple[Area, ...]) -> tuple[int, int, int, int]:
    """Window (col0, row0, width, height) of all pixels that the areas touch."""
    vertices = np.concatenate([outline for area in areas for outline in area])
    low = np.floor(vertices.min(axis=0) + 0.5).astype(int)
    high = np.floor(vertices.max(axis=0) + 0.5).astype(int) + 1
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def centroid(area: Area) -> Array:
    """(2,) exact centroid of an area."""
    total, moment = 0.0, np.zeros(2)
    for outline in area:
        origin = outline[0]
        p = outline - origin
        q = np.roll(p, -1, axis=0)
        twice = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        total += float(twice.sum()) / 2
        moment += ((p + q) * twice[:, None]).sum(axis=0) / 6 + origin * twice.sum() / 2
    return np.asarray(moment / total)


def disk(center: Point, radius: float) -> Area:
    """Filled circle."""
    angle = np.arange(CIRCLE_VERTICES) * (2 * np.pi / CIRCLE_VERTICES)
    return (np.asarray(center) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1),)


def ring(center: Point, radius: float, line: float) -> Area:
    """Circle drawn with a line; radius: of the middle of the line, line: its width."""
    if line >= 2 * radius:
        return disk(center, radius + line / 2)
    return (*disk(center, radius + line / 2), disk(center, radius - line / 2)[0][::-1])


def bar(start: Point, end: Point, line: float) -> Area:
    """Straight line with square ends. Raises ValueError if it has no length."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = b - a
    if not along.any():
        raise ValueError(f"a bar must have two different ends, not {start} twice")
    across = np.array([-along[1], along[0]]) * (line / 2 / np.hypot(*along))
    return (np.stack([a - across, b - across, b + across, a + across]),)


def polygon(vertices: tuple[Point, ...]) -> Area:
    """Filled simple polygon."""
    return (np.asarray(vertices, float),)


def rounded_rectangle(half: Array, radius: float) -> Array:
    """Outline of a rectangle with rounded corners, centred on the origin; half: (2,) half sizes."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
    if radius == 0.0:
        return corners
    turn = np.linspace(0.0, np.pi / 2, CIRCLE_VERTICES // 4)
    arcs = [
        corner * (1 - radius / half) + radius * np.stack([np.cos(turn + start), np.sin(turn + start)], axis=1)
        for corner, start in zip(corners, np.arange(4) * np.pi / 2, strict=True)
    ]
    return np.concatenate(arcs)


def stroke(path: Array, line: float) -> Area:
    """Curved line of constant width along an (n, 2) path."""
    along = np.gradient(path, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) * (line / 2 / np.hypot(along[:, 0], along[:, 1]))[:, None]
    return (np.concatenate([path + across, (path - across)[::-1]]),)


def subdivided(outline: Array, pieces: int) -> Array:
    """Divide each edge of an outline into pieces, so that it can follow a curved mapping."""
    share = np.arange(pieces)[None, :, None] / pieces
    edges = outline[:, None, :] * (1 - share) + np.roll(outline, -1, axis=0)[:, None, :] * share
    return np.asarray(edges.reshape(-1, 2))


def _exact(area: Area, col0: int, row0: int, width: int, height: int, fold: int) -> Cover:
    """Coverage of pixels of 1/fold of the size by one area, from the signed area to the right of each outline piece."""
    columns, rows = width * fold, height * fold
    corner = np.array([col0 - 0.5, row0 - 0.5])
    starts = np.concatenate([(outline - corner) * fold for outline in area])
    ends = np.concatenate([(np.roll(outline, -1, axis=0) - corner) * fold for outline in area])
    starts, ends = _split_at_rows(starts, ends, rows)
    starts, ends = _cut_at_pixel_sides(starts, ends, columns, rows)
    middle, fall = (starts + ends) / 2, ends[:, 1] - starts[:, 1]
    inside = middle[:, 0] < columns
    middle, fall = middle[inside], fall[inside]
    row = np.clip(middle[:, 1].astype(int), 0, rows - 1)
    x = np.maximum(middle[:, 0], 0.0)
    column = x.astype(int)
    place = row * (columns + 1) + column
    share = x - column
    changes = np.bincount(
        np.concatenate([place, place + 1]),
        np.concatenate([fall * (1 - share), fall * share]),
        rows * (columns + 1),
    ).reshape(rows, columns + 1)
    # abs: mirrored outlines have the opposite orientation and give negative areas; rounding leaves about 1e-13.
    covered = np.abs(np.cumsum(changes[:, :columns], axis=1))
    return np.asarray(np.minimum(covered, 1.0), np.float32)


def _split_at_rows(starts: Array, ends: Array, rows: int) -> tuple[Array, Array]:
    """Clip edges to the rows of the window; the parts above and below cover nothing."""
    low, high = np.minimum(starts[:, 1], ends[:, 1]), np.maximum(starts[:, 1], ends[:, 1])
    crossing = (high > 0) & (low < rows) & (high > low)
    starts, ends = starts[crossing], ends[crossing]
    step = ends - starts
    share = np.sort(np.stack([-starts[:, 1], rows - starts[:, 1]], axis=1) / step[:, 1:], axis=1).clip(0.0, 1.0)
    return starts + step * share[:, :1], starts + step * share[:, 1:]


def _cut_at_pixel_sides(starts: Array, ends: Array, columns: int, rows: int) -> tuple[Array, Array]:
    """Cut edges where they cross pixel borders, so that each piece lies within one pixel."""
    step = ends - starts
    edges, shares = [np.arange(len(starts)), np.arange(len(starts))], [np.zeros(len(starts)), np.ones(len(starts))]
    for axis, last in ((0, columns), (1, rows)):
        low = np.minimum(starts[:, axis], ends[:, axis])
        high = np.maximum(starts[:, axis], ends[:, axis])
        first = np.maximum(np.floor(low) + 1, 0).astype(int)
        count = np.maximum(np.minimum(np.ceil(high) - 1, last).astype(int) - first + 1, 0)
        edge = np.repeat(np.arange(len(starts)), count)
        side = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + first[edge]
        edges.append(edge)
        shares.append((side - starts[edge, axis]) / step[edge, axis])
    edge, share = np.concatenate(edges), np.concatenate(shares)
    order = np.lexsort((share, edge))
    edge, share = edge[order], share[order]
    points = starts[edge] + step[edge] * share[:, None]
    same = edge[1:] == edge[:-1]
    return points[:-1][same], points[1:][same]
