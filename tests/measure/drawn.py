"""Pictures drawn by brute force, by asking 1024 points of every pixel: marks, whole frames, boards."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from measure import FiducialOptions, FrameMeasurement, MarkFit, MarkMeasurement, Scan, Status, measure_fiducials
from measure.boards import specs
from measure.boards.measure import BoardMeasurement
from measure.marks.shapes import Bar, Disk, FiducialLayout, LayoutMark, Mark, MarkShape, Part, Ring, ring_cross
from measure.results import Covariance
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS, Samples

Array = NDArray[np.float64]
STRIP = 10_000  # samples that are asked together


def make_scan(grey: Array, full_scale: int = 65535, quantisation_step_dn: float = 0.0) -> Scan:
    """Grey values (height, width), or those of channels, rounded and cut off, as a scan of 16 or 8 bits in memory."""
    rounded = np.clip(np.rint(grey if grey.ndim == 3 else grey[..., None]), 0, full_scale)
    stored: Samples = rounded.astype(np.uint16) if full_scale > 255 else rounded.astype(np.uint8)
    return Scan(Path("drawn.tif"), WholePicture(stored, quantisation_step_dn), NO_TAGS)


def draw(inside: Callable[[Array, Array], Array], width: int, height: int, blur_px: float, fineness: int = 16) -> Array:
    """(height, width) means over the pixels of a function of columns (1, n) and rows (m, 1), after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    fine = [(np.arange((size + 2 * pad) * fineness) + 0.5) / fineness - 0.5 - pad for size in (width, height)]
    columns, rows = np.meshgrid(*fine, sparse=True)
    sharp = np.concatenate([inside(columns, strip) for strip in encode_strips(rows, columns.size)]).astype(float)
    return pixel_means(sharp, blur_px, fineness, pad)


