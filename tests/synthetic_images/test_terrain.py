"""Terrain: rays meet it where the projection, made on its own, sees it; and the picture shows the same."""

from dataclasses import replace

import numpy as np
import pytest

from synthetic_images.background import scene_background
from synthetic_images.film import frame_geometry
from synthetic_images.scene import (
    DiskField,
    Distortion,
    Film,
    FilmTransformation,
    Scanner,
    Scene,
    SceneCamera,
    SceneImage,
)
from synthetic_images.terrain import object_from_pixel, scene_terrain, transferred

BROWN = Distortion("brown", {"k1": 2e-6, "p1": 1e-5})
OPENCV = Distortion("opencv", {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "b1": 1e-3})


def crosswise(distortion: Distortion = BROWN, relief: float = 8.0) -> Scene:
    """Two small frames over hilly ground, the second turned and its scan mirrored."""
    film = FilmTransformation(scale=(1.0003, 0.9996), shear_rad=1e-4)
    return Scene(
        name="hills",
        seed=4,
        camera=SceneCamera("c", (40.0, 40.0), 30.0, (0.1, -0.05), distortion),
        field=DiskField((), 1.0),
        images=(
            SceneImage("a", (-20.0, 0.0, 300.0, 0.02, -0.03, 0.01), film=film),
            SceneImage("b", (30.0, 10.0, 310.0, -0.02, 0.04, 1.6), pose="90m", film=film),
        ),
        scanner=Scanner((100.0, 100.0)),
        film=Film(deformation_um=20.0),
        background="terrain",
        ground=15.0,
        relief=relief,
    )


@pytest.mark.parametrize("distortion", [BROWN, OPENCV, Distortion()])
def test_rays_lead_to_terrain_that_is_visible_at_the_same_pixel(distortion: Distortion) -> None:
    scene = crosswise(distortion)
    geometry = frame_geometry(scene, 1)
    pixels = np.random.default_rng(1).uniform(60.0, 440.0, (50, 2))
    places = object_from_pixel(geometry, pixels)
    assert np.allclose(places[:, 2], scene_terrain(scene).heights(places[:, :2]), atol=1e-7)
    assert np.abs(geometry.pixel_from_object(places) - pixels).max() < 1e-6


def test_relief_has_the_rms_that_is_requested_and_its_slopes_are_its_derivatives() -> None:
    terrain = scene_terrain(crosswise())
    plan = np.random.default_rng(2).uniform(-5e4, 5e4, (20000, 2))
    assert np.std(terrain.heights(plan)) == pytest.approx(8.0, rel=0.03)
    step = np.array([1e-3, 0.0])
    numeric = (terrain.heights(plan[:50] + step) - terrain.heights(plan[:50] - step)) / 2e-3
    assert np.allclose(terrain.slopes(plan[:50])[:, 0], numeric, atol=1e-6)


def test_the_same_terrain_has_the_same_tone_in_both_frames() -> None:
    scene = crosswise()
    background = scene_background(scene)
    first, second = (frame_geometry(scene, index) for index in (0, 1))
    a, b = (background.rows(each, 0, each.height_px).astype(float) for each in (first, second))
    columns, rows = (each.ravel() for each in np.meshgrid(np.arange(120, 380, 3), np.arange(120, 380, 3)))
    places = transferred(np.stack([columns, rows], axis=1).astype(float), first, second)
    inside = ((places > 2.0) & (places < 496.0)).all(axis=1)
    col, row = np.floor(places[inside]).astype(int).T
    fraction = places[inside] - np.floor(places[inside])
    view = sum(
        b[row + j, col + i] * np.abs(1 - i - fraction[:, 0]) * np.abs(1 - j - fraction[:, 1])
        for i in (0, 1)
        for j in (0, 1)
    )
    here = a[rows, columns][inside]
    assert np.corrcoef(here, view)[0, 1] > 0.98
    plane = replace(scene, relief=0.0)
    flat = transferred(np.array([[200.0, 220.0]]), frame_geometry(plane, 0), frame_geometry(plane, 1))
    hilly = transferred(np.array([[200.0, 220.0]]), first, second)
    assert np.linalg.norm(flat - hilly) > 0.5


def test_strips_of_the_terrain_join() -> None:
    scene = crosswise()
    background, geometry = scene_background(scene), frame_geometry(scene, 0)
    whole = background.rows(geometry, 0, 100)
    assert np.allclose(
        np.vstack([background.rows(geometry, 0, 37), background.rows(geometry, 37, 63)]), whole, atol=1e-3
    )
