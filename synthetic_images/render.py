"""Rendering of a scene to scans/*.tif and truth.json.

A frame is painted in strips to limit memory: areas imaged by the scanner's optics and pixels, then grain and noise,
then quantisation.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from synthetic_images.background import Background, scene_background
from synthetic_images.frame import RenderedFrame, make_frame
from synthetic_images.grain import grain, white_noise
from synthetic_images.scene import Scene, SceneImage, UnsharpMask
from synthetic_images.tiff import Grey, write_tiff
from synthetic_images.tone_curve import coded
from synthetic_images.truth import Truth, truth_json

Picture = NDArray[np.float32]
Progress = Callable[[str, int, int], None]

STRIP_PX = 256
BORDER_PX = 2.0  # px, sigma of the Gaussian of the border's texture
CHANNEL_GAINS = (1.0, 0.94, 0.8)  # R, G, B: a slightly warm film


def render_scene(scene: Scene, out_dir: Path, progress: Progress | None = None) -> Truth:
    """Write the scans of all frames and truth.json to a folder, each file atomically.

    The result is reproducible: the same scene gives the same bytes.

    Parameters
    ----------
    progress : called with the image's name, the number of strips done and the number of strips of the scene.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    background = scene_background(scene)
    frames = [make_frame(scene, index) for index in range(len(scene.images))]
    total = sum(_strip_count(frame) for frame in frames)
    done = 0
    (out_dir / "scans").mkdir(parents=True, exist_ok=True)
    for index, frame in enumerate(frames):
        geometry = frame.truth.geometry

        def counted(strips: Iterator[Grey], image: SceneImage = geometry.image) -> Iterator[Grey]:
            nonlocal done
            for strip in strips:
                yield strip
                done += 1
                if progress is not None:
                    progress(image.name, done, total)

        path = out_dir / "scans" / f"{geometry.image.name}.tif"
        strips = counted(grey_strips(frame, index, background))
        with _whole(path) as temporary:
            write_tiff(temporary, strips, geometry.width_px, geometry.height_px, STRIP_PX, scene.scanner)
    truth = Truth(scene, tuple(frame.truth for frame in frames))
    with _whole(out_dir / "truth.json") as temporary:
        temporary.write_text(truth_json(truth), encoding="utf-8")
    return truth


def grey_strips(frame: RenderedFrame, index: int, background: Background) -> Iterator[Grey]:
    """Yield the grey values of the file in strips of STRIP_PX rows: (rows, width) or (rows, width, 3)."""
    geometry, scene = frame.truth.geometry, background.scene
    mask = scene.scanner.sharpen
    for row0 in range(0, geometry.height_px, STRIP_PX):
        end = min(row0 + STRIP_PX, geometry.height_px)
        first, last = max(row0 - mask.reach_px, 0), min(end + mask.reach_px, geometry.height_px)
        shares = _painted(frame, index, background, first, last - first)
        if scene.film.grain > 0.0:
            seed = (scene.seed, index, 3)
            shares += scene.film.grain * grain(seed, first, last - first, geometry.width_px, scene.film.grain_px)
        codes = _sharpened(_coded(shares, scene, index, first), mask)
        yield _digitised(codes[row0 - first : end - first], scene)


def _painted(frame: RenderedFrame, index: int, background: Background, row0: int, height: int) -> Picture:
    """Fractions of full scale, blurred by the scanner's optics and averaged over the area of each pixel."""
    geometry, scene = frame.truth.geometry, background.scene
    window = (row0, height, geometry.width_px, scene.scanner.blur_px)
    exposed = np.zeros((height, geometry.width_px), np.float32)
    for part in frame.exposed:
        touched = part.rows(*window)
        if touched is not None:
            exposed[touched[0]] += touched[1]
    np.minimum(exposed, 1.0, out=exposed)  # pockets overlap the frame
    border = _border(scene, index, row0, height, geometry.width_px)
    picture = border + exposed * (background.rows(geometry, row0, height) - border)
    for paint in frame.paints:
        touched = paint.rows(*window)
        if touched is not None:
            place, cover = touched
            if paint.inside_frame:
                cover = cover * exposed[place]
            tone = border[place] if paint.tone == scene.tones.border else paint.tone
            picture[place] += cover * (tone - picture[place])
    return np.asarray(picture, np.float32)


def _border(scene: Scene, index: int, row0: int, height: int, width_px: int) -> Picture:
    """Unexposed film with its texture."""
    border = np.full((height, width_px), scene.tones.border, np.float32)
    if scene.tones.border_contrast > 0.0:
        border += scene.tones.border_contrast * grain((scene.seed, index, 5), row0, height, width_px, BORDER_PX)
    return border


def _coded(shares: Picture, scene: Scene, index: int, row0: int) -> Picture:
    """(rows, width, channels) codes: channel gains, negative, noise and tone curve."""
    scanner = scene.scanner
    channels = shares[:, :, None] * np.asarray(CHANNEL_GAINS, np.float32) if scanner.colour else shares[:, :, None]
    if scanner.negative:
        channels = 1.0 - channels
    if scanner.noise > 0.0:
        height, width = shares.shape
        noise = [white_noise((scene.seed, index, 4, c), row0, height, width) for c in range(channels.shape[2])]
        channels = channels + scanner.noise * np.stack(noise, axis=2)
    return coded(np.clip(channels, 0.0, 1.0), scanner.tone)


def _sharpened(codes: Picture, mask: UnsharpMask) -> Picture:
    """Apply an unsharp mask, before clipping to the bit depth."""
    if mask.amount == 0.0:
        return codes
    blurred = gaussian_filter(codes, (mask.radius_px, mask.radius_px, 0.0), mode="nearest")
    return np.asarray(codes + np.float32(mask.amount) * (codes - blurred), np.float32)


def _digitised(channels: Picture, scene: Scene) -> Grey:
    """Grey values: white as zero if set, clipped and quantised to the bit depth."""
    scanner = scene.scanner
    channels = np.clip(channels, 0.0, 1.0)
    if scanner.white_is_zero:
        channels = 1.0 - channels
    full_scale = 2**scanner.bit_depth - 1
    grey = np.rint(np.clip(channels * full_scale, 0.0, full_scale))
    grey = grey if scanner.colour else grey[:, :, 0]
    return np.asarray(grey, np.uint16 if scanner.bit_depth == 16 else np.uint8)


def _strip_count(frame: RenderedFrame) -> int:
    return -(-frame.truth.geometry.height_px // STRIP_PX)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Temporary file, renamed to `path` if the block succeeds, else removed."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
