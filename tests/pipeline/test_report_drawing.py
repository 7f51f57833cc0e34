"""Numbers as printed, ticks, and pictures whose overlays stand where the mark is."""

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from measure.flags import NO_REASON, Status
from pipeline.drawing.svg import Axes, round_step, ticks
from pipeline.report import Thumbnail
from pipeline.report.data import Mark, natural
from pipeline.report.frame_views import SIZE_PX, arrow_scale, mark_picture
from pipeline.report.numbers import fixed, significant, value_and_sigma
from pipeline.report.vectors import VectorField, all_images_plot, plane
from pipeline.results.assessment_record import ResidualRecord

RESIDUAL = ResidualRecord("f1", "7", "target", *[0.0] * 16)


@pytest.mark.parametrize(
    ("value", "sigma", "printed"),
    [
        (153.66401, 0.00412, ("153.6640", "0.0041")),
        (-1.7427e-7, 3.1e-9, ("−1.743 × 10⁻⁷", "0.031 × 10⁻⁷")),
        (1234.5, 37.0, ("1234", "37")),
        (0.0, 2e-6, ("0.0 × 10⁻⁶", "2.0 × 10⁻⁶")),
        (153.6, 0.0, ("153.6", "fixed")),
        (153.6, None, ("153.6", "–")),
        (None, None, ("–", "–")),
    ],
)
def test_a_value_is_printed_to_what_its_sigma_supports(
    value: float | None, sigma: float | None, printed: tuple[str, str]
) -> None:
    assert value_and_sigma(value, sigma) == printed


def test_plain_numbers() -> None:
    assert fixed(-0.5, 1) == "−0.5"
    assert fixed(0.5, 1, sign=True) == "+0.5"
    assert fixed(-0.04, 1, sign=True) == "+0.0"
    assert fixed(float("nan")) == "–"
    assert significant(4.1e6, 3) == "4100000"
    assert significant(2.5e-9, 2) == "2.5 × 10⁻⁹"


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0.0, 1.0, 6) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(-3.0, 17.0, 5) == pytest.approx([0.0, 5.0, 10.0, 15.0])
    assert [round_step(size) for size in (1.0, 1.99, 2.0, 4.9, 0.051, 70.0)] == pytest.approx([1, 1, 2, 2, 0.05, 50])


def test_a_logarithmic_axis_has_its_powers_at_equal_distances() -> None:
    axes = Axes((1.0, 100.0), (0.1, 10.0), width=400.0, left=0.0, right=0.0, x_is_log=True, y_is_log=True)
    assert axes.x([1.0, 10.0, 100.0]) == pytest.approx([0.0, 200.0, 400.0])
    drawn = axes.grid("x", "y")
    assert all(f">{tick}</text>" in drawn for tick in ("0.1", "0.2", "0.5", "1", "2", "5", "10"))
    assert ">3</text>" not in drawn


def test_names_sort_by_their_numbers() -> None:
    assert sorted(["f10", "f2", "a", "10", "9", "x²"], key=natural) == ["9", "10", "a", "f2", "f10", "x²"]


def mark(center: tuple[float, float], residual: ResidualRecord | None = None) -> Mark:
    return Mark("f1", "7", "target", Status.MEASURED, NO_REASON, np.array(center), None, None, residual)


def spot(center: tuple[float, float], origin: tuple[int, int], size: int) -> NDArray[np.float64]:
    x, y = np.arange(size) + origin[0] - center[0], np.arange(size) + origin[1] - center[1]
    return np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / 8.0)


def crosshair(picture: str) -> NDArray[np.float64]:
    """The point that the four ticks point at, in page pixels."""
    path = re.search(r'<path d="([^"]+)" class="hair', picture)
    assert path
    ends = np.array(re.findall(r"-?\d+\.?\d*", path[1]), dtype=float).reshape(-1, 2)
    return np.asarray(ends.mean(axis=0))


def take_picture(picture: str) -> NDArray[np.float64]:
    data = re.search(r"base64,([^\"]+)", picture)
    assert data
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(float)


