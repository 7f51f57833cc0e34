"""Readers of other programs' files, written from their own formulas: object points to pixels of their pictures, the
centre of the first pixel being (0, 0)."""

from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]


def opencv_px(folder: Path, image: str, points: Array) -> Array:
    """OpenCV reads and projects itself."""
    file = cv2.FileStorage(str(folder / f"{image}.yml"), cv2.FILE_STORAGE_READ)
    matrix, lens, turn, shift = (file.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients", "R", "t"))
    if file.getNode("distortion_model").string() == "fisheye":
        wide, _ = cv2.fisheye.projectPoints(points[:, None], cv2.Rodrigues(turn)[0], shift, matrix, lens)
        return np.asarray(wide.reshape(-1, 2), dtype=float)
    pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, matrix, lens)
    return np.asarray(pixels.reshape(-1, 2), dtype=float)


def colmap_px(folder: Path, image: str, points: Array) -> Array:
    """COLMAP reads and projects itself; its first pixel's centre is (0.5, 0.5)."""
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    found = next(each for each in model.images.values() if each.name == f"{image}.tif")
    in_camera = np.array([found.cam_from_world() * point for point in points])
    return np.asarray(found.camera.img_from_cam(in_camera) - 0.5)


def asp_px(folder: Path, image: str, points: Array) -> Array:
    """(u, v) = distorted (fu, fv) (x, y) / z + (cu, cv), over the pitch; TSAI as OpenCV's, of x / z, y / z; FISHEYE:
    theta_d / r of them, theta_d a polynomial of theta = arctan r."""
    lines = (folder / f"{image}.tsai").read_text().splitlines()
    assert lines[:2] == ["VERSION_4", "PINHOLE"]
    pairs = [line.split("=") for line in lines if "=" in line]
    given = {key.strip(): [float(part) for part in value.split()] for key, value in pairs}
    assert [given[axis] for axis in ("u_direction", "v_direction", "w_direction")] == np.eye(3).tolist()
    x, y, z = np.reshape(given["R"], (3, 3)).T @ (points - given["C"]).T
    if "TSAI" in lines:
        x, y = brown(x / z, y / z, *(given[name][0] for name in ("k1", "k2", "k3", "p1", "p2")))
    else:
        assert lines[-5] == "FISHEYE"
        r = np.hypot(x / z, y / z)
        theta = np.arctan(r)
        bent = theta * (1 + sum(given[f"k{n}"][0] * theta ** (2 * n) for n in (1, 2, 3, 4)))
        x, y = bent / r * x / z, bent / r * y / z
    pitch = given["pitch"][0]
    return np.column_stack([given["fu"][0] * x + given["cu"][0], given["fv"][0] * y + given["cv"][0]]) / pitch


def brown(x: Array, y: Array, k1: float, k2: float, k3: float, p1: float, p2: float) -> tuple[Array, Array]:
    """OpenCV's distortion of an ideal point."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def micmac_px(folder: Path, image: str, points: Array, before: str = "OIS-Reech_") -> Array:
    """X = R P + C; ideal = PP + F (x, y) / z; ModPhgrStd of the ideal pixel about CDist. Of ReSampFid's picture."""
    pose = ElementTree.parse(folder / "Ori-Reseau" / f"Orientation-{before}{image}.tif.xml").getroot()[0]
    outer = one(pose, "Externe")
    matrix = np.array([values(one(outer, "ParamRotation/CodageMatr"), f"L{i}") for i in (1, 2, 3)])
    x, y, z = matrix.T @ (points - values(outer, "Centre")).T
    camera = ElementTree.parse(folder / (pose.findtext("FileInterne") or "")).getroot()[0]
    assert camera.findtext("KnownConv") == "eConvApero_DistM2C"
    focal, point = values(camera, "F")[0], values(camera, "PP")
    ideal = point + focal * np.column_stack([x / z, y / z])
    lens = one(camera, "CalibDistortion/ModPhgrStd")
    radial = one(lens, "RadialePart")
    dx, dy = (ideal - values(radial, "CDist")).T
    r2 = dx * dx + dy * dy
    factor = sum(float(each.text or "") * r2**k for k, each in enumerate(radial.findall("CoeffDist"), 1))
    p1, p2, b1, b2 = (values(lens, name)[0] for name in ("P1", "P2", "b1", "b2"))
    off_x = dx * factor + (2 * dx * dx + r2) * p1 + 2 * dx * dy * p2 + b1 * dx + b2 * dy
    off_y = dy * factor + (2 * dy * dy + r2) * p2 + 2 * dx * dy * p1
    return np.asarray(ideal + np.column_stack([off_x, off_y]))


def micmac_affine(folder: Path, image: str) -> tuple[Array, Array]:
    """ReSampFid's unweighted fit: matrix (2, 2) and shift (2,) from scan pixels to camera mm with y down."""
    camera = micmac_marks(folder / "Ori-InterneScan" / "MeasuresCamera.xml")
    scan = micmac_marks(folder / "Ori-InterneScan" / f"MeasuresIm-{image}.tif.xml")
    design = np.array([[*scan[point], 1.0] for point in scan])
    fit = np.linalg.lstsq(design, np.array([camera[point] for point in scan]))[0]
    return fit[:2].T, fit[2]


def micmac_marks(path: Path) -> dict[str, Array]:
    marks = ElementTree.parse(path).getroot().findall("OneMesureAF1I")
    return {mark.findtext("NamePt") or "": values(mark, "PtIm") for mark in marks}


def metashape_mm(path: Path, pitch_mm: float, in_camera: Array) -> Array:
    """Camera mm, y up, of points (n, 3) in axes x right, y down, z forward; the frame's middle is the fiducials'."""
    root = ElementTree.parse(path).getroot()
    given = {child.tag: float(child.text or "") for child in root if child.tag != "projection"}
    x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
    r2 = x * x + y * y
    radial = 1 + given["k1"] * r2 + given["k2"] * r2**2 + given["k3"] * r2**3
    xd = x * radial + given["p1"] * (r2 + 2 * x * x) + 2 * given["p2"] * x * y
    yd = y * radial + given["p2"] * (r2 + 2 * y * y) + 2 * given["p1"] * x * y
    u = given["cx"] + xd * given["f"] + xd * given["b1"] + yd * given.get("b2", 0.0)
    v = given["cy"] + yd * given["f"]
    return np.column_stack([u, -v]) * pitch_mm


def one(element: ElementTree.Element, path: str) -> ElementTree.Element:
    found = element.find(path)
    assert found is not None, path
    return found


def values(element: ElementTree.Element, path: str) -> Array:
    return np.array([float(part) for part in (one(element, path).text or "").split()])
