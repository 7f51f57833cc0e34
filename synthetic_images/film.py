"""Transformation from camera coordinates via film and scanner to pixels."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area
from synthetic_images.bend import ScannerBend
from synthetic_images.projection import camera_from_object
from synthetic_images.scene import Scene, SceneFilm, SceneImage, SceneTakingLens

Array = NDArray[np.float64]

WAVES = 6  # sine waves of the smooth deformation
LENS_STEPS = 12  # iterations of the inversion of a taking lens; each reduces the error by a factor of ten or more
INVERSION_STEPS = 5  # iterations of the inversion of the smooth deformation; each by a factor of about ten thousand


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Geometry of one frame: mapping between camera frame, object and scan.

    Attributes
    ----------
    width_px, height_px : size of the scan.
    comparator_from_camera : (3, 3) homography; exact without smooth film deformation, scanner error and taking lens.
    amplitudes_mm, waves_per_mm : (WAVES, 2) amplitudes and wave vectors of the smooth film deformation, a sum of sines.
    phases_rad : (WAVES,) its phases.
    """

    scene: Scene
    image: SceneImage
    width_px: int
    height_px: int
    comparator_from_camera: Array
    amplitudes_mm: Array
    waves_per_mm: Array
    phases_rad: Array

    def pixel_from_camera(self, camera_mm: Array) -> Array:
        """Convert camera coordinates (n, 2), mm, to column and row (n, 2)."""
        film = camera_mm + self.deformation_mm(camera_mm)
        comparator = _projected(self.comparator_from_camera, film)
        if self.bend.terms_um:
            comparator = self.bend.scan_from_bed(comparator)
        pixels = np.asarray(comparator * self._pixel_per_mm, np.float64)
        lens = self.scene.scanner.lens
        return pixels if lens is None else self._distort(lens, pixels)

    def _distort(self, lens: SceneTakingLens, pixels: Array) -> Array:
        """Distort ideal pixel coordinates (n, 2) by the taking lens (OpenCV's formulas)."""
        middle = (self.width_px - 1) / 2, (self.height_px - 1) / 2
        center = np.asarray(lens.center_px or middle)
        x, y = ((pixels - center) / lens.focal_px).T
        r2 = x * x + y * y
        radial = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
        distorted_x = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
        distorted_y = y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
        return np.asarray(np.stack([distorted_x, distorted_y], axis=1) * lens.focal_px + center, np.float64)

    def pixel_from_object(self, points: Array) -> Array:
        """Project object points (n, 3) to column and row (n, 2); nan if not imaged."""
        return self.pixel_from_camera(camera_from_object(self.scene.camera, self.image.exterior, points))

    def camera_from_scan(self, pixels: Array) -> Array:
        """Convert column and row (n, 2) to camera coordinates (n, 2), the inverse of `pixel_from_camera`."""
        lens, observed = self.scene.scanner.lens, pixels
        if lens is not None:
            for _ in range(LENS_STEPS):
                pixels = pixels + observed - self._distort(lens, pixels)
        if self.bend.terms_um:
            pixels = self.bend.bed_from_scan(pixels / self._pixel_per_mm) * self._pixel_per_mm
        film = self.straight_camera_from_scan(pixels)
        camera_mm = film
        for _ in range(INVERSION_STEPS):
            camera_mm = film - self.deformation_mm(camera_mm)
        return np.asarray(camera_mm)

    def straight_camera_from_scan(self, pixels: Array) -> Array:
        """Convert column and row to camera coordinates by the homography alone, without film deformation, scanner error
        and taking lens."""
        return _projected(self.camera_from_pixel, pixels)

    def pixel_area(self, camera_mm: Area) -> Area:
        return tuple(self.pixel_from_camera(outline) for outline in camera_mm)

    def deformation_mm(self, camera_mm: Array) -> Array:
        """(n, 2) displacement by the smooth film deformation at camera coordinates (n, 2)."""
        return np.asarray(np.sin(camera_mm @ self.waves_per_mm.T + self.phases_rad) @ self.amplitudes_mm)

    @cached_property
    def bend(self) -> ScannerBend:
        return scanner_bend(self.scene)

    @cached_property
    def camera_from_pixel(self) -> Array:
        """(3, 3) homography from (column, row, 1) to the camera frame, without film deformation and scanner error."""
        return self.camera_from_comparator @ np.diag([*(1 / self._pixel_per_mm), 1.0])

    @cached_property
    def camera_from_comparator(self) -> Array:
        """(3, 3) true film transformation, to be estimated by an adjustment."""
        matrix = np.linalg.inv(self.comparator_from_camera)
        return np.asarray(matrix / matrix[2, 2], np.float64)

    @cached_property
    def _pixel_per_mm(self) -> Array:
        return np.array([1000.0, -1000.0]) / self.scene.scanner.pitch_um


