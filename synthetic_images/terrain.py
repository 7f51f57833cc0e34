"""Terrain with smooth relief, and the intersection of image rays with it.

This gives true homologous points: the ray through a pixel of one frame is intersected with the terrain, and the point
is projected into another frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetic_images.film import FrameGeometry
from synthetic_images.projection import ray_from_camera
from synthetic_images.scene import Scene

Array = NDArray[np.float64]

WAVES = 8
WAVELENGTHS = (0.15, 0.6)  # range, fraction of the ground width of a frame
NEWTON_STEPS = 30
MET = 1e-10  # relative size of the last step at convergence


@dataclass(frozen=True, eq=False)
class Terrain:
    """Terrain Z = ground + sum of sines. amplitudes: (w,); waves: (w, 2), rad per object unit; phases_rad: (w,)."""

    ground: float
    amplitudes: Array
    waves: Array
    phases_rad: Array

    def heights(self, plan: Array) -> Array:
        """(n,) heights at (X, Y), (n, 2)."""
        return np.asarray(self.ground + np.sin(plan @ self.waves.T + self.phases_rad) @ self.amplitudes)

    def slopes(self, plan: Array) -> Array:
        """(n, 2) derivatives of the heights with respect to X and Y."""
        return np.asarray((np.cos(plan @ self.waves.T + self.phases_rad) * self.amplitudes) @ self.waves)

    def intersections(self, station: Array, rays: Array) -> Array:
        """(n, 3) intersections of rays (n, 3) from a station (3,) with the terrain, by Newton's method; nan without."""
        fall = np.where(rays[:, 2] < 0.0, rays[:, 2], np.nan)
        reach = (self.ground - station[2]) / fall
        step = np.zeros_like(reach)
        for _ in range(NEWTON_STEPS):
            places = station + reach[:, None] * rays
            above = places[:, 2] - self.heights(places[:, :2])
            closing = rays[:, 2] - np.sum(self.slopes(places[:, :2]) * rays[:, :2], axis=1)
            step = above / closing
            reach = reach - step
            if not (np.abs(step) > MET * np.abs(reach)).any():
                break
        reach[~(np.abs(step) <= MET * np.abs(reach))] = np.nan
        return np.asarray(station + reach[:, None] * rays)


def scene_terrain(scene: Scene) -> Terrain:
    """Terrain of a scene; a plane if it has no relief."""
    generator = np.random.default_rng([scene.seed, 3])
    directions = generator.uniform(0, 2 * np.pi, WAVES)
    lengths = ground_width(scene) * generator.uniform(*WAVELENGTHS, WAVES)
    waves = np.stack([np.cos(directions), np.sin(directions)], axis=1) * (2 * np.pi / lengths)[:, None]
    amplitudes = generator.normal(size=WAVES)
    amplitudes *= scene.relief * np.sqrt(2.0) / np.linalg.norm(amplitudes)  # a sine's mean square is 1/2
    return Terrain(scene.ground, amplitudes, waves, generator.uniform(0, 2 * np.pi, WAVES))


def ground_width(scene: Scene) -> float:
    """Ground width of the longer side of a vertical frame, object units."""
    height = abs(scene.images[0].exterior[2] - scene.ground)
    return max(scene.camera.frame_mm) * height / scene.camera.principal_distance_mm


def object_from_pixel(geometry: FrameGeometry, pixels: Array) -> Array:
    """(n, 3) terrain points imaged at pixels (n, 2) of a frame; nan where there are none."""
    station = np.asarray(geometry.image.exterior[:3])
    camera_mm = geometry.camera_from_scan(pixels)
    rays = ray_from_camera(geometry.scene.camera, geometry.image.exterior, camera_mm)
    return scene_terrain(geometry.scene).intersections(station, rays)


def transferred(pixels: Array, start: FrameGeometry, end: FrameGeometry) -> Array:
    """Transfer pixels (n, 2) of a frame via the terrain to pixels (n, 2) of another; nan if not imaged there."""
    return end.pixel_from_object(object_from_pixel(start, pixels))
