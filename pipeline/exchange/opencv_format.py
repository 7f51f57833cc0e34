"""OpenCV's YAML: camera matrix, distortion and pose of every image, of its resampled frame."""

import cv2
import numpy as np

from pipeline.exchange.block import Block
from pipeline.exchange.convention import Convention, ExportOptions, Written
from pipeline.exchange.pinhole import BROWN, PRISMS, PinholeFrame, misfit_note, pinhole_frames
from pipeline.opencv_check.opencv_model import NAMES

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "OpenCV, calib3d: projectPoints, and undistort, whose maps count from the first pixel's centre",
)


def write(block: Block, options: ExportOptions) -> Written:
    """NAME.yml an image, for cv2.FileStorage."""
    frames, left_out = pinhole_frames(block, options, (BROWN, PRISMS, NAMES[4:]), "opencv")
    return Written(
        {f"{frame.frame.image}.yml": _yaml(frame) for frame in frames},
        ("the film transformation (it is that of the resampled frames)", "all standard deviations", "the marks"),
        (misfit_note(frames),) if frames else (),
        tuple(left_out),
    )


def _yaml(frame: PinholeFrame) -> str:
    fx, fy, cx, cy = frame.interior_px + np.array([0.0, 0.0, *CONVENTION.first_pixel_px])
    used = np.flatnonzero(frame.lens.values[4:])
    count = next(size for size in (5, 8, 12, 14) if size > (used.max() if used.size else 0))
    storage = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    storage.write("image", frame.picture)
    storage.write("camera", frame.frame.camera)
    storage.write("image_width", frame.canvas.width_px)
    storage.write("image_height", frame.canvas.height_px)
    storage.write("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", frame.lens.values[4 : 4 + count].reshape(1, -1))
    storage.write("R", frame.rotation)
    storage.write("t", frame.translation.reshape(3, 1))
    return str(storage.releaseAndGetString())
