"""Natural points of real ground: aerial photographs re-sampled into frames whose geometry is known.

python -m benchmarks natural_resampled SCANS_FOLDER

The inner part of every scan, freed of most of its own grain by a Gaussian of a pixel, is laid on hilly terrain and
photographed anew by the four frames of natural_points.py, at a pixel to a pixel (200 um, 1140 px). Every frame has a
blur, a grain and a noise of its own. What is real is the texture; that three photographs of one day differ in light,
shadows and traffic is not in it. Large scans are reduced.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.natural_points import CONDITIONS, HEADING, figures, scene
from synthetic_images.background import Background
from synthetic_images.film import FrameGeometry
from synthetic_images.frame import make_frame
from synthetic_images.render import grey_strips

Picture = NDArray[np.float32]

PITCH_UM = 200.0
GROUND_M = 3200.0  # that all frames together show
TEXELS = 3200  # a side: bilinear interpolation of the renderer asks for some a pixel
INNER = 0.82  # of a scan, without its border and marks
OWN_GRAIN_PX = 1.0
QUALITIES = (
    (0.5, 0.008, 0.003),
    (0.9, 0.012, 0.004),
    (0.7, 0.016, 0.006),
    (1.1, 0.010, 0.005),
)  # blur px, grain, noise


def main() -> None:
    """Print a row for every scan."""
    cv2.setNumThreads(1)
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path()
    scans = (
        sorted(path for path in folder.glob("*") if path.suffix in (".jpeg", ".jpg", ".tif")) if sys.argv[1:] else []
    )
    if not scans:
        print(f"No scans in {folder.absolute()}: skipped. Give a folder of aerial photographs.")
        return
    print(HEADING)
    for path in scans:
        with tempfile.TemporaryDirectory() as made:
            print(figures(path.stem, photographed(ground(path), Path(made)), Path(made)), flush=True)


def ground(path: Path) -> Picture:
    """(TEXELS, TEXELS) shares of full scale of a scan's inner square, its middle at the first texel, as if tiled."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise SystemExit(f"{path} is no picture")
    half = int(INNER * min(grey.shape) / 2)
    row, col = (size // 2 for size in grey.shape)
    inner = cv2.GaussianBlur(
        grey[row - half : row + half, col - half : col + half].astype(np.float32), (0, 0), OWN_GRAIN_PX
    )
    way = cv2.INTER_CUBIC if 2 * half < TEXELS else cv2.INTER_AREA
    texture = cv2.resize(inner, (TEXELS, TEXELS), interpolation=way) / 255.0
    return np.roll(texture, (TEXELS // 2, TEXELS // 2), axis=(0, 1)).astype(np.float32)


def photographed(texture: Picture, folder: Path) -> dict[str, FrameGeometry]:
    """Four frames of hilly ground of that texture, their scans in a folder."""
    hilly = scene(next(each for each in CONDITIONS if each.frames == 4), PITCH_UM)
    (folder / "scans").mkdir()
    texel = GROUND_M / TEXELS
    pixel_m = PITCH_UM / 1e6 * 1e4
    geometry = {}
    for index, (blur_px, grain, noise) in enumerate(QUALITIES):
        own = replace(hilly, film=replace(hilly.film, grain=grain), scanner=replace(hilly.scanner, noise=noise))
        frame = make_frame(own, index)
        seen = cv2.GaussianBlur(texture, (0, 0), blur_px * pixel_m / texel, borderType=cv2.BORDER_REFLECT)
        strips = grey_strips(frame, index, Background(own, seen.astype(np.float32), texel))
        name = frame.truth.geometry.image.name
        cv2.imwrite(str(folder / "scans" / f"{name}.tif"), np.concatenate(list(strips)))
        geometry[name] = frame.truth.geometry
    return geometry


if __name__ == "__main__":
    main()
