"""Camera identification of scans: trials, camera plates and drawings of the marks, reported as text, figures and
JSON."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from rich.console import Console
from rich.padding import Padding
from scipy.special import chdtrc

from measure.annotations.lines import CAMERA, Line, find_fields
from measure.fiducials.measurement import Coarseness
from measure.flags import Code, Reason, Status
from measure.marks.rendering import known_picture
from measure.marks.shapes import FiducialLayout, LayoutMark, is_made_of_areas
from measure.results import MarkMeasurement
from pipeline.files.camera_file import CameraFile
from pipeline.text.wording import counted

if TYPE_CHECKING:
    from pipeline.measuring.scan_task import ScanTask
    from pipeline.results.measured_record import MeasuredScan

_OTHER_CONE = 0.02  # fraction of the principal distance: cameras with the same lens cone differ by less
_MAKERS = ("Wild", "Zeiss", "Jena", "Fairchild")
_PX_PER_MM = 4.0
_HALF_MM, _OFF_MM = 7.0, 2.0  # half width of the compared windows; largest offset between two drawings
_BLUR_PX = 1.5
_NEAR_MM = 6.0  # mm: marks of two cameras this close correspond
_ALIKE = (
    0.75  # correlation: above it, drawings must be compared by eye; the variants of the K-17's wings have 0.8 to 0.93
)

_MOST_TRIED = 8  # scans without a frame that are measured as those of another camera
_FEWEST_FIDUCIALS = 4  # with residuals under an affine transformation
_FITS, _FITS_NOT = 0.05, 1e-4  # p-values of the camera that fits and, of all scans together, of one that does not
_USUAL = 2.5  # variance over the median of the smaller of two chi-squares with a few degrees of freedom
_OUTSTANDING = 2.0  # ratio to the score of the stretched layout
CLOSE = 0.85  # fraction of the best score: cameras above it are not distinguished from the best
_SHRUNK = 0.03  # relative scale error: more than film shrinkage and differences between cameras of one model


def parse_plate(lines: Sequence[Line]) -> dict[str, str]:
    """Maker, number and principal distance in mm, as far as the text of a plate gives each without ambiguity."""
    found = {name: {field.value for field in find_fields(lines) if field.name == name} - {""} for name in CAMERA}
    return {name: next(iter(values)) for name, values in found.items() if len(values) == 1}


def is_whole_plate(lines: Sequence[Line]) -> bool:
    """Whether the text gives all fields of a plate."""
    return len(parse_plate(lines)) == len(CAMERA)


def contradictions(camera: CameraFile, plate: dict[str, str]) -> list[str]:
    """List the contradictions between a camera file and a plate, one clause each."""
    clauses = []
    makers = [maker for maker in _MAKERS if maker.lower() in camera.name.lower()]
    if "camera_type" in plate and makers and plate["camera_type"] not in makers:
        clauses.append(f"it is of a camera by {plate['camera_type']}")
    given = camera.principal_distance_mm
    if given and "principal_distance_mm" in plate:
        read = float(plate["principal_distance_mm"])
        if abs(read / given - 1.0) > _OTHER_CONE:
            clauses.append(f"it gives a principal distance of {read:g} mm")
    if camera.number and plate.get("camera_number", camera.number) != camera.number:
        clauses.append(f"it gives the number {plate['camera_number']}, the file {camera.number}")
    return clauses


def add_plates(
    camera: CameraFile, scans: "Sequence[MeasuredScan]", cameras: Mapping[str, CameraFile]
) -> "list[MeasuredScan]":
    """Add the contradictions and notes of the camera plates to the scans of one camera.

    A principal distance read from a plate changes nothing.

    cameras: all cameras of the project, by their names in images.csv.
    """
    plates = [parse_plate(scan.frame.writing or ()) for scan in scans]
    numbers = sorted({plate["camera_number"] for plate in plates if "camera_number" in plate})
    known = {other.number: name for name, other in cameras.items() if other.number}
    added = []
    for scan, plate in zip(scans, plates, strict=True):
        problems, notes = [], []
        against = contradictions(camera, plate)
        if against:
            named = known.get(plate.get("camera_number", ""), "")
            its_own = f"the camera {named}, whose number that is," if named else "its own camera"
            problems.append(
                f"the plate in the picture is not of {camera.name}: {' and '.join(against)}. Give this scan {its_own} "
                "by the column camera of images.csv, or see in frames.csv whether the plate is misread."
            )
        if len(numbers) > 1 and "camera_number" in plate and not camera.number:
            problems.append(
                f"the scans of {camera.name} show plates of several cameras, Nr {', '.join(numbers)}: each has a "
                "calibration of its own. Give each a camera file with its number, by the column camera of images.csv, "
                "or see in frames.csv whether a number is misread."
            )
        if "principal_distance_mm" in plate and not against and camera.principal_distance_mm:
            number = f" (Nr {plate['camera_number']})" if "camera_number" in plate else ""
            notes.append(
                f"The camera's plate{number} says a principal distance of {plate['principal_distance_mm']} mm, the "
                f"camera file {camera.principal_distance_mm:g} mm. Nothing is changed by it."
            )
        added.append(scan.changed(None, [Reason(each, Code.PLATE) for each in problems], notes))
    return added


def fitting_cameras(
    camera: CameraFile, scans: "Sequence[MeasuredScan]", cameras: Mapping[str, CameraFile], film_mm: float
) -> dict[str, Reason]:
    """Find scans of one camera whose fiducials fit another camera of the project and not their own, by image.

    The misfits of an affine transformation are tested with the standard deviations of marks, film and certificate,
    enlarged by what is usual for the scans under the better camera.
    """
    ids = {each.id for each in camera.fiducials}
    others = {name: each for name, each in cameras.items() if each is not camera}
    rivals = {name: each for name, each in others.items() if {one.id for one in each.fiducials} == ids}
    misfits = dict[str, tuple[int, dict[str, tuple[float, float]]]]()
    for scan in scans if rivals else ():
        marks = [mark for mark in scan.frame.marks if mark.kind == "fiducial" and mark.status.is_observation]
        if len(marks) >= _FEWEST_FIDUCIALS:
            own = {name: _misfit(marks, each, film_mm) for name, each in {"": camera, **rivals}.items()}
            misfits[scan.frame.image] = 2 * len(marks) - 6, own
    usual = [min(square for square, _ in own.values()) / freedom for freedom, own in misfits.values()]
    scale, found = max(1.0, _USUAL * float(np.median(usual or [1.0]))), dict[str, Reason]()
    for image, (freedom, own) in misfits.items():
        best = min(own, key=lambda name: own[name][0])
        fits_own, fits_best = (float(chdtrc(freedom, own[name][0] / scale)) for name in ("", best))
        if fits_own < _FITS_NOT / len(misfits) and fits_best > _FITS:
            sentence = (
                f"its fiducials fit the camera {best} to {own[best][1]:.2g} µm and its own, {camera.name}, to "
                f"{own[''][1]:.2g} µm: it is probably a frame of that one. Correct the column camera of images.csv, or "
                "what sorts the scans by camera."
            )
            found[image] = Reason(sentence, Code.OTHER_CAMERA)
    return found


def tried_cameras(
    scans: "Sequence[MeasuredScan]",
    tasks: "Sequence[ScanTask]",
    cameras: Mapping[str, CameraFile],
    measure: "Callable[[Sequence[ScanTask]], Iterable[MeasuredScan]]",
) -> dict[str, Reason]:
    """Measure scans of one camera without a frame as those of others; the camera with all fiducials, by image.

    cameras: the others, with templates of learned marks; measure: measures tasks without storing the results.
    """
    lost = {scan.frame.image for scan in scans if any(Code.NO_FRAME in each.codes for each in scan.frame.problems)}
    found = dict[str, Reason]()
    for name, camera in cameras.items():
        of_other = [
            replace(task, options=replace(task.options, camera=camera, targets=None, exterior=None))
            for task in tasks
            if task.name in lost - found.keys()
        ]
        for scan in measure(of_other[:_MOST_TRIED]):
            marks = [mark for mark in scan.frame.marks if mark.kind == "fiducial"]
            if len(marks) >= _FEWEST_FIDUCIALS and all(mark.status is Status.MEASURED for mark in marks):
                sentence = (
                    f"as a frame of the camera {name} all its {len(marks)} fiducials are measured: it is probably of "
                    "that one. Correct the column camera of images.csv, or what sorts the scans by camera."
                )
                found[scan.frame.image] = Reason(sentence, Code.OTHER_CAMERA)
    return found


def _misfit(marks: Sequence[MarkMeasurement], camera: CameraFile, film_mm: float) -> tuple[float, float]:
    """Chi-square of what an affine transformation leaves of a camera's fiducials, and its rms in µm."""
    given = {each.id: each for each in camera.fiducials}
    places_mm = np.array([given[mark.point].xy_mm for mark in marks])
    pixels = np.array([[1.0, *np.asarray(mark.center_px)] for mark in marks])
    by_pixels = np.linalg.lstsq(pixels, places_mm, rcond=None)[0]
    rest_mm = places_mm - pixels @ by_pixels
    pitch_mm2 = abs(float(np.linalg.det(by_pixels[1:])))
    of_marks = [np.trace(mark.covariance.px2) / 2.0 for mark in marks if mark.covariance is not None]
    given_mm2 = [np.mean(np.square(given[mark.point].sigma_mm)) for mark in marks]
    variance_mm2 = film_mm**2 + pitch_mm2 * float(np.mean(of_marks)) + float(np.mean(given_mm2))
    return float((rest_mm**2).sum()) / variance_mm2, 1000.0 * float(np.sqrt(np.mean(rest_mm**2)))


