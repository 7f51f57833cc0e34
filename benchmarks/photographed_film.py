"""Film photographed by a tilted camera with distortion, measured as projective and as affine: errors and sigmas."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from small_scene import CROSS

from benchmarks.harness import Row, rms
from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import BelievedFilm, FiducialOptions
from measure.flags import Status
from measure.marks.shapes import Bar, FiducialLayout, LayoutMark, MarkShape, Ring
from measure.scans.opening import open_scan
from measure.tone.curve import LINEAR
from pipeline.files.opencv_file import read_lens
from pipeline.rendered.scene_project import taking_camera_yaml
from synthetic_images.render import render_scene
from synthetic_images.scene import (
    DiskField,
    DiskTarget,
    Scene,
    SceneCamera,
    SceneDistortion,
    SceneFiducial,
    SceneFilm,
    SceneImage,
    SceneScanner,
    SceneTakingLens,
    Tones,
)

TILTS_DEG = (0.5, 1.0, 2.0, 5.0)
K1 = (0.0, -0.1)  # of a normal lens, whose focal length is about the diagonal of the image
FOCAL_PX = 6000.0
HALF_MM, PITCH_UM = 106.0, 60.0
PLACES = [(HALF_MM * x, HALF_MM * y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
MARK = MarkShape(
    (Ring((0.0, 0.0), 0.5, 0.1), Bar((-0.4, 0.0), (0.4, 0.0), 0.1), Bar((0.0, -0.4), (0.0, 0.4), 0.1)), "light"
)
LAYOUT = FiducialLayout(
    tuple(LayoutMark(str(k), place, (0.002, 0.002), MARK) for k, place in enumerate(PLACES)), (228.0, 228.0)
)


COLUMNS = {
    "tilt_deg": "g", "k1": "g", "model": "", "measured": "d", "of": "d", "largest_px": ".3f", "error_over_claim": ".2f",
    "problems": "",
}  # fmt: skip


def cells(frames: int = 4) -> Iterator[Row]:
    every = product(TILTS_DEG, K1, ("projective", "affine"))
    yield from ({"tilt_deg": tilt, "k1": k1, "model": model, "frames": frames} for tilt, k1, model in every)


def case(tilt_deg: float, k1: float, model: str, frames: int, seed: int) -> Row:
    rows = [photographed(seed + number, tilt_deg, 40.0 * number, k1, model) for number in range(frames)]
    errors, sigmas = (np.concatenate([row[k] for row in rows]) for k in (0, 1))
    return {
        "measured": sum(row[2] for row in rows),
        "of": len(PLACES) * frames,
        "largest_px": float(np.abs(errors).max(initial=0)),
        "error_over_claim": rms(errors) / rms(sigmas),
        "problems": "; ".join(sorted({str(problem)[:60] for row in rows for problem in row[3]})),
    }


def photographed(
    seed: int, tilt_deg: float, direction_deg: float, k1: float, model: str
) -> tuple[np.ndarray, np.ndarray, int, tuple[str, ...]]:
    """Errors and standard deviations of coordinates, px, number of measured marks, and problems of the frame."""
    fiducials = tuple(SceneFiducial(str(k), place, CROSS) for k, place in enumerate(PLACES))
    camera = SceneCamera("film", (228.0, 228.0), 150.0, (0.0, 0.0), SceneDistortion("torlegard", {}), fiducials)
    taken_by = SceneTakingLens(FOCAL_PX, k1=k1)
    scanner = SceneScanner((PITCH_UM, PITCH_UM), margin_mm=6.0, noise=0.01, lens=taken_by)
    film = SceneFilm("projective", tilt_deg=tilt_deg, tilt_direction_deg=direction_deg)
    targets = DiskField((DiskTarget("1", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),), 0.001)
    image = SceneImage("f", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    scene = Scene("film", seed, camera, targets, (image,), scanner, film, Tones(contrast=0.0))
    with TemporaryDirectory() as folder:
        truth = render_scene(scene, Path(folder)).frames[0]
        (Path(folder) / "lens.yaml").write_text(taking_camera_yaml(scene, taken_by), encoding="utf-8")
        lens = read_lens(Path(folder) / "lens.yaml", PITCH_UM)
        with open_scan(next(Path(folder).rglob("*.tif"))) as scan:
            options = FiducialOptions("0", film_model=model, lens=lens)
            frame = measure_fiducials(scan.replace_tone(LINEAR), LAYOUT, (PITCH_UM, PITCH_UM), options)
    checked = check_frames([frame], LAYOUT, [(PITCH_UM, PITCH_UM)], BelievedFilm(model=model, lens=lens)).frames[0]
    errors, sigmas = [], []
    for mark in checked.marks:
        if mark.status is Status.MEASURED and mark.center_px is not None and mark.covariance is not None:
            errors.append(mark.center_px - truth.fiducials[mark.point].center_px)
            sigmas.append(np.sqrt(np.diag(mark.covariance.px2)))
    shape = (-1, 2)
    problems = tuple(str(problem) for problem in checked.problems)
    return np.reshape(errors, shape), np.reshape(sigmas, shape), len(errors), problems
