"""Scene: full description of the scans of a series of photographs.

Lengths on the film are in mm, in the object in object units; grey values are fractions of full scale (0 black, 1 white)
on the positive. Axes, rotations and signs are those of the papers: camera frame x' right, y' up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area, Point
from synthetic_images.bend import is_term
from synthetic_images.checks import not_negative, one_of, positive, unique
from synthetic_images.writing import check_font

Array = NDArray[np.float64]

Family = Literal["none", "torlegard", "brown", "australis", "aicon", "opencv", "opencv_fisheye", "juhl"]
Side = Literal["left", "right", "top", "bottom"]
Compression = Literal["none", "lzw", "deflate", "zstd", "jpeg"]
Background = Literal["plain", "wall", "terrain"]
MOST_TILTED_DEG = 30  # degrees, largest tilt of a camera that photographs film
FilmKind = Literal["similarity", "affine", "projective"]

TONES = ("srgb", "s-curve")
POSES = ("0", "90", "180", "270", "0m", "90m", "180m", "270m")
PARAMETERS: Mapping[Family, tuple[str, ...]] = {
    "none": (),
    "torlegard": ("k3", "k5", "k7", "p1", "p2", "p3", "p4"),
    "brown": ("k1", "k2", "k3", "p1", "p2", "b1", "b2"),
    "australis": ("k1", "k2", "k3", "p1", "p2", "b1", "b2"),
    "aicon": ("a1", "a2", "a3", "b1", "b2", "c1", "c2"),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2"),
    "opencv_fisheye": ("k1", "k2", "k3", "k4", "b1", "b2"),
    "juhl": ("t1", "t2", "t3", "t4", "r1", "r2", "r3", "af", "sh"),
}


@dataclass(frozen=True)
class SceneDistortion:
    """Distortion model. parameters: by name, 0 if absent; r0_mm: reference radius; decentering: "paper" for Torlegård's
    decentring terms as printed, not reduced to the principal point."""

    family: Family = "none"
    parameters: Mapping[str, float] = field(default_factory=dict)
    r0_mm: float = 0.0
    decentering: Literal["reduced", "paper"] = "reduced"

    def __post_init__(self) -> None:
        one_of("distortion family", self.family, get_args(Family))
        for name in self.parameters:
            one_of(f"{self.family} parameter", name, PARAMETERS[self.family])
        if self.family == "juhl" and not self.r0_mm > 0.0 and any(self.parameters.get(name) for name in ("r2", "r3")):
            raise ValueError("juhl's r2 and r3 are waves of the length r0: r0_mm must be positive")


@dataclass(frozen=True, eq=False)
class DrawnMark:
    """Drawn fiducial: areas relative to its origin, mm, x right and y up; light or dark on the positive."""

    areas: tuple[Area, ...]
    light: bool = True


@dataclass(frozen=True, eq=False)
class ChipMark:
    """Fiducial from an image. image: (rows, columns), 0 to 1; origin_px: (column, row) of the measured point."""

    image: Array
    pitch_um: float
    origin_px: Point
    turn_deg: float = 0.0
    light: bool = True


@dataclass(frozen=True, eq=False)
class SceneFiducial:
    """Fiducial mark in the camera frame. mark: None if nothing is drawn, such as for a corner of the frame."""

    id: str
    xy_mm: Point
    mark: DrawnMark | ChipMark | None


@dataclass(frozen=True, eq=False)
class SceneCamera:
    """True camera. frame_mm: width and height of the exposed frame, centred on the origin of the camera frame."""

    name: str
    frame_mm: Point
    principal_distance_mm: float
    principal_point_mm: Point = (0.0, 0.0)
    distortion: SceneDistortion = SceneDistortion()
    fiducials: tuple[SceneFiducial, ...] = ()

    def __post_init__(self) -> None:
        positive("frame_mm", *self.frame_mm)
        positive("principal_distance_mm", self.principal_distance_mm)
        unique("fiducial", [fiducial.id for fiducial in self.fiducials])


@dataclass(frozen=True)
class DiskTarget:
    """Round target: centre and normal in the object frame."""

    id: str
    center: tuple[float, float, float]
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        positive(f"target {self.id}: length of the normal", float(np.linalg.norm(self.normal)))


@dataclass(frozen=True)
class CrossFigure:
    """Cross instead of a disk, as long as the disk's diameter: one bar is horizontal (along X if the target faces up),
    one perpendicular. line: width of the bars, fraction of half their length."""

    line: float

    def __post_init__(self) -> None:
        if not 0.0 < self.line < 1.0:
            raise ValueError(f"the line of a cross is narrower than half its length, not {self.line} of it")


@dataclass(frozen=True)
class RingFigure:
    """Coded ring around some disks.

    Attributes
    ----------
    bits : number of segments.
    inner, outer : radii of the ring, in radii of the disk.
    numbers : code by target; its set bits, the highest first, clockwise as seen, are the segments drawn.
    """

    bits: int
    inner: float
    outer: float
    numbers: Mapping[str, int]

    def __post_init__(self) -> None:
        if not 1.0 < self.inner < self.outer:
            raise ValueError(f"a ring lies about its disk: from {self.inner} to {self.outer} of its radius is no ring")


@dataclass(frozen=True)
class DiskField:
    """Field of disks or other figures. diameter: object units; surround: diameter of the disk behind each target, in
    diameters of the target, 0 for none."""

    targets: tuple[DiskTarget, ...]
    diameter: float
    surround: float = 2.0
    figure: CrossFigure | RingFigure | None = None

    def __post_init__(self) -> None:
        positive("diameter of the targets", self.diameter)
        if self.surround != 0.0 and not self.surround > 1.0:
            raise ValueError(f"the surround is {self.surround} diameters wide; it must be above 1, or 0 for none")
        unique("target", [target.id for target in self.targets])


@dataclass(frozen=True)
class BoardField:
    """Board in the plane Z = 0, x right, y up, seen from above. The point "r{row}c{column}" is at
    X = column · spacing, Y = (rows - 1 - row) · spacing.

    columns, rows: of a chessboard, number of inner corners; diameter: of the dots of a circle grid; asymmetric: dots
    only where row + column is even.
    """

    kind: Literal["chessboard", "circle-grid"]
    columns: int
    rows: int
    spacing: float
    diameter: float = 0.0
    asymmetric: bool = False

    def __post_init__(self) -> None:
        one_of("board", self.kind, ("chessboard", "circle-grid"))
        if self.columns < 2 or self.rows < 2:
            raise ValueError(f"a board needs at least 2 x 2 points, not {self.columns} x {self.rows}")
        positive("spacing of the board", self.spacing)
        if self.kind == "circle-grid" and not 0.0 < self.diameter < self.spacing:
            raise ValueError(f"the dots' diameter must lie between 0 and the spacing, {self.spacing}: {self.diameter}")


@dataclass(frozen=True)
class FilmTransformation:
    """Film transformation of a frame: film = R(rotation) [[scale_x, shear], [0, scale_y]] camera + shift."""

    scale: Point = (1.0, 1.0)
    shear_rad: float = 0.0
    rotation_rad: float = 0.0
    shift_mm: Point = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(0.9 < scale < 1.1 for scale in self.scale):
            raise ValueError(f"a film's scales are near 1, not {self.scale}")


@dataclass(frozen=True)
class Writing:
    """Line of light text on the film.

    Attributes
    ----------
    xy_mm : centre in the camera frame.
    height_mm : of capitals.
    turn_deg : counter-clockwise rotation; 0: the line runs along x'.
    mirrored : whether it is legible only from the other side of the film.
    """

    text: str
    xy_mm: Point
    height_mm: float
    turn_deg: float = 0.0
    mirrored: bool = False
    font: str = "hershey-simplex"

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise ValueError("writing without any text; leave it out")
        positive(f"writing {self.text!r}: height_mm", self.height_mm)
        check_font(f"writing {self.text!r}: font", self.font)


@dataclass(frozen=True, eq=False)
class SceneImage:
    """Image: exterior orientation, film transformation and scan orientation of a frame.

    Attributes
    ----------
    exterior : X0, Y0, Z0 in object units, omega, phi, kappa in rad.
    pose : scan orientation as in `measure.results.ScanOrientation`.
    turn_rad : small rotation in addition to the pose.
    offset_mm : of the frame's centre from the scan's centre.
    covered : fiducials under a piece of tape.
    neighbour, neighbour_gap_mm : side of the camera frame on which the next frame lies, and the gap between them.
    writing : lines of text on this frame.
    part_of : frame of which this is one of several partial scans; "" for a whole scan.
    part : start and end of the partial scan, as fractions of the width of the whole scan.
    """

    name: str
    exterior: tuple[float, float, float, float, float, float]
    pose: str = "0"
    turn_rad: float = 0.0
    offset_mm: Point = (0.0, 0.0)
    film: FilmTransformation = FilmTransformation()
    covered: tuple[str, ...] = ()
    neighbour: Side | None = None
    neighbour_gap_mm: float = 3.0
    writing: tuple[Writing, ...] = ()
    part_of: str = ""
    part: tuple[float, float] = (0.0, 1.0)

    @property
    def frame(self) -> str:
        return self.part_of or self.name

    def __post_init__(self) -> None:
        if not self.name or set(self.name) & set("/\\:"):
            raise ValueError(f"an image's name becomes its file's: {self.name!r} is empty or holds one of / \\ :")
        one_of(f"image {self.name}: pose", self.pose, POSES)
        if not 0.0 <= self.part[0] < self.part[1] <= 1.0:
            raise ValueError(f"image {self.name}: part is from and to as shares of the scan's width, not {self.part}")
        if self.neighbour is not None:
            one_of(f"image {self.name}: neighbour", self.neighbour, get_args(Side))


@dataclass(frozen=True)
class SceneFilm:
    """Film properties common to all frames.

    Attributes
    ----------
    kind : true film transformation.
    tilt_deg, tilt_direction_deg, photographed_from_mm : tilt of a camera that photographed the film from a distance,
        around a line perpendicular to tilt_direction_deg (from x' to y'): a projective transformation.
    deformation_um : RMS of a smooth film deformation.
    grain, grain_px : RMS of the grain, fraction of full scale, and sigma of the Gaussian that correlates it.
    dust, scratches, hairs : number per frame.
    """

    kind: FilmKind = "affine"
    tilt_deg: float = 0.0
    tilt_direction_deg: float = 0.0
    photographed_from_mm: float = 600.0
    deformation_um: float = 0.0
    grain: float = 0.0
    grain_px: float = 1.0
    dust: int = 0
    scratches: int = 0
    hairs: int = 0

    def __post_init__(self) -> None:
        one_of("film transformation", self.kind, get_args(FilmKind))
        if self.tilt_deg and self.kind != "projective":
            raise ValueError('film that a tilted camera photographed (tilt_deg) has transformation = "projective"')
        if not abs(self.tilt_deg) <= MOST_TILTED_DEG:
            raise ValueError(f"tilt_deg is {self.tilt_deg}; between -{MOST_TILTED_DEG} and {MOST_TILTED_DEG} is right")
        not_negative("deformation_um", self.deformation_um)
        not_negative("grain", self.grain)
        not_negative("grain_px", self.grain_px)
        not_negative("number of defects", min(self.dust, self.scratches, self.hairs))


@dataclass(frozen=True)
class UnsharpMask:
    """Unsharp mask: code + amount (code - Gaussian mean of the codes with sigma radius_px)."""

    amount: float = 0.0
    radius_px: float = 1.0

    def __post_init__(self) -> None:
        not_negative("amount", self.amount)
        positive("radius_px", self.radius_px)

    @property
    def reach_px(self) -> int:
        """Half width of the filter."""
        return int(4 * self.radius_px + 0.5) if self.amount else 0


@dataclass(frozen=True)
class SceneTakingLens:
    """Lens of a digital camera that takes the scans, by OpenCV's formulas (calib3d, "detailed description").

    focal_px: principal distance; center_px: principal point, None for the centre of the image.
    """

    focal_px: float
    center_px: Point | None = None
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        positive("focal_px", self.focal_px)


@dataclass(frozen=True)
class SceneScanner:
    """Scanner and file format.

    Attributes
    ----------
    pitch_um : pixel pitch across and down.
    margin_mm : margin of the scan around the frame.
    blur_px : sigma of the Gaussian PSF, in addition to the averaging over the pixel.
    noise : RMS of white noise, fraction of full scale.
    negative : whether the image is a negative.
    white_is_zero : whether the file stores white as zero; the image is the same.
    tile_px : side of the file's tiles, 0 for strips.
    tone : gamma of the coding, or one of TONES.
    bend_um : geometric error common to all scans, terms by name as in `bend.Bend`.
    sharpen : unsharp mask applied to the codes.
    lens : of a digital camera that takes the scans; None for a scanner.
    """

    pitch_um: Point
    margin_mm: float = 5.0
    blur_px: float = 0.7
    noise: float = 0.0
    bit_depth: Literal[8, 16] = 16
    colour: bool = False
    negative: bool = False
    white_is_zero: bool = False
    compression: Compression = "none"
    tile_px: int = 256
    tone: float | str = 1.0
    bend_um: Mapping[str, float] = field(default_factory=dict)
    sharpen: UnsharpMask = UnsharpMask()
    lens: SceneTakingLens | None = None

    def __post_init__(self) -> None:
        positive("pitch_um", *self.pitch_um)
        positive("margin_mm", self.margin_mm)
        not_negative("blur_px", self.blur_px)
        not_negative("noise", self.noise)
        one_of("bit_depth", self.bit_depth, (8, 16))
        one_of("compression", self.compression, get_args(Compression))
        if self.compression == "jpeg" and self.bit_depth == 16:
            raise ValueError('compression "jpeg" holds 8 bits; set bit_depth = 8 or another compression')
        if self.colour and self.white_is_zero:
            raise ValueError("a colour scan cannot be stored with white as zero; set one of them to false")
        if isinstance(self.tone, str):
            one_of("tone", self.tone, TONES)
        else:
            positive("tone", self.tone)
        for name in self.bend_um:
            if not is_term(name):
                raise ValueError(f"bend_um has no term {name!r}; it has a20, b11 and the like, a in x and b in y")
        if self.tile_px < 0 or self.tile_px % 16:
            raise ValueError(f"tile_px must be a multiple of 16, or 0 for strips, not {self.tile_px}")


@dataclass(frozen=True)
class Tones:
    """Grey values of the positive, fractions of full scale. contrast, border_contrast: RMS of the textures of
    background and border. Paints of the border's tone are unexposed too and show the border's texture."""

    border: float = 0.06
    border_contrast: float = 0.0
    background: float = 0.42
    contrast: float = 0.1
    mark: float = 0.9
    dark_mark: float = 0.03
    target: float = 0.85
    surround: float = 0.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"the tone {name} is a share of full scale, 0 to 1, not {value}")


@dataclass(frozen=True, eq=False)
class Scene:
    """Series of photographs.

    Attributes
    ----------
    ground, relief : mean height of the terrain of a "terrain" background, and RMS of the heights around it.
    pad_mm : radius of the unexposed disk behind each fiducial, 0 for none.
    pocket_mm : half the side of the exposed square around each fiducial, as for marks in bays of the frame; 0 for none.
    corner_radius_mm : radius of the rounded corners of the exposed frame, 0 for sharp corners.
    """

    name: str
    seed: int
    camera: SceneCamera
    field: DiskField | BoardField
    images: tuple[SceneImage, ...]
    scanner: SceneScanner
    film: SceneFilm = SceneFilm()
    tones: Tones = Tones()
    background: Background = "plain"
    ground: float = 0.0
    relief: float = 0.0
    pad_mm: float = 0.0
    pocket_mm: float = 0.0
    corner_radius_mm: float = 0.0

    def __post_init__(self) -> None:
        one_of("background", self.background, get_args(Background))
        not_negative("relief", self.relief)
        not_negative("pad_mm", self.pad_mm)
        not_negative("pocket_mm", self.pocket_mm)
        not_negative("corner_radius_mm", self.corner_radius_mm)
        if 2 * self.corner_radius_mm > min(self.camera.frame_mm):
            raise ValueError(f"corner_radius_mm is {self.corner_radius_mm}: the frame's sides are not that long")
        if not self.images:
            raise ValueError("a scene needs at least one image")
        unique("image", [image.name for image in self.images])
        exterior = {image.frame: image.exterior for image in self.images}
        for image in self.images:
            if image.exterior != exterior[image.frame]:
                raise ValueError(f"image {image.name}: parts of frame {image.frame} have one position and attitude")
        known = {fiducial.id for fiducial in self.camera.fiducials}
        for image in self.images:
            for id in image.covered:
                one_of(f"image {image.name}: covered fiducial", id, tuple(sorted(known)))
            if self.film.kind == "similarity" and (image.film.shear_rad or len(set(image.film.scale)) == 2):
                raise ValueError(f"image {image.name}: a similarity has one scale and no shear")