# Cameras with solid marks (wings, notches, arrows) that resemble those of others: a scan hardly distinguishes them.


def drawn_alike(layouts: Mapping[tuple[str, ...], FiducialLayout]) -> dict[str, tuple[str, ...]]:
    """For each camera with solid marks only: the other cameras whose marks at nearly the same places look similar."""
    solid = {names: layout for names, layout in layouts.items() if all(is_made_of_areas(mark) for mark in layout.marks)}
    pictures = {names: [_picture(mark) for mark in layout.marks] for names, layout in solid.items()}
    rim = round(_OFF_MM * _PX_PER_MM)  # of the offsets at which drawings are compared

    def alike(names: tuple[str, ...], other: tuple[str, ...]) -> bool:
        places = np.array([mark.xy_mm for mark in solid[other].marks])
        likeness = np.zeros(len(pictures[names]))
        for row, (mark, picture) in enumerate(zip(solid[names].marks, pictures[names], strict=True)):
            off_mm = np.hypot(*(places - mark.xy_mm).T)
            if off_mm.min() < _NEAR_MM:
                window = picture[rim:-rim, rim:-rim]
                ncc = cv2.matchTemplate(pictures[other][int(off_mm.argmin())], window, cv2.TM_CCOEFF_NORMED)
                likeness[row] = ncc.max()
        return float(likeness.mean()) >= _ALIKE

    others = {names: [other[0] for other in solid if other != names and alike(names, other)] for names in solid}
    return {name: tuple(own) for names, own in others.items() if own for name in names}


