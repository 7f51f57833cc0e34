"""What is known of an image before its targets are: the camera as its file gives it, on the film as its fiducials show
it lying in the scan."""

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.transformation import Film
from pipeline.files.camera_file import CameraFile
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

_IN_THE_PICTURE = 0.4  # of its size: a principal point is no farther from its middle, unless much was cut off


def camera_model(camera: CameraFile, measured: MeasuredScan) -> ImageModel | str:
    """The image with its orientation left open; or what is missing. Where the camera's file gives no principal
    distance, it is the scan's diagonal, as good as nothing."""
    film = _camera_from_comparator(camera, measured)
    if film is None:
        return "too few fiducials were measured to know where the camera's frame lies in the scan"
    middle = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0, measured.pitch_um)
    c = camera.principal_distance_mm or 2.0 * float(np.linalg.norm(middle))
    x0, y0 = middle if camera.principal_point_mm is None else camera.principal_point_mm
    lens = Lens(camera.distortion, np.array([c, x0, y0], dtype=np.float64), camera.distortion.values)
    return ImageModel(lens, np.eye(3), np.zeros(3), film)


def misplaced_principal_point(camera: CameraFile, measured: MeasuredScan) -> str:
    """A sentence where a camera without fiducials has a principal point that is hardly in the picture: as if it counted
    from the middle of the scan."""
    if camera.fiducials or camera.principal_point_mm is None:
        return ""
    size = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]), measured.pitch_um)
    if (np.abs(np.array(camera.principal_point_mm) - size / 2.0) < _IN_THE_PICTURE * np.abs(size)).all():
        return ""
    given, middle = (f"[{x:.4g}, {y:.4g}]" for x, y in (camera.principal_point_mm, (size / 2.0).tolist()))
    return (
        f"principal_point_mm = {given} is at the edge of the scan or beyond it. A camera without fiducials has it in "
        f"comparator coordinates, from the scan's top-left pixel, x to the right and y up: the middle of this scan is "
        f"{middle}. Give it so, or leave it out."
    )


def frame_mm(camera: CameraFile, model: ImageModel, measured: MeasuredScan) -> Array:
    """(2, 2) least and greatest camera coordinates of what the scan shows of the exposed frame."""
    last = np.array([measured.width_px - 1, measured.height_px - 1])
    corners = comparator_from_pixel(np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * last, measured.pitch_um)
    seen = model.camera_from_comparator(corners)
    if camera.fiducials and camera.frame_mm is not None:
        half = np.array(camera.frame_mm) / 2.0
        seen = np.clip(seen, -half, half)
    return np.stack([seen.min(axis=0), seen.max(axis=0)])


def _camera_from_comparator(camera: CameraFile, measured: MeasuredScan) -> Film | None:
    """The film as the measurement of the fiducials took it to be; none for a camera that has none."""
    if not camera.fiducials:
        return Film("none", np.zeros(0), np.zeros(2))
    if measured.frame.pixel_from_camera is None:
        return None
    places = np.linalg.inv(np.vstack([measured.frame.pixel_from_camera, [0.0, 0.0, 1.0]]))[:2]
    linear = places[:, :2] @ np.diag(pixel_from_comparator(np.ones(2), measured.pitch_um))
    return Film("affine", np.array([places[0, 2], *linear[0], places[1, 2], *linear[1]]), np.zeros(2))