@pytest.mark.parametrize("step", [1, 3])
def test_the_crosshair_stands_on_the_spot_in_the_picture(step: int) -> None:
    """An independent centroid of the stored picture, whose pixel (0, 0) covers the page from 0 to SIZE_PX / width."""
    center, origin, size = (1203.37, 807.81), (1183, 790), 45
    full = spot(center, origin, size)
    pixels = full.reshape(size // step, step, size // step, step).mean(axis=(1, 3))
    middle = (step - 1) / 2.0
    thumbnail = Thumbnail(1000.0 + 50.0 * pixels, (origin[0] + middle, origin[1] + middle), float(step))
    svg = mark_picture(mark(center), thumbnail, 1.0, SIZE_PX)
    stored = take_picture(svg)
    weights = stored - stored.min()
    at = np.array(
        [
            (weights.sum(axis=0) * (np.arange(stored.shape[1]) + 0.5)).sum(),
            (weights.sum(axis=1) * (np.arange(stored.shape[0]) + 0.5)).sum(),
        ]
    )
    expected = at / weights.sum() * SIZE_PX / stored.shape[1]
    np.testing.assert_allclose(crosshair(svg), expected, atol=0.15)


def test_a_large_picture_is_stored_small_and_a_flat_one_is_no_error() -> None:
    svg = mark_picture(mark((50.0, 50.0)), Thumbnail(np.full((300, 200), 7, np.uint16), (0.0, 0.0)), 1.0, 92.0)
    assert take_picture(svg).shape == (92, 61)


def test_the_residual_points_up_where_y_grows() -> None:
    """The comparator's y points up, the page's down."""
    residual = replace(RESIDUAL, vx_um=3.0, vy_um=4.0)
    thumbnail = Thumbnail(np.eye(41), (0.0, 0.0))
    svg = mark_picture(mark((20.0, 20.0), residual), thumbnail, 2.0, SIZE_PX)
    x0, y0, x1, y1 = np.array(
        re.findall(r"-?\d+\.?\d*", re.findall(r'<path d="([^"]+)" class="arrow"', svg)[0]), dtype=float
    )
    assert (x1 - x0, y1 - y0) == pytest.approx((6.0, -8.0), abs=0.11)


def test_the_longest_arrow_fits() -> None:
    rows = [replace(RESIDUAL, vx_um=v) for v in (1.0, -13.0)]
    scale = arrow_scale([mark((0.0, 0.0), row) for row in rows])
    assert 13.0 <= 13.0 * scale <= 34.0
    assert arrow_scale([replace(mark((0.0, 0.0)))]) == 1.0


def test_vectors_over_the_camera_are_to_scale() -> None:
    """A point at (50, 20) mm of a frame of 200 x 100 mm, moved by (10, -5) µm."""
    row = replace(RESIDUAL, camera_x_mm=50.0, camera_y_mm=20.0, camera_vx_um=10.0, camera_vy_um=-5.0)
    field = VectorField.from_residuals([row])
    on = plane(field.places_mm, (200.0, 100.0), 560.0)
    assert on.height_px < on.width_px
    (x, y), (right, top) = on.page(np.array([(50.0, 20.0), (60.0, 30.0)]))
    assert (right - x, y - top) == pytest.approx((10.0 * on.px_per_mm, 10.0 * on.px_per_mm))
    picture = all_images_plot(field, on, 4.0)
    stroke = re.search(r'<path d="([^"]+)" class="vector target"', picture)
    assert stroke
    x0, y0, x1, y1 = np.array(re.findall(r"-?\d+\.?\d*", stroke[1]), dtype=float)
    assert (x1 - x0, y1 - y0) == pytest.approx((40.0, 20.0), abs=0.11)
    assert field.scale(60.0) == 5.0


def test_the_vectors_of_a_digital_camera_stand_in_what_was_observed() -> None:
    """Its coordinates begin at the picture's corner, so that a frame about the origin would be half empty."""
    places_mm = np.array([(1.0, -20.0), (31.0, -2.0)])
    (left, low), (right, high) = plane(places_mm, (36.0, 24.0), 560.0).corners_mm
    assert (left, right, low, high) == pytest.approx((1.0, 31.0, -20.0, -2.0), abs=0.7)


def test_a_thumbnail_refuses_what_is_no_picture() -> None:
    with pytest.raises(ValueError, match="rows and columns"):
        Thumbnail(np.zeros((0, 5)), (0.0, 0.0))
    with pytest.raises(ValueError, match="step_px must be positive"):
        Thumbnail(np.zeros((5, 5)), (0.0, 0.0), 0.0)