def encode_strips(rows: NDArray[Any], columns: int) -> list[NDArray[Any]]:
    """Rows in strips of so few samples that all that is made of them stays in a processor's cache."""
    return np.array_split(rows, max(len(rows) * columns // STRIP, 1))


def pixel_means(sharp: Array, blur_px: float, fineness: int, pad: int) -> Array:
    """Means over the pixels after a Gaussian blur cut off at five sigmas; of samples `fineness` to a pixel along each
    axis, with a border of `pad` pixels, of more than five sigmas, that the result has not."""
    rows, columns = (_means_of_samples(size, blur_px * fineness, fineness, pad) for size in sharp.shape)
    return np.asarray((columns @ (rows @ sharp).T).T)


def _means_of_samples(samples: int, sigma: float, fineness: int, pad: int) -> csr_array:
    """(pixels, samples) what each sample counts in a pixel's mean: all blurred samples of the pixel, summed up."""
    reach = int(5 * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2) if sigma > 0 else np.ones(1)
    of_pixel = np.convolve(np.ones(fineness), kernel / kernel.sum()) / fineness
    pixels, each = samples // fineness - 2 * pad, len(of_pixel)
    first = (np.arange(pixels) + pad) * fineness - reach
    entries = np.tile(of_pixel, pixels), (first[:, None] + np.arange(each)).ravel(), each * np.arange(pixels + 1)
    return csr_array(entries, shape=(pixels, samples))


def transformed(matrix: NDArray[np.floating], col: Array, row: Array) -> tuple[Array, Array]:
    """The x and the y of a matrix (2, 2) by (column, row), for columns (1, n) and rows (m, 1)."""
    x, y = (line[0] * col + line[1] * row for line in matrix)
    return x, y


def ellipse(center_px: Array, pixel_from_disk: Array) -> Callable[[Array, Array], Array]:
    """1 inside of an ellipse."""
    disk_from_pixel = np.linalg.inv(pixel_from_disk)

    def inside(col: Array, row: Array) -> Array:
        x, y = transformed(disk_from_pixel, col - center_px[0], row - center_px[1])
        return np.asarray(x**2 + y**2 < 1)

    return inside


def whitened(error: Array, covariance: Array) -> Array:
    """The error in units of its standard deviations: two independent standard normal numbers where all is right."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), error))


Singles = NDArray[np.float32]
POINTS, KEPT = 32, 8  # along a pixel's side; asked, and left for the blur


def brute_picture(
    mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float, points: int = POINTS
) -> Array:
    """(height, width) shares of the pixels inside of the mark, after a Gaussian blur; of so many points along a
    pixel's side."""
    reach = int(np.ceil(5 * blur_px)) + 1
    corners = np.concatenate([corners_mm(part) for part in mark.parts])
    # No blur reaches farther from the mark: all else stays dark.
    (col0, row0), (col1, row1) = (np.clip(xy, 0, (width, height)) for xy in bounds_px(corners, pixel_from_mark, reach))
    picture = np.zeros((height, width))
    moved = pixel_from_mark - np.array([[0, 0, col0], [0, 0, row0]])
    picture[row0:row1, col0:col1] = _brute_picture(mark, moved, col1 - col0, row1 - row0, blur_px, reach, points)
    return picture


def bounds_px(corners: Array, pixel_from_mark: Array, spare_px: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """The first column and row, and those after the last, of the pixels that hold points (n, 2) in mm, and of so many
    about them."""
    places = corners @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2]
    return np.floor(places.min(axis=0)).astype(int) - spare_px, np.ceil(places.max(axis=0)).astype(int) + 1 + spare_px


def _brute_picture(
    mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float, pad: int, points: int
) -> Array:
    rows, cols = height + 2 * pad, width + 2 * pad
    inside = np.zeros((rows * points, cols * points), dtype=bool)
    mark_from_pixel = np.linalg.inv(pixel_from_mark[:, :2])
    for part in mark.parts:
        first, last = (
            np.clip(c + pad, 0, (cols, rows)) * points for c in bounds_px(corners_mm(part), pixel_from_mark, 1)
        )
        col, row = (
            ((np.arange(a, b) + 0.5) / points - 0.5 - pad - center).astype(np.float32)  # to a millionth of a pixel
            for a, b, center in zip(first, last, pixel_from_mark[:, 2], strict=True)
        )
        box = inside[first[1] : last[1], first[0] : last[0]]
        for strip, down in zip(encode_strips(box, len(col)), encode_strips(row, len(col)), strict=True):
            x, y = (line[0] * col[None, :] + line[1] * down[:, None] for line in mark_from_pixel.astype(np.float32))
            strip |= is_inside(part, x, y)
    step = points // KEPT
    rowwise = np.asarray(np.sum([inside[k::step] for k in range(step)], axis=0, dtype=np.uint8))
    counts = np.asarray(np.sum([rowwise[:, k::step] for k in range(step)], axis=0, dtype=np.uint8))
    return pixel_means(counts / step**2, blur_px, KEPT, pad)


def corners_mm(part: Part) -> Array:
    """(n, 2) points whose bounds hold the part: only there is anybody asked."""
    if isinstance(part, Disk | Ring):
        reach = part.radius_mm + (part.line_mm if isinstance(part, Ring) else 0.0)
        return np.asarray(part.center_mm) + reach * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    if isinstance(part, Bar):
        ends, half = np.array([part.from_mm, part.to_mm]), part.line_mm
        return np.concatenate([ends + off for off in ((-half, -half), (half, -half), (half, half), (-half, half))])
    return np.array(part.vertices_mm)


def is_inside(part: Part, x: Singles, y: Singles) -> NDArray[np.bool_]:
    """Which points (mm, y up) a part holds."""
    if isinstance(part, Disk):
        return np.asarray((x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2 < part.radius_mm**2)
    if isinstance(part, Ring):
        inner, outer = (max(part.radius_mm + half, 0.0) ** 2 for half in (-part.line_mm / 2, part.line_mm / 2))
        squared = (x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2
        return np.asarray((squared > inner) & (squared < outer))
    if isinstance(part, Bar):
        dx, dy = part.to_mm[0] - part.from_mm[0], part.to_mm[1] - part.from_mm[1]
        length = float(np.sqrt(dx**2 + dy**2))
        along = ((x - part.from_mm[0]) * dx + (y - part.from_mm[1]) * dy) / length
        across = (-(x - part.from_mm[0]) * dy + (y - part.from_mm[1]) * dx) / length
        return np.asarray((along > 0) & (along < length) & (np.abs(across) < part.line_mm / 2))
    crossings = np.zeros(x.shape, dtype=int)
    for (x0, y0), (x1, y1) in zip(part.vertices_mm, part.vertices_mm[1:] + part.vertices_mm[:1], strict=True):
        if y0 != y1:
            crossings += ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return np.asarray(crossings % 2 == 1)


def placed(px_per_mm: float, center_px: tuple[float, float], turn_rad: float = 0.0) -> Array:
    """(2, 3) from mm (y up) to pixels (row down), turned counter-clockwise as seen in the picture."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.column_stack([px_per_mm * np.array([[c, -s], [-s, -c]]), center_px])


PITCH_UM, PX_PER_MM = 50.0, 20.0
FRAME_PX = 400
CORNERS = ((7.0, -7.0), (-7.0, -7.0), (-7.0, 7.0), (7.0, 7.0))
RING_CROSS = ring_cross(0.5, 0.1, 0.8, 0.1)
NOISE_DN = 200.0


def lay_out(
    marks: Sequence[MarkShape],
    places: Sequence[tuple[float, float]] = CORNERS,
    frame_mm: tuple[float, float] = (17.0, 17.0),
) -> FiducialLayout:
    """Marks 1, 2, ... given to a hundredth of a millimetre."""
    given = [
        LayoutMark(str(number), place, (0.01, 0.01), mark)
        for number, (mark, place) in enumerate(zip(marks, places, strict=True), 1)
    ]
    return FiducialLayout(tuple(given), frame_mm)


def numbered(count: int) -> MarkShape:
    """A ring-cross with so many identification dots to its right and above it."""
    dots: tuple[Part, ...] = tuple(Disk((1.0, 0.3 * k - 0.3), 0.08) for k in range(count))
    return MarkShape((*RING_CROSS, *dots))


NUMBERED = lay_out([numbered(count) for count in range(4)])
ALIKE = lay_out([MarkShape(RING_CROSS)] * 4)


def pixel_from_camera(pose: str, turn_rad: float = 0.008, center: tuple[float, float] = (202.3, 197.6)) -> Array:
    """By the definition of a pose: mirror x', then turn counter-clockwise, then look at it with rows downwards."""
    angle = np.deg2rad(float(pose.rstrip("m"))) + turn_rad
    c, s = np.cos(angle), np.sin(angle)
    right, up = np.array([c, -s]), np.array([s, c])
    if pose.endswith("m"):
        right, up = right * (-1, 1), up * (-1, 1)
    return np.column_stack([PX_PER_MM * np.stack([right, -up]), center])


def frame_picture(layout: FiducialLayout, matrix: Array, seed: int = 1, size: int = FRAME_PX) -> Array:
    """A textured, exposed frame with light marks on its dark corners."""
    rng = np.random.default_rng(seed)
    grey = 8000 + 2500 * gaussian_filter(rng.normal(0, 1, (size, size)), 2.0) / 0.14
    for mark in layout.marks:
        col, row = np.rint(matrix @ (*mark.xy_mm, 1.0)).astype(int)
        top, left, bottom, right = (int(np.clip(v, 0, size)) for v in (row - 40, col - 40, row + 41, col + 41))
        grey[top:bottom, left:right] = 3000
        paint(grey, mark.mark, mark.xy_mm, matrix, 9000.0)
    return np.asarray(grey + rng.normal(0, NOISE_DN, grey.shape))


def paint(
    grey: Array,
    mark: Mark,
    xy_mm: tuple[float, float],
    matrix: Array,
    contrast: float,
    half: int = 30,
    blur_px: float = 0.8,
) -> None:
    """Add a mark to a picture in which a place (mm) lies by matrix (2, 3), within so many pixels about it."""
    assert isinstance(mark, MarkShape)
    center = matrix @ (*xy_mm, 1.0)
    col0, row0 = np.rint(center).astype(int) - half
    place, size = np.column_stack([matrix[:, :2], center - (col0, row0)]), 2 * half + 1
    shown = brute_picture(mark, place, size, size, blur_px, POINTS // 2)
    rows, cols = np.mgrid[row0 : row0 + size, col0 : col0 + size]
    inside = (rows >= 0) & (cols >= 0) & (rows < grey.shape[0]) & (cols < grey.shape[1])
    grey[rows[inside], cols[inside]] += contrast * shown[inside]


def measure_grey(
    grey: Array, layout: FiducialLayout, options: FiducialOptions | None = None, pitch: bool = True
) -> FrameMeasurement:
    result = measure_fiducials(make_scan(grey), layout, (PITCH_UM, PITCH_UM) if pitch else None, options)
    assert [mark.point for mark in result.marks] == [mark.id for mark in layout.marks]
    return result


def found_pose(frame: FrameMeasurement) -> tuple[str, bool]:
    """The name of a frame's scan orientation, and whether it is decided."""
    assert frame.pose is not None
    return frame.pose.name, frame.pose.decided


def measured_mark(point: str, center_px: Array, sigma_px: float) -> MarkMeasurement:
    known = Covariance.from_noise(sigma_px**2 * np.eye(2))
    return MarkMeasurement(point, "fiducial", center_px, known, Status.MEASURED)


def center(mark: MarkFit | MarkMeasurement | None) -> Array:
    assert mark is not None
    assert mark.center_px is not None
    return mark.center_px


def chi_square(mark: MarkFit | MarkMeasurement | None, true_px: Array) -> float:
    """The squared error of a place in its standard deviations: 13.8 of two coordinates once in a thousand."""
    error = center(mark) - true_px
    assert mark is not None
    assert mark.covariance_px2 is not None
    return float(error @ np.linalg.solve(mark.covariance_px2, error))


def assert_right(result: FrameMeasurement, layout: FiducialLayout, matrix: Array) -> None:
    """All marks measured, with the right names, within their standard deviations."""
    for mark, given in zip(result.marks, layout.marks, strict=True):
        assert mark.status is Status.MEASURED, mark.reason
        assert chi_square(mark, matrix @ (*given.xy_mm, 1.0)) < 20


WIDTH, HEIGHT = 320, 260  # px


def board_from_pixel(turn_deg: float = 7.0, tilt: float = 4e-4) -> Array:
    """A homography from pixels to mm of the board, y up: about 1 mm a pixel, turned and seen at an angle."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    back: Array = np.array([[1.0, 0, WIDTH / 2], [0, 1.0, HEIGHT / 2], [0, 0, 1]])
    tilted = np.array([[1.0, 0, 0], [0, 1.0, 0], [tilt, -tilt / 2, 1]])
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.diag([1.0, -1.0, 1.0])
    return np.asarray(np.linalg.inv(back @ tilted @ turned))


def mapped(homography: Array, points: Array) -> Array:
    """(n, 2) points through a homography."""
    x, y, w = homography @ np.vstack([points.T, np.ones(len(points))])
    return np.asarray(np.stack([x / w, y / w], axis=-1))


def take_picture(spec: specs.BoardSpec, homography: Array, is_dark: Any, seed: int = 1) -> Array:
    """A board whose middle lies on the homography's origin; is_dark says so of board coordinates in mm."""
    middle = np.mean([point[:2] for point in spec.object_points().values()], axis=0)

    def light(col: Array, row: Array) -> Array:
        x, y, w = (line[0] * col + line[1] * row + line[2] for line in homography)
        return np.asarray(1.0 - is_dark(x / w + middle[0], y / w + middle[1]))

    rng = np.random.default_rng(seed)
    clean = draw(light, WIDTH, HEIGHT, 0.8, fineness=6)
    return 8000 + 30000 * clean + rng.normal(0, 300, clean.shape)


def read_truth(spec: specs.BoardSpec, homography: Array) -> dict[str, Array]:
    points = spec.object_points()
    flat = np.array([point[:2] for point in points.values()])
    places = mapped(np.asarray(np.linalg.inv(homography)), np.asarray(flat - flat.mean(axis=0)))
    return dict(zip(points, places, strict=True))


def errors_px(board: BoardMeasurement, truth: dict[str, Array]) -> Array:
    """(n, 2) of the points that were measured."""
    measured_marks = [mark for mark in board.marks if mark.status.is_observation]
    return np.asarray([np.asarray(mark.center_px) - truth[mark.point] for mark in measured_marks], float)


def chessboard_dark(spec: specs.ChessboardSpec) -> Any:
    """Dark is the square whose upper left corner is r0c0, and every other one."""

    def dark(x: Array, y: Array) -> Array:
        column, row = np.floor(x / spec.square_mm), np.floor((spec.rows - 1) - y / spec.square_mm)
        inside = (column >= -1) & (column < spec.columns) & (row >= -1) & (row < spec.rows)
        return np.asarray(inside & ((column + row) % 2 == 0))

    return dark


def circles_dark(spec: specs.CircleGridSpec) -> Any:
    places = np.array([point[:2] for point in spec.object_points().values()])

    def dark(x: Array, y: Array) -> Array:
        inside = np.zeros(x.shape, bool)
        for place in places:
            inside |= (x - place[0]) ** 2 + (y - place[1]) ** 2 < (spec.diameter_mm / 2) ** 2
        return inside

    return dark


def printed(board: Any, spec: specs.BoardSpec, size_mm: tuple[float, float], corner_mm: Array) -> Any:
    """Darkness from OpenCV's own drawing of a board, 4 px a mm, whose upper left corner lies at corner_mm."""
    drawing = board.generateImage((round(size_mm[0] * 4), round(size_mm[1] * 4)), marginSize=0, borderBits=1)
    return darkness(drawing, corner_mm)


def darkness(drawing: Any, corner_mm: Array) -> Any:
    """Darkness from a drawing, 4 px a mm, whose upper left corner lies at corner_mm."""

    def dark(x: Array, y: Array) -> Array:
        col, row = np.floor((x - corner_mm[0]) * 4).astype(int), np.floor((corner_mm[1] - y) * 4).astype(int)
        inside = (col >= 0) & (row >= 0) & (col < drawing.shape[1]) & (row < drawing.shape[0])
        clipped = drawing[np.clip(row, 0, drawing.shape[0] - 1), np.clip(col, 0, drawing.shape[1] - 1)]
        return np.asarray(inside & (clipped < 128))

    return dark


def charuco_picture(spec: specs.CharucoSpec, homography: Array) -> Array:
    """OpenCV's own drawing of a board, photographed."""
    count = spec.columns * spec.rows // 2
    numbers = np.arange(spec.first_id, spec.first_id + count)
    size, dictionary = (spec.columns, spec.rows), specs.aruco_dictionary(spec.dictionary)
    drawing = cv2.aruco.CharucoBoard(size, spec.square_mm, spec.marker_mm, dictionary, numbers)
    drawing.setLegacyPattern(bool(spec.legacy))
    width, height = spec.columns * spec.square_mm, spec.rows * spec.square_mm
    corner = np.array([-spec.square_mm, height - spec.square_mm])
    return take_picture(spec, homography, printed(drawing, spec, (width, height), corner))


def april_grid_dark(spec: specs.AprilGridSpec, quarter_turns: int = 0) -> Any:
    """Kalibr's board of OpenCV's markers, each turned so often: squares at all corners, the first at the lower left."""
    side, gap = round(4 * spec.marker_mm), round(4 * spec.gap_mm)
    drawing = np.full((spec.rows * (side + gap) + gap, spec.columns * (side + gap) + gap), 255, np.uint8)
    for row, column in np.ndindex(spec.rows + 1, spec.columns + 1):
        top, left = row * (side + gap), column * (side + gap)
        drawing[top : top + gap, left : left + gap] = 0
        if row < spec.rows and column < spec.columns:
            number = spec.first_marker + (spec.rows - 1 - row) * spec.columns + column
            marker = cv2.aruco.generateImageMarker(specs.aruco_dictionary(spec.dictionary), number, side, borderBits=2)
            where = np.s_[top + gap : top + gap + side, left + gap : left + gap + side]
            drawing[where] = np.rot90(marker, quarter_turns)
    corner = np.array([-spec.gap_mm, spec.rows * (spec.marker_mm + spec.gap_mm)])
    return darkness(drawing, corner)


def squares_dark(spec: specs.SquareGridSpec) -> Any:
    """Dark where both coordinates, from the lower left square's corner, lie in a square."""
    step = spec.square_mm + spec.gap_mm

    def dark(x: Array, y: Array) -> Array:
        inside = (x > 0) & (x < spec.columns * step) & (y > 0) & (y < spec.rows * step)
        return np.asarray(inside & (x % step < spec.square_mm) & (y % step < spec.square_mm))

    return dark


def tile_boards(spec: specs.BoardSpec, is_dark: Any, shown: tuple[float, ...], fineness: int = 4) -> Array:
    """Boards of one kind side by side, upright, at 1 mm a pixel times the scale in which each is shown."""
    extent = np.ptp([point[:2] for point in spec.object_points().values()], axis=0) + 60.0
    width, height = int(extent[0]), int(extent[1])

    def light(col: Array, row: Array) -> Array:
        col, row = np.broadcast_arrays(col, row)
        which = np.clip(col // width, 0, len(shown) - 1).astype(int)
        scale = np.array(shown)[which]
        x, y = (col - which * width - 30.0) / scale, (height - row - 30.0) / scale
        return np.asarray(1.0 - is_dark(x, y))

    clean = draw(light, width * len(shown), height, 0.8, fineness=fineness)
    return 8000 + 30000 * clean + np.random.default_rng(4).normal(0, 300, clean.shape)
