"""What the targets stand in: a plain or rough wall, or a landscape of fields, woods and roads seen from the air."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetic_images.film import FrameGeometry
from synthetic_images.projection import object_rotation
from synthetic_images.scene import Scene

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

TEXTURE_PX = 1024
PARCELS = 130
TEXEL_PX = 3.0  # scan pixels that one pixel of the texture covers


@dataclass(frozen=True, eq=False)
class Background:
    """A texture that repeats itself. texture: shares of full scale; texel: its pixel, object units or mm on film."""

    scene: Scene
    texture: Picture
    texel: float

    def rows(self, geometry: FrameGeometry, row0: int, height: int) -> Picture:
        """(height, width) of the scan from row0 on, as if the whole scan were exposed."""
        texture_from_pixel = self._texture_from_camera(geometry) @ geometry.camera_from_pixel
        texture_from_pixel = texture_from_pixel @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, row0], [0.0, 0.0, 1.0]])
        size = (geometry.width_px, height)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        picture = cv2.warpPerspective(self.texture, texture_from_pixel, size, None, flags, cv2.BORDER_WRAP)
        return np.asarray(picture, np.float32)

    def _texture_from_camera(self, geometry: FrameGeometry) -> Array:
        scale = np.diag([1 / self.texel, 1 / self.texel, 1.0])
        if self.scene.background != "terrain":
            return scale
        return np.asarray(scale @ _ground_from_camera(geometry))


def scene_background(scene: Scene) -> Background:
    """The background of all frames of a scene."""
    tones = scene.tones
    texel = TEXEL_PX * max(scene.scanner.pitch_um) / 1000
    if scene.background == "plain":
        return Background(scene, np.full((8, 8), tones.background, np.float32), texel)
    generator = np.random.default_rng([scene.seed, 2])
    if scene.background == "wall":
        pattern = 0.8 * _rough(generator, 0.6) + 0.6 * _rough(generator, 1.6)
    else:
        height = abs(scene.images[0].exterior[2] - scene.ground)
        texel *= height / scene.camera.principal_distance_mm
        pattern = _landscape(generator)
    pattern = np.clip(pattern, -3.0, 3.0)
    shares = np.clip(tones.background + tones.contrast * pattern, 0.0, 1.0)
    return Background(scene, shares.astype(np.float32), texel)


def _ground_from_camera(geometry: FrameGeometry) -> Array:
    """(3, 3) the plane Z = ground from x', y', 1 of the camera frame: rays without distortion, which no truth needs."""
    scene = geometry.scene
    x0, y0, z0, *angles = geometry.image.exterior
    px, py = scene.camera.principal_point_mm
    ray_from_camera = np.array([[1.0, 0.0, -px], [0.0, 1.0, -py], [0.0, 0.0, -scene.camera.principal_distance_mm]])
    ray = object_rotation(*angles).T @ ray_from_camera
    fall = scene.ground - z0
    return np.stack([x0 * ray[2] + fall * ray[0], y0 * ray[2] + fall * ray[1], ray[2]])


def _landscape(generator: np.random.Generator) -> Array:
    """Parcels with their own tones, woods, roads along some of their sides."""
    parcels, road = _parcels(generator)
    tone, wooded = generator.normal(0.0, 0.7, PARCELS)[parcels], (generator.random(PARCELS) < 0.3)[parcels]
    soil = tone + 0.45 * _rough(generator, 1.3) + 0.2 * _rough(generator, 0.0)
    wood = -0.9 + 0.9 * _rough(generator, 0.7)
    pattern = np.where(wooded, wood, soil) + 1.4 * cv2.GaussianBlur(road.astype(np.float64), (0, 0), 0.7)
    return np.asarray(pattern - pattern.mean())


def _parcels(generator: np.random.Generator) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Which parcel every pixel belongs to (that of the nearest of some random places), and where roads run."""
    places = generator.choice(TEXTURE_PX**2, PARCELS, replace=False)
    owner = np.full(TEXTURE_PX**2, -1)
    owner[places] = np.arange(PARCELS)
    around = np.pad(owner.reshape(TEXTURE_PX, TEXTURE_PX), TEXTURE_PX // 4, mode="wrap")
    free = (around < 0).astype(np.uint8)
    distance, labels = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owner_of_label = np.zeros(int(labels.max()) + 1, np.float32)
    owner_of_label[labels[around >= 0]] = around[around >= 0]
    straight = owner_of_label[labels]
    # Sides that wind a little, as they do on the ground.
    y, x = np.indices((TEXTURE_PX, TEXTURE_PX), np.float32) + np.float32(TEXTURE_PX // 4)
    x += (5 * _rough(generator, 1.4)).astype(np.float32)
    y += (5 * _rough(generator, 1.4)).astype(np.float32)
    parcels = cv2.remap(straight, x, y, cv2.INTER_NEAREST)
    near = cv2.remap(distance, x, y, cv2.INTER_LINEAR) < TEXTURE_PX / 12
    road = (cv2.morphologyEx(parcels, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0) & near
    return np.asarray(parcels, np.intp), np.asarray(road, np.bool_)


def _rough(generator: np.random.Generator, exponent: float) -> Array:
    """Noise of unit rms whose amplitude falls with frequency to the power `exponent`; it joins itself at the sides."""
    frequency = np.hypot(np.fft.fftfreq(TEXTURE_PX)[:, None], np.fft.rfftfreq(TEXTURE_PX)[None, :])
    frequency[0, 0] = np.inf if exponent else 1.0
    spectrum = np.fft.rfft2(generator.standard_normal((TEXTURE_PX, TEXTURE_PX))) * frequency**-exponent
    noise = np.fft.irfft2(spectrum, (TEXTURE_PX, TEXTURE_PX))
    return np.asarray((noise - noise.mean()) / noise.std())