def frame_geometry(scene: Scene, index: int) -> FrameGeometry:
    """Geometry of one frame: film transformation, then mirroring, rotation and position on the scanner bed."""
    image, film = scene.images[index], scene.images[index].film
    whole_px, height_px = _scan_size(scene, image)
    first_px, end_px = (round(share * whole_px) for share in image.part)
    pitch_mm = np.asarray(scene.scanner.pitch_um) / 1000
    center = np.array([(whole_px - 1) / 2 - first_px, -(height_px - 1) / 2]) * pitch_mm
    mirror = np.diag([-1.0, 1.0]) if image.pose.endswith("m") else np.eye(2)
    bed_from_film = turn(image.turn_rad) @ _quarter_turn(image.pose) @ mirror
    film_from_camera = np.eye(3)
    film_from_camera[:2, :2] = turn(film.rotation_rad) @ [[film.scale[0], film.shear_rad], [0.0, film.scale[1]]]
    bed_from_photograph = np.eye(3)
    bed_from_photograph[:2, :2] = bed_from_film
    shift = bed_from_film @ np.asarray(film.shift_mm) + center + np.asarray(image.offset_mm)
    bed_from_photograph[:2, 2] = shift
    frames = [each.frame for each in scene.images]  # all scans of a frame share its deformation
    generator = np.random.default_rng([scene.seed, frames.index(image.frame), 1])
    directions = generator.uniform(0, 2 * np.pi, WAVES)
    waves = 2 * np.pi / (generator.uniform(0.6, 1.6, WAVES) * max(scene.camera.frame_mm))
    rms_mm = scene.film.deformation_um / 1000
    return FrameGeometry(
        scene=scene,
        image=image,
        width_px=end_px - first_px,
        height_px=height_px,
        comparator_from_camera=bed_from_photograph @ photograph_from_film(scene.film) @ film_from_camera,
        # The mean square of a sine is 1/2, and those of the waves add up.
        amplitudes_mm=generator.normal(size=(WAVES, 2)) * rms_mm * np.sqrt(2 / WAVES),
        waves_per_mm=np.stack([np.cos(directions), np.sin(directions)], axis=1) * waves[:, None],
        phases_rad=generator.uniform(0, 2 * np.pi, WAVES),
    )


def photograph_from_film(film: SceneFilm) -> Array:
    """(3, 3) homography of a film photographed at its own scale by a camera tilted around a line in the film."""
    tilt_rad, direction = np.deg2rad(film.tilt_deg), turn(np.deg2rad(film.tilt_direction_deg))
    tilted = np.diag([np.cos(tilt_rad), 1.0, 1.0])
    tilted[2, 0] = np.sin(tilt_rad) / film.photographed_from_mm
    along = np.eye(3)
    along[:2, :2] = direction
    return np.asarray(along @ tilted @ along.T, np.float64)


def _projected(matrix: Array, points: Array) -> Array:
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:], np.float64)


def scanner_bend(scene: Scene) -> ScannerBend:
    """Geometric error of the scene's scanner, over a square bed that holds the scans of all frames in any
    orientation."""
    return ScannerBend(scene.scanner.bend_um, max(scene.camera.frame_mm) + 2 * scene.scanner.margin_mm)


def turn(angle_rad: float) -> Array:
    """(2, 2) counter-clockwise rotation."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def _quarter_turn(pose: str) -> Array:
    """(2, 2) exact counter-clockwise rotation of a scan orientation (pose)."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), int(pose.rstrip("m")) // 90)


def _scan_size(scene: Scene, image: SceneImage) -> tuple[int, int]:
    size_mm = np.asarray(scene.camera.frame_mm) + 2 * scene.scanner.margin_mm
    if int(image.pose.rstrip("m")) % 180:
        size_mm = size_mm[::-1]
    size_px = np.ceil(size_mm * 1000 / np.asarray(scene.scanner.pitch_um) - 1e-9).astype(int)
    return int(size_px[0]), int(size_px[1])