def _picture(mark: LayoutMark) -> cv2.typing.MatLike:
    """Rendered image of a mark; unknown parts of the drawing are background."""
    half_px = round(_HALF_MM * _PX_PER_MM)
    matrix = np.array([[_PX_PER_MM, 0.0, half_px], [0.0, -_PX_PER_MM, half_px]])
    size = 2 * half_px + 1
    return np.nan_to_num(known_picture(mark.mark, matrix, size, size, _BLUR_PX)).astype(np.float32)


@dataclass(frozen=True)
class Trial:
    """Result of the trial of the cameras that share a layout of marks.

    Attributes
    ----------
    found : number of marks observed, out of drawn.
    likeness : mean correlation of the found marks with the drawing.
    snr : median of contrast over noise.
    score : 0 to 1, see `measure.fiducials.camera_recognition.likeness`.
    score_elsewhere : score of the same marks in wrong places, that is, of the stretched layout; None where no
        comparison is needed.
    residual_sigmas, residual_mm : residuals of an affine transformation per axis, in standard deviations of marks and
        given places, and in mm; None without redundancy.
    expected : expected number of false alarms in such a scan: constellations that correlate as well at reduced size;
        infinite where none is found at the given pitch.
    pixel_um : pixel pitch from the separations of the marks; None without marks.
    """

    cameras: tuple[str, ...]
    found: int
    drawn: int
    likeness: float
    snr: float
    score: float
    score_elsewhere: float | None
    residual_sigmas: float | None
    residual_mm: float | None
    reason: str
    seconds: float
    expected: float
    pixel_um: float | None = None

    @property
    def stands_out(self) -> bool:
        return self.score > 0.0 and (self.score_elsewhere is None or self.score >= _OUTSTANDING * self.score_elsewhere)


