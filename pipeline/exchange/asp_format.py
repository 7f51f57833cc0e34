"""Ames Stereo Pipeline: a .tsai file an image, with its distortion TSAI or FISHEYE, which are OpenCV's."""

from pipeline.exchange.block import Block
from pipeline.exchange.convention import Convention, ExportOptions, Written
from pipeline.exchange.fitted_lens import BROWN
from pipeline.exchange.pinhole import PinholeFrame, misfit_note, pinhole_frames

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; R is camera to world",
    "ASP, docs/pinholemodels.rst (the file, its R, TSAI and FISHEYE as OpenCV's); src/asp/Camera/CsmModel.cc, "
    "toCsmPixel: ASP's pixel (0, 0) is CSM's (0.5, 0.5), the centre of the first one",
)


def write(block: Block, options: ExportOptions) -> Written:
    """NAME.tsai an image; c and principal point in mm, with the pitch in mm."""
    frames, left_out = pinhole_frames(block, options, (BROWN,), "asp", knows_fisheye=True)
    return Written(
        {f"{frame.frame.image}.tsai": _tsai(frame) for frame in frames},
        ("the film transformation (it is that of the resampled frames)", "all standard deviations", "the marks"),
        (
            *((misfit_note(frames),) if frames else ()),
            "C and R are in the project's object coordinates. ASP's tools expect earth-centred ones: give it cameras "
            "of a project in such coordinates, or transform them (convert_pinhole_model, bundle_adjust with control).",
        ),
        tuple(left_out),
    )


def _tsai(frame: PinholeFrame) -> str:
    pitch = frame.canvas.pitch_mm
    fx, fy, cx, cy = frame.interior_px
    col, row = CONVENTION.first_pixel_px
    name, terms = "TSAI", dict(zip(BROWN, frame.lens.named(BROWN).tolist(), strict=True))
    if frame.lens.fisheye:
        name, terms = "FISHEYE", dict(zip(("k1", "k2", "k3", "k4"), frame.lens.fisheye, strict=True))
    world = frame.rotation.T.ravel().tolist()
    lines = [
        "VERSION_4",
        "PINHOLE",
        f"fu = {float(fx * pitch)!r}",
        f"fv = {float(fy * pitch)!r}",
        f"cu = {float((cx + col) * pitch)!r}",
        f"cv = {float((cy + row) * pitch)!r}",
        "u_direction = 1 0 0",
        "v_direction = 0 1 0",
        "w_direction = 0 0 1",
        f"C = {' '.join(repr(float(value)) for value in frame.station)}",
        f"R = {' '.join(repr(value) for value in world)}",
        f"pitch = {pitch!r}",
        name,
        *(f"{term} = {value!r}" for term, value in terms.items()),
    ]
    return "\n".join(lines) + "\n"
