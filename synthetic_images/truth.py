"""True values of a rendered scene, and truth.json, which names them as adjustment.json does and adds all positions."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetic_images.film import FrameGeometry, scanner_bend
from synthetic_images.scene import PARAMETERS, Scene, Writing
from synthetic_images.targets import field_targets
from synthetic_images.terrain import scene_terrain

Array = NDArray[np.float64]

SCANNER = "1"  # name of the only scanner, as in a project


@dataclass(frozen=True, eq=False)
class Position:
    """True position of a mark in a scan.

    Attributes
    ----------
    center_px : (2,) column and row of the mark's point; for a target the projection of its centre.
    figure_px : (2,) centre of the imaged figure; for a disk that of its ellipse.
    hidden : why it is not visible; "" if it is.
    """

    center_px: Array
    figure_px: Array
    hidden: str = ""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Geometry of a frame and the positions of its fiducials and targets by id.

    Targets that are not imaged in or near the frame have no position.
    """

    geometry: FrameGeometry
    fiducials: Mapping[str, Position]
    targets: Mapping[str, Position]


@dataclass(frozen=True, eq=False)
class Truth:
    """Scene with the true values of its frames."""

    scene: Scene
    frames: tuple[FrameTruth, ...]

    def frame(self, name: str) -> FrameTruth:
        return next(frame for frame in self.frames if frame.geometry.image.name == name)


def truth_json(truth: Truth) -> str:
    """Content of truth.json."""
    camera = truth.scene.camera
    content = {
        "scene": truth.scene.name,
        "pixel_origin": "(col, row) = (0, 0) is the centre of the top-left pixel; rows count downwards",
        "comparator": "x = col * pitch_x, y = -row * pitch_y, mm",
        "cameras": {camera.name: _camera(truth.scene)},
        "scanners": {SCANNER: _scanner(truth.scene)} if truth.scene.scanner.bend_um else {},
        "terrain": _terrain(truth.scene),
        "images": {frame.geometry.image.name: _frame(frame) for frame in truth.frames},
        "points": {
            target.id: _values(("X", "Y", "Z"), target.center) | {"normal": target.normal.tolist()}
            for target in field_targets(truth.scene.field)
        },
    }
    return json.dumps(content, indent=1) + "\n"


def _terrain(scene: Scene) -> dict[str, Any] | None:
    """Terrain between the targets: Z = ground + sum of amplitude sin(wave · (X, Y) + phase)."""
    if scene.background != "terrain":
        return None
    terrain = scene_terrain(scene)
    return {
        "ground": terrain.ground,
        "amplitude": terrain.amplitudes.tolist(),
        "wave": terrain.waves.tolist(),
        "phase_rad": terrain.phases_rad.tolist(),
    }


def _scanner(scene: Scene) -> dict[str, Any]:
    bend = scanner_bend(scene)
    return {
        "center_mm": list(bend.center_mm),
        "half_mm": [bend.size_mm / 2] * 2,
        "terms": {name: {"value": value / 1000} for name, value in bend.terms_um.items()},
    }


def _camera(scene: Scene) -> dict[str, Any]:
    camera, distortion = scene.camera, scene.camera.distortion
    parameters = {name: distortion.parameters.get(name, 0.0) for name in PARAMETERS[distortion.family]}
    return {
        "frame_mm": list(camera.frame_mm),
        "principal_distance_mm": {"value": camera.principal_distance_mm},
        "principal_point_mm": _values(("x", "y"), camera.principal_point_mm),
        "distortion": {"family": distortion.family, "decentering": distortion.decentering, "r0_mm": distortion.r0_mm}
        | _values(tuple(parameters), tuple(parameters.values())),
        "fiducials": {fiducial.id: _values(("x_mm", "y_mm"), fiducial.xy_mm) for fiducial in camera.fiducials},
    }


def _frame(frame: FrameTruth) -> dict[str, Any]:
    geometry = frame.geometry
    image = geometry.image
    projective = geometry.scene.film.kind == "projective"
    exterior = np.array([*image.exterior[:3], *np.rad2deg(image.exterior[3:])])
    return {
        "width_px": geometry.width_px,
        "height_px": geometry.height_px,
        "pitch_um": list(geometry.scene.scanner.pitch_um),
        "pose": image.pose,
        "writing": [_written(writing, geometry) for writing in image.writing],
        "transformation": {"kind": geometry.scene.film.kind}
        | _values(("a1", "a2", "a3"), geometry.camera_from_comparator[0][[2, 0, 1]])
        | _values(("b1", "b2", "b3"), geometry.camera_from_comparator[1][[2, 0, 1]])
        | (_values(("c1", "c2"), geometry.camera_from_comparator[2][:2]) if projective else {}),
        "deformation_um": geometry.scene.film.deformation_um,
        "exterior": _values(("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg"), exterior),
        "fiducials": {
            id: {"col_px": float(position.center_px[0]), "row_px": float(position.center_px[1])} | _visibility(position)
            for id, position in frame.fiducials.items()
        },
        "targets": {
            id: {
                "col_px": float(position.center_px[0]),
                "row_px": float(position.center_px[1]),
                "ellipse_col_px": float(position.figure_px[0]),
                "ellipse_row_px": float(position.figure_px[1]),
            }
            | _visibility(position)
            for id, position in frame.targets.items()
        },
    }


def _written(writing: Writing, geometry: FrameGeometry) -> dict[str, Any]:
    """Text of a line of writing, the position of its centre, and its orientation in the camera frame."""
    col, row = geometry.pixel_from_camera(np.array([writing.xy_mm]))[0].tolist()
    return {
        "text": writing.text,
        "col_px": col,
        "row_px": row,
        "turn_deg": writing.turn_deg,
        "mirrored": writing.mirrored,
        "height_mm": writing.height_mm,
    }


def _visibility(position: Position) -> dict[str, Any]:
    return {"visible": not position.hidden, "reason": position.hidden}


def _values(names: tuple[str, ...], values: Any) -> dict[str, Any]:
    return {name: {"value": float(value)} for name, value in zip(names, values, strict=True)}
