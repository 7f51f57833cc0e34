"""Camera files for other programs: OpenCV's camera.yaml and ROS's camera info."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.calibration.intrinsics import CameraIntrinsics
from pipeline.files.opencv_file import COVARIANCE
from pipeline.results.pixel_intrinsics import CENTRE

OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
FISHEYE_ORDER = ("k1", "k2", "k3", "k4")
OPENCV_COUNTS = (4, 5, 8, 12, 14)  # numbers of coefficients that OpenCV accepts


def camera_files(cameras: Sequence[CameraIntrinsics], out: Path, ros: bool) -> Iterator[tuple[Path, str]]:
    """Paths and texts of the files of all cameras: camera.yaml for a single one, else one file per camera, by its
    name."""
    for camera in cameras:
        stem = "camera" if len(cameras) == 1 else camera.pictures.name
        yield out / f"{stem}.yaml", opencv_yaml(camera)
        if ros:
            yield out / f"{stem}-ros.yaml", ros_yaml(camera)


def opencv_yaml(camera: CameraIntrinsics) -> str:
    """Text for cv2.FileStorage."""
    distortion = _distortion(camera)
    lines = ["%YAML:1.0", "---"]
    lines += [f"image_width: {camera.pictures.width_px}", f"image_height: {camera.pictures.height_px}"]
    lines += _opencv_matrix("camera_matrix", 3, _camera_matrix(camera))
    lines += _opencv_matrix("distortion_coefficients", 1, distortion)
    if camera.is_fisheye:
        lines.append('distortion_model: "fisheye"')
    lines += _opencv_matrix("std_deviations_fx_fy_cx_cy", 1, [camera.values[name].sigma for name in CENTRE])
    order = [*CENTRE, *(FISHEYE_ORDER if camera.is_fisheye else OPENCV_ORDER)[: len(distortion)]]
    lines += _opencv_matrix(COVARIANCE, len(order), camera.covariance_matrix(order).ravel().tolist())
    return "\n".join([*lines, f"avg_reprojection_error: {camera.rms_px:.10g}", ""])


def ros_yaml(camera: CameraIntrinsics) -> str:
    """Text of ROS's camera info: plumb_bob, rational_polynomial or equidistant."""
    distortion, matrix = _distortion(camera), _camera_matrix(camera)
    model = "equidistant" if camera.is_fisheye else "rational_polynomial" if len(distortion) == 8 else "plumb_bob"
    if model == "plumb_bob":
        distortion = [*distortion, 0.0][:5]
    projection = [value for row in range(3) for value in (*matrix[3 * row : 3 * row + 3], 0.0)]
    lines = [f"image_width: {camera.pictures.width_px}", f"image_height: {camera.pictures.height_px}"]
    lines += [f"camera_name: {camera.pictures.name}", *_ros_matrix("camera_matrix", 3, matrix)]
    lines += [f"distortion_model: {model}", *_ros_matrix("distortion_coefficients", 1, distortion)]
    lines += _ros_matrix("rectification_matrix", 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    return "\n".join([*lines, *_ros_matrix("projection_matrix", 3, projection), ""])


def _camera_matrix(camera: CameraIntrinsics) -> list[float]:
    fx, fy, cx, cy = (camera.values[name].value for name in CENTRE)
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _distortion(camera: CameraIntrinsics) -> list[float]:
    """Coefficients in OpenCV's order, in a number that OpenCV accepts."""
    order = FISHEYE_ORDER if camera.is_fisheye else OPENCV_ORDER
    last = max((order.index(name) + 1 for name in camera.values if name in order), default=0)
    count = next(count for count in OPENCV_COUNTS if count >= last)
    return [camera.values[name].value if name in camera.values else 0.0 for name in order[:count]]


def _opencv_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(f"{value:.17g}" if value else "0." for value in values)
    size = [f"   rows: {rows}", f"   cols: {len(values) // rows}"]
    return [f"{name}: !!opencv-matrix", *size, "   dt: d", f"   data: [ {data} ]"]


def _ros_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    data = ", ".join(map(repr, values))
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(values) // rows}", f"  data: [{data}]"]
