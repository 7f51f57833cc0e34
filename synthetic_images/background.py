"""Image background: a plain or rough wall, or an aerial view of fields, woods and roads."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from synthetic_images.film import FrameGeometry
from synthetic_images.scene import Scene
from synthetic_images.terrain import ground_width, object_from_pixel

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

TEXEL_PX = 3.0  # px of the scan per texture pixel
LEAST_TEXTURE_PX = 1024
MOST_TEXTURE_PX = 3072  # px; making it takes 0.3 GB; in frames of more than about 9000 px it repeats
PARCEL_PX = 90  # texture px, approximate width of a parcel
MARGIN_PX = 256  # texture px; hardly any pixel is farther from the nearest seed of a parcel
NODE_PX = 8  # px, spacing of the places at which the texture's coordinates are computed; in between interpolated
BEND_WAVES, BEND_TEXELS = 6, 0.5  # sines along each axis that bend the texture, and their amplitude
BEND_WAVELENGTHS = (20.0, 40.0)  # texture px, their range


@dataclass(frozen=True, eq=False)
class Background:
    """Periodic texture, bent so that its pixels do not come at regular distances in a scan: interpolation between them
    would otherwise show as that of a scan that was enlarged.

    Attributes
    ----------
    texture : fractions of full scale.
    texel : size of its pixels, object units or mm on film.
    waves, phases_rad : (2, BEND_WAVES, 2), rad per texture px, and (2, BEND_WAVES) of the sines that bend it along its
        columns and rows.
    """

    scene: Scene
    texture: Picture
    texel: float
    waves: Array
    phases_rad: Array

    def rows(self, geometry: FrameGeometry, row0: int, height: int) -> Picture:
        """(height, width) background of rows from row0 on, as if the whole scan were exposed."""
        if self.scene.background == "plain":
            return np.full((height, geometry.width_px), self.texture[0, 0], np.float32)
        first = row0 // NODE_PX
        rows = np.arange(first - 1, (row0 + height - 1) // NODE_PX + 3) * NODE_PX
        columns = np.arange(-1, (geometry.width_px - 1) // NODE_PX + 3) * NODE_PX
        nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
        plan = np.nan_to_num(self._bent(self._plan(geometry, nodes) / self.texel))  # rays above the horizon
        plan -= plan.min(axis=0) // len(self.texture) * len(self.texture)  # single precision is enough within it
        coordinates = plan.T.reshape(2, len(rows), len(columns)).astype(np.float32)
        coordinates = _midpoints(_midpoints(coordinates).transpose(0, 2, 1)).transpose(0, 2, 1)
        inner = coordinates[:, row0 - first * NODE_PX :][:, :height, : geometry.width_px]
        x, y = np.mod(inner, np.float32(len(self.texture)))  # cv2 takes no more than 32767
        return np.asarray(cv2.remap(self.texture, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP), np.float32)

    def _plan(self, geometry: FrameGeometry, pixels: Array) -> Array:
        """(n, 2) places of pixels (n, 2) on a wall, in mm on film, or of their rays' intersections with the terrain,
        which include distortion, film and relief."""
        if self.scene.background == "wall":
            return geometry.straight_camera_from_scan(pixels)
        return object_from_pixel(geometry, pixels)[:, :2]

    def _bent(self, texels: Array) -> Array:
        """(n, 2) places on the bent texture of such on the plane one."""
        bends = [
            np.sin(texels @ waves.T + phases).sum(axis=1)
            for waves, phases in zip(self.waves, self.phases_rad, strict=True)
        ]
        return np.asarray(texels + BEND_TEXELS * np.stack(bends, axis=1))


def _midpoints(nodes: Picture) -> Picture:
    """Interpolate the last axis from every NODE_PX-th pixel to every pixel, by cubic Lagrange polynomials through four
    nodes; the first and the last two nodes serve as support only."""
    t = np.arange(NODE_PX) / NODE_PX
    weights = np.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ]
    )
    fours = np.lib.stride_tricks.sliding_window_view(nodes, 4, axis=-1)
    return np.asarray((fours @ weights.astype(nodes.dtype)).reshape(*nodes.shape[:-1], -1))


def scene_background(scene: Scene) -> Background:
    """Background of all frames of a scene."""
    tones = scene.tones
    texel = TEXEL_PX * max(scene.scanner.pitch_um) / 1000
    if scene.background == "plain":
        return Background(scene, np.full((8, 8), tones.background, np.float32), texel, *_bends(scene))
    generator = np.random.default_rng([scene.seed, 2])
    if scene.background == "wall":
        size = LEAST_TEXTURE_PX
        pattern = 0.8 * _rough(generator, size, 0.6) + 0.6 * _rough(generator, size, 1.6)
    else:
        texel *= ground_width(scene) / max(scene.camera.frame_mm)
        pattern = _landscape(generator, _texture_size(_block_width(scene) / texel))
    pattern = np.clip(pattern, -3.0, 3.0)
    shares = np.clip(tones.background + tones.contrast * pattern, 0.0, 1.0)
    return Background(scene, shares.astype(np.float32), texel, *_bends(scene))


def _bends(scene: Scene) -> tuple[Array, Array]:
    """Waves and phases of the sines that bend the texture."""
    generator = np.random.default_rng([scene.seed, 7])
    directions, phases = generator.uniform(0, 2 * np.pi, (2, 2, BEND_WAVES))
    numbers = 2 * np.pi / generator.uniform(*BEND_WAVELENGTHS, (2, BEND_WAVES))
    return np.stack([np.cos(directions), np.sin(directions)], axis=-1) * numbers[..., None], phases


def _block_width(scene: Scene) -> float:
    """Longer side of the ground covered by all frames, taken as vertical; object units."""
    stations = np.array([image.exterior[:2] for image in scene.images])
    return float(np.ptp(stations, axis=0).max()) + ground_width(scene)


def _texture_size(width_px: float) -> int:
    """Power of two that is at least width_px, within limits."""
    return int(np.clip(2 ** np.ceil(np.log2(width_px)), LEAST_TEXTURE_PX, MOST_TEXTURE_PX))


def _landscape(generator: np.random.Generator, size: int) -> Picture:
    """Parcels of different tones, woods, and roads along some parcel borders.

    Single precision and in-place operations, so that it takes no more memory than rendering a large frame.
    """
    parcels, road, count = _parcels(generator, size)
    tones, are_woods = generator.normal(0.0, 0.7, count).astype(np.float32), generator.random(count) < 0.3
    pattern = tones[parcels]
    pattern += np.float32(0.45) * _rough(generator, size, 1.3)
    pattern += np.float32(0.2) * _rough(generator, size, 0.0)
    wood = np.float32(0.9) * _rough(generator, size, 0.7) - np.float32(0.9)
    np.copyto(pattern, wood, where=are_woods[parcels])
    pattern += np.float32(1.4) * cv2.GaussianBlur(road.astype(np.float32), (0, 0), 0.7)
    pattern -= pattern.mean(dtype=np.float64)
    return pattern


def _parcels(generator: np.random.Generator, size: int) -> tuple[NDArray[np.int16], NDArray[np.bool_], int]:
    """Parcel index of each pixel (Voronoi cells of random seeds), mask of the roads, and number of parcels."""
    count = round((size / PARCEL_PX) ** 2)
    places = generator.choice(size**2, count, replace=False)
    owner = np.full(size**2, -1, np.int16)
    owner[places] = np.arange(count)
    straight, distance = _nearest(np.pad(owner.reshape(size, size), MARGIN_PX, mode="wrap"))
    # Slightly winding borders, as in nature.
    along = np.arange(MARGIN_PX, MARGIN_PX + size, dtype=np.float32)
    x, y = _rough(generator, size, 1.4), _rough(generator, size, 1.4)
    x *= 5
    x += along[None, :]
    y *= 5
    y += along[:, None]
    parcels = cv2.remap(straight, x, y, cv2.INTER_NEAREST)
    near = cv2.remap(distance, x, y, cv2.INTER_LINEAR) < PARCEL_PX
    road = (cv2.morphologyEx(parcels, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0) & near
    return np.asarray(parcels, np.int16), np.asarray(road, np.bool_), count


def _nearest(owner: NDArray[np.int16]) -> tuple[NDArray[np.int16], Picture]:
    """Owner of the nearest pixel that has one (0 and up), and the distance to it, for every pixel."""
    distance, labels = cv2.distanceTransformWithLabels(
        (owner < 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner_of_label = np.zeros(int(labels.max()) + 1, np.int16)
    owned = owner >= 0
    owner_of_label[labels[owned]] = owner[owned]
    return owner_of_label[labels], np.asarray(distance, np.float32)


def _rough(generator: np.random.Generator, size: int, exponent: float) -> Picture:
    """Periodic noise of unit RMS with amplitudes proportional to frequency to the power -exponent."""
    white = np.empty((size, size), np.float32)
    for row in white:
        row[:] = generator.standard_normal(size)
    spectrum = fft.rfft2(white, overwrite_x=True)
    columns = np.fft.rfftfreq(size)
    for along, frequency in zip(spectrum, np.fft.fftfreq(size), strict=True):
        away = np.hypot(frequency, columns)
        away[away == 0.0] = np.inf if exponent else 1.0
        along *= (away**-exponent).astype(np.float32)
    noise = np.asarray(fft.irfft2(spectrum, (size, size), overwrite_x=True), np.float32)
    mean, deviation = cv2.meanStdDev(noise)
    noise -= np.float32(mean.item())
    noise /= np.float32(deviation.item())
    return noise
