"""BINGO's image coordinates in mm, corrected for film deformation and lens distortion."""

import numpy as np

from adjust.functional_model.lens import Lens
from pipeline.exchange.block import Block, Frame, WholeFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.types import Array

CONVENTION = Convention(
    (float("nan"), float("nan")),
    "no pixels: x right, y up in mm from the fiducial frame's middle, of a digital camera from its principal point",
    "support.pix4d.com, article 203590305: a line with image and camera, one a point with x and y in mm from the "
    "centre of the image, an empty line behind each image. Which way y points it does not say: up, as everywhere in "
    "photogrammetry",
)


def write(block: Block, options: ExportOptions) -> Written:
    """Write bingo.txt with the corrected coordinates of every point of every adjusted image."""
    block.needs_orientation("bingo")
    unknown = (scan.image for scan in block.frames if scan.model is None)
    left_out = [f"{image}: it has no part in the adjustment, so its film is not known." for image in unknown]
    texts = []
    for frame in block.whole(scan for scan in block.frames if scan.model is not None):
        text, folded = _image(frame, _origin(block, frame))
        texts.append(text)
        left_out += folded
    assert block.adjustment is not None
    cameras = {frame.camera: frame for frame in block.frames if frame.lens is not None}
    interior = [_interior(name, frame.lens, _origin(block, frame)) for name, frame in cameras.items() if frame.lens]
    return Written(
        {"bingo.txt": "\n".join(texts)},
        (
            "standard deviations (BINGO takes them by groups)",
            "poses and object points, whose files no public text describes",
            "fiducial marks",
        ),
        tuple(interior),
        tuple(left_out),
    )


def _origin(block: Block, frame: Frame) -> Array:
    """Centre of the fiducial frame; for a digital camera, which has none, the principal point."""
    if block.camera_file(frame.camera).fiducials or frame.lens is None:
        return np.zeros(2)
    return frame.lens.interior[1:]


def _interior(camera: str, lens: Lens, origin: Array) -> str:
    x, y = lens.interior[1:] - origin
    return f"Camera {_word(camera)}: c = {lens.interior[0]:.5f} mm, principal point {x:.5f}, {y:.5f} mm, no distortion."


def _image(frame: WholeFrame, origin: Array) -> tuple[str, list[str]]:
    """Lines of an image, and the points whose distortion cannot be removed."""
    assert frame.model is not None
    marks = frame.observed(fiducials=False)
    refined, found = frame.model.lens.ideal_from_observed(frame.camera_mm(marks))
    lines = [f"{_word(frame.image)} {_word(frame.camera)}"]
    for mark, (x, y), usable in zip(marks, (refined - origin).tolist(), found, strict=True):
        lines += [f"{_word(mark.point)} {x:.6f} {y:.6f}"] if usable else []
    lost = [
        f"{frame.image}, point {mark.point}: the lens folds there."
        for mark, ok in zip(marks, found, strict=True)
        if not ok
    ]
    return "\n".join(lines) + "\n", lost


def _word(name: str) -> str:
    """The name without blanks, which separate the words of a line."""
    return "_".join(name.split())