@dataclass(frozen=True)
class Identification:
    """Trials of one scan, best first, and the conclusions.

    Attributes
    ----------
    unreported : by name, the source of cameras without a calibration report.
    pitch_um : of the scan in x and y, as given or from its file.
    plate : text on the camera's own plate, by field.
    contradicted : by name, the contradictions between camera and plate.
    alike : by name, other cameras with similar marks.
    reports : by name, the number of calibration reports behind a camera.
    board : the calibration board in the image, as `reseau calibrate` takes it.
    is_negative : whether the scan shows the marks of the best trials with light and dark exchanged.
    solid : names of cameras with solid marks only.
    layouts_coarseness : for each layout that was tried, the finest detail of its marks beside a pixel.
    """

    scan: Path
    trials: tuple[Trial, ...]
    unreported: Mapping[str, str] = field(default_factory=dict)
    pitch_um: tuple[float, float] | None = None
    plate: Mapping[str, str] = field(default_factory=dict)
    contradicted: Mapping[str, Sequence[str]] = field(default_factory=dict)
    alike: Mapping[str, Sequence[str]] = field(default_factory=dict)
    reports: Mapping[str, int] = field(default_factory=dict)
    board: str = ""
    is_negative: bool = False
    solid: Collection[str] = ()
    layouts_coarseness: Sequence[Coarseness] = ()

    @property
    def best(self) -> tuple[Trial, ...]:
        """The first trial that stands out, and those that stand out with nearly the same score."""
        standing = [trial for trial in self.trials if trial.stands_out]
        return tuple(trial for trial in standing if trial.score >= CLOSE * standing[0].score)

    def sentence(self) -> str:
        if not self.best:
            return (
                f"{self.scan.name}: no camera of the library stands out. Its marks may be none of those drawn, or too "
                f"faint; --pitch helps where the scan's file does not say it.{self.too_coarse()}"
            )
        first = self.best[0]
        by_chance = f"{first.expected:.1g} false alarms expected in such a scan"
        if first.score_elsewhere is not None:
            by_chance = f"the same marks in wrong places score {first.score_elsewhere:.2f}"
        if self.is_likely_false:
            return (
                f"{self.scan.name}: no camera is named: perhaps {' or '.join(self.best_names())}, {first.found} of "
                f"{first.drawn} marks, but that rests on the form of the marks alone. {self.against_pitch()}"
            )
        text = (
            f"{self.scan.name}: {' or '.join(first.cameras)}, score {first.score:.2f}: {first.found} of {first.drawn} "
            f"marks, likeness {first.likeness:.2f}, signal-to-noise {first.snr:.1f}; {by_chance}."
        )
        if self.is_negative:
            text += " The scan is a negative of their drawings: `reseau measure` takes it as it is."
        if len(self.best) > 1:
            text += f" {' or '.join(self.best[1].cameras)} comes close with {self.best[1].score:.2f}."
        elif len(first.cameras) > 1:
            text += " Their marks are alike; the data strip or the focal length must decide."
        named = [name for name in self.best_names() if name in self.unreported]
        text += "".join(f" {name} rests on no calibration report: {self.unreported[name]}." for name in named)
        if others := " or ".join(self.much_alike()):
            text += (
                f" That rests on the form of its marks alone, and {others} has marks much like them: compare the "
                "drawings."
            )
        against = self.against_pitch()
        return text + self._plate_remark() + (f" {against}" if against else "")

    def too_coarse(self) -> str:
        """Sentence on the layouts for whose marks the scan is too coarse, with the pitches that would do; empty if a
        camera is found or it is too coarse for none."""
        coarse = [each for each in self.layouts_coarseness if each.is_too_coarse]
        if self.best or not coarse:
            return ""
        needed_um = sorted(each.needed_um for each in coarse)
        pixels_um = sorted({f"{each.pixel_um:.0f}" for each in coarse}, key=float)
        return (
            f" The scan may be too coarse: at {' to '.join(dict.fromkeys((pixels_um[0], pixels_um[-1])))} µm a pixel "
            f"the finest detail of the marks is less than 3 px wide for {len(coarse)} of "
            f"{counted(len(self.layouts_coarseness), 'layout')}. Scan at {needed_um[0]:.0f} µm or finer for all, at "
            f"{needed_um[len(coarse) // 2]:.0f} µm for half of them."
        )

    @property
    def is_likely_false(self) -> bool:
        """Whether solid marks alone identify the camera, against the pitch: likely a false alarm of such marks."""
        names = self.best_names()
        return (
            bool(names) and not self.plate and all(name in self.solid for name in names) and bool(self.against_pitch())
        )

    def best_names(self) -> tuple[str, ...]:
        """Names of the cameras of the best trials."""
        return tuple(name for trial in self.best for name in trial.cameras)

    def names_by_plate(self) -> list[str]:
        """Names of the best cameras that neither the plate nor the pitch contradicts."""
        return [name for name in self.best_names() if name not in self.contradicted and not self.is_likely_false]

    def much_alike(self) -> tuple[str, ...]:
        """Other cameras whose marks resemble those of the best trials."""
        best = self.best_names()
        others = (other for name in best for other in self.alike.get(name, ()) if other not in best)
        return tuple(dict.fromkeys(others))

    def _plate_remark(self) -> str:
        """Which of the best cameras agree with the plate."""
        if not self.plate:
            return ""
        words = {"camera_type": "{}", "camera_number": "Nr {}", "principal_distance_mm": "principal distance {} mm"}
        read = ", ".join(word.format(self.plate[name]) for name, word in words.items() if name in self.plate)
        left = self.names_by_plate()
        if not left:
            return f" Its plate says {read}, which none of them is."
        agree = f"; of these that is {' or '.join(left)}" if len(left) < len(self.best_names()) else ""
        return f" Its plate says {read}{agree}."

    def against_pitch(self) -> str:
        """A sentence if the pitch contradicts the best camera; otherwise empty."""
        trial = self.best[0] if self.best else None
        if self.pitch_um is None or trial is None or trial.pixel_um is None:
            return ""
        pitch_um = math.sqrt(math.prod(self.pitch_um))
        if abs(trial.pixel_um / pitch_um - 1) < _SHRUNK:
            return ""
        return (
            f"Its marks lie as far apart as they should only if a pixel measures {trial.pixel_um:.1f} µm, not "
            f"{pitch_um:.1f}: if the scan is of this camera, the pitch that --pitch or its file gives is wrong."
        )

    def as_json(self) -> Mapping[str, object]:
        trials = [{**asdict(trial), "stands_out": trial.stands_out} for trial in self.trials]
        head = {
            "scan": str(self.scan),
            "best": [] if self.is_likely_false else [*self.best_names()],
            "sentence": self.sentence(),
            "trials": trials,
        }
        return {**head, "plate": dict(self.plate), "contradicted": sorted(self.contradicted)}


def print_identification(identification: Identification, console: Console) -> None:
    """Print the trials that found marks, the number of the others, and the conclusion."""
    tried = [trial for trial in identification.trials if trial.found]
    for trial in tried:
        words = [
            f"{trial.score:.2f}: {trial.found} of {trial.drawn} marks, likeness {trial.likeness:.2f}",
            f"signal-to-noise {trial.snr:.1f}",
        ]
        if trial.residual_mm is not None:
            words.append(f"affine residual {trial.residual_mm:.3f} mm ({trial.residual_sigmas:.0f} sigma)")
        if math.isfinite(trial.expected):
            words.append(f"expected false alarms {trial.expected:.1g}")
        if trial.score_elsewhere is not None:
            words.append(f"in wrong places {trial.score_elsewhere:.2f}")
        figures = f"{', '.join(words)}; {trial.seconds:.0f} s"
        console.print(", ".join(trial.cameras), style="bold", highlight=False)
        console.print(Padding(figures, (0, 0, 0, 4)), highlight=False)
    if rest := identification.trials[len(tried) :]:
        console.print(f"{counted(len(rest), 'other layout')} of marks: not found (--json has the reasons).")
    console.print(identification.sentence(), highlight=False, soft_wrap=True)
