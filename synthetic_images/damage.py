"""Dust, scratches and hairs on the film, as areas in pixels with their own tones."""

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area, stroke
from synthetic_images.film import turn
from synthetic_images.scene import SceneFilm

Array = NDArray[np.float64]

DUST_VERTICES = 12


def damage(film: SceneFilm, width_px: int, height_px: int, generator: np.random.Generator) -> list[tuple[Area, float]]:
    """Defects of one frame: area in (column, row) and tone; dust and hairs are dark, scratches light."""
    size = np.array([width_px, height_px], float)
    dust = [(_speck(size, generator), 0.0) for _ in range(film.dust)]
    scratches = [(_scratch(size, generator), 0.95) for _ in range(film.scratches)]
    hairs = [(_hair(size, generator), 0.05) for _ in range(film.hairs)]
    return dust + scratches + hairs


def _speck(size: Array, generator: np.random.Generator) -> Area:
    """Irregular grain of dust with a radius of about 1 to 5 px."""
    radius = np.minimum(generator.lognormal(0.6, 0.5), 6.0) * generator.uniform(0.7, 1.3, DUST_VERTICES)
    angle = np.arange(DUST_VERTICES) * (2 * np.pi / DUST_VERTICES)
    return (generator.random(2) * size + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1),)


def _scratch(size: Array, generator: np.random.Generator) -> Area:
    """Long fine line, nearly straight, close to the direction of film transport."""
    start, length = generator.random(2) * size, generator.uniform(0.1, 0.6) * size.max()
    direction = generator.normal(0.0, 0.1) + generator.integers(2) * np.pi
    along = np.linspace(0.0, length, 24)
    wander = np.cumsum(generator.normal(0.0, 0.3, along.size))
    path = np.stack([along, wander], axis=1) @ turn(direction).T + start
    return stroke(path, generator.uniform(0.6, 1.6))


def _hair(size: Array, generator: np.random.Generator) -> Area:
    """Curled line."""
    length = generator.uniform(30.0, 150.0)
    bend = np.cumsum(generator.normal(0.0, 0.12, 40)) + generator.uniform(0, 2 * np.pi)
    steps = np.stack([np.cos(bend), np.sin(bend)], axis=1) * (length / 40)
    return stroke(generator.random(2) * size + np.cumsum(steps, axis=0), generator.uniform(1.0, 2.0))
