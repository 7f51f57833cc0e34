"""A small scene that tests render, with one thing changed: nine disks, seen obliquely by a camera of four crosses."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from synthetic_images import scene as scenes
from synthetic_images.areas import bar, ring
from synthetic_images.render import render_scene
from synthetic_images.truth import Truth

Array = NDArray[np.float64]

CROSS = scenes.DrawnMark(
    (ring((0.0, 0.0), 0.5, 0.1), bar((-0.4, 0.0), (0.4, 0.0), 0.1), bar((0.0, -0.4), (0.0, 0.4), 0.1))
)
PLACES = {"a": (4.0, -4.1), "b": (-4.2, -4.0), "c": (-4.0, 4.3), "d": (3.9, 3.8)}
CAMERA = scenes.SceneCamera(
    "small",
    (12.0, 12.0),
    14.0,
    (0.05, -0.04),
    scenes.SceneDistortion("torlegard", {"k3": -2.0e-4, "p1": 3.0e-5}),
    tuple(scenes.SceneFiducial(id, xy, CROSS) for id, xy in PLACES.items()),
)
FIELD = scenes.DiskField(
    tuple(
        scenes.DiskTarget(f"{10 * i + j}", (0.55 * i, 0.55 * j, 0.1 * ((i + j) % 3)), (0.1, 0.05, 1.0))
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
    ),
    0.12,
    surround=0.0,
)
OBLIQUE = scenes.SceneImage("f", (1.2, -0.5, 3.2, 0.16, 0.34, 0.4))
SCANNER = scenes.SceneScanner((40.0, 40.0), margin_mm=1.0)


def scene(**changes: Any) -> scenes.Scene:
    plain = scenes.Scene(
        "test", 4, CAMERA, FIELD, (OBLIQUE,), SCANNER, scenes.SceneFilm(), scenes.Tones(contrast=0.0), pad_mm=1.2
    )
    return replace(plain, **changes)


def rendered(folder: Path, made: scenes.Scene) -> tuple[Array, Truth]:
    """The first scan's grey values as shares of full scale, and the truth."""
    truth = render_scene(made, folder)
    grey = tifffile.imread(folder / "scans" / f"{made.images[0].name}.tif")
    return np.asarray(grey, np.float64) / np.iinfo(grey.dtype).max, truth


def hidden_field() -> scenes.DiskField:
    return scenes.DiskField((scenes.DiskTarget("1", (0.0, 0.0, 50.0)),), 0.1)
