"""Ames Stereo Pipeline: a .tsai file per image, with the distortion models TSAI or FISHEYE, which are OpenCV's."""

from pipeline.exchange.block import Block
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.pinhole import BROWN, PinholeFrame, pinhole_frames, pinholes_written

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; R is camera to world",
    "ASP, docs/pinholemodels.rst (the file, its R, TSAI and FISHEYE as OpenCV's); src/asp/Camera/CsmModel.cc, "
    "toCsmPixel: ASP's pixel (0, 0) is CSM's (0.5, 0.5), the centre of the first one",
)


def write(block: Block, options: ExportOptions) -> Written:
    """Write NAME.tsai for each image; c and principal point in mm, with the pitch in mm."""
    frames, left_out = pinhole_frames(block, options, (BROWN,), "asp")
    return pinholes_written(
        {f"{frame.frame.image}.tsai": _tsai(frame) for frame in frames},
        frames,
        left_out,
        "C and R are in the project's object coordinates. ASP's tools expect earth-centred ones: give it cameras "
        "of a project in such coordinates, or transform them (convert_pinhole_model, bundle_adjust with control).",
        lost="the marks",
    )


def _tsai(frame: PinholeFrame) -> str:
    pitch = frame.canvas.pitch_mm
    model, terms = "TSAI", dict(zip(BROWN, frame.lens.named(BROWN).tolist(), strict=True))
    if frame.lens.fisheye:
        model, terms = "FISHEYE", dict(zip(("k1", "k2", "k3", "k4"), frame.lens.fisheye, strict=True))
    interior = zip(("fu", "fv", "cu", "cv"), (frame.interior_px(CONVENTION) * pitch).tolist(), strict=True)
    lines = [
        "VERSION_4",
        "PINHOLE",
        *(f"{name} = {value!r}" for name, value in interior),
        "u_direction = 1 0 0",
        "v_direction = 0 1 0",
        "w_direction = 0 0 1",
        f"C = {' '.join(map(repr, frame.station.tolist()))}",
        f"R = {' '.join(map(repr, frame.rotation.T.ravel().tolist()))}",
        f"pitch = {pitch!r}",
        model,
        *(f"{term} = {value!r}" for term, value in terms.items()),
    ]
    return "\n".join(lines) + "\n"
