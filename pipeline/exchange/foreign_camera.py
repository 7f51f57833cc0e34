"""Cameras and poses of other programs as this one's."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Prior
from pipeline.errors import InputError
from pipeline.exchange.incoming import ForeignPose, ImportOptions
from pipeline.exchange.pinhole import Y_DOWN_Z_FORWARD
from pipeline.files.camera_file import DEFAULT_SIGMA_MM, CameraFile, GivenFiducial

Array = NDArray[np.float64]


def opencv_camera(
    path: Path,
    name: str,
    interior_px: tuple[float, ...],
    lens: Mapping[str, float],
    size_px: tuple[float, float] | None,
    options: ImportOptions,
    family: str = "opencv",
) -> CameraFile:
    """A camera in OpenCV's model, or its fisheye's, everything fixed; fx, fy, cx, cy (4,) in px from the first pixel's
    centre.

    Its principal point is in comparator coordinates of the picture, or from the picture's middle. Raises InputError
    where the pitch, or the size that the middle needs, is not known.
    """
    if options.pitch_um is None:
        raise InputError(f"{path}: counts in pixels: say with --pitch-um how many um one has.")
    fx, fy, cx, cy = interior_px
    pitch = options.pitch_um / 1000.0
    first = np.zeros(2)
    if options.from_middle:
        if size_px is None:
            raise InputError(
                f"{path}: does not say the picture's size, so its middle is not known. Leave --from-middle out."
            )
        first = (np.array(size_px) - 1.0) / 2.0
    x0, y0 = (np.array([cx, cy]) - first) * (pitch, -pitch)
    given = {key: Prior(float(value)) for key, value in {"b1": fx / fy - 1.0, **lens}.items() if value != 0.0}
    return CameraFile(
        path=path,
        name=name,
        frame_mm=None if size_px is None else (float(size_px[0] * pitch), float(size_px[1] * pitch)),
        principal_distance_mm=float(fy * pitch),
        principal_point_mm=(float(x0), float(y0)),
        principal_distance_sigma_mm=0.0,
        principal_point_sigma_mm=(0.0, 0.0),
        distortion=Distortion(family, given) if given or family != "opencv" else Distortion(),
        fiducials=(),
    )


def fiducial_camera(name: str, places: Mapping[str, Array]) -> CameraFile:
    """A camera of which only fiducial marks are known, mm: they may count from a frame's corner, so the principal point
    is sought from the middle of the marks."""
    xy = np.array(list(places.values()))
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    sigma = (DEFAULT_SIGMA_MM, DEFAULT_SIGMA_MM)
    fiducials = [GivenFiducial(id, (float(x), float(y)), sigma, None, True) for id, (x, y) in places.items()]
    return CameraFile(
        path=Path(name),
        name=name,
        frame_mm=None,
        principal_distance_mm=None,
        principal_point_mm=(float(middle[0]), float(middle[1])),
        principal_distance_sigma_mm=math.inf,
        principal_point_sigma_mm=(math.inf, math.inf),
        distortion=Distortion(),
        fiducials=tuple(fiducials),
    )


def foreign_pose(image: str, rotation: Array, translation: Array) -> ForeignPose:
    """From axes x right, y down, z forward: `camera = rotation X + translation`."""
    return ForeignPose(image, np.asarray(Y_DOWN_Z_FORWARD @ rotation), np.asarray(-rotation.T @ translation))
