"""`reseau calibrate`: a project is written, measured, adjusted and checked for each camera."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console

from adjust.display import CameraPlots, PlottedResult, data_frame
from adjust.errors import AdjustmentError
from adjust.problem.network import Network
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from adjust.validation import largest_sigma_mm
from measure import MeasurementError, open_scan
from measure.boards.find import fitting_board, recognise_board
from measure.boards.measure import recognise_dots
from pipeline.adjusting.adjust_stage import adjust_marks, adjustment_options
from pipeline.adjusting.network import build_network
from pipeline.calibration import project_files
from pipeline.calibration.intrinsics import (
    CameraIntrinsics,
    LensChoice,
    LensModel,
    LensSetting,
    camera_intrinsics,
    choose_lens,
    p_of_one_camera,
)
from pipeline.calibration.pictures import (
    FEWEST_PICTURES,
    BoardPictureFiles,
    CameraPictures,
    find_pictures,
    find_turns,
    name_parts,
)
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.results.comparator_file import ComparatorPoint, read_comparator
from pipeline.results.stage_files import read_check
from pipeline.stages import run_all, run_measure
from pipeline.summary import Summary
from pipeline.terminal import Reporter
from pipeline.text.files import FilePath, write_atomically
from pipeline.text.wording import counted, did_you_mean, listed, listed_by_reason
from pipeline.workers import WorkOptions

GENEROUS = 2.0  # factor on the unmodelled standard deviation, for lens models with larger misfit than the first
FEWEST_CORNERS = 4  # corners for a space resection with redundancy
MOST_RECOGNISED = 6  # pictures in which a board that was not found is recognised: the first ones may not show it

MOST_PARTITIONS, DIFFERENT = 3, 1e-4  # of images by their names that are tried; p-value of one camera

OUT = Path("calibration")
LENSES: dict[str, LensSetting] = {"auto": "auto", **{model: model for model in get_args(LensModel)}}


@dataclass(frozen=True, repr=False)
class CalibrationResult(PlottedResult):
    """Calibrated cameras, and the reasons why others are not calibrated.

    Attributes
    ----------
    unreadable : by image, the reason.
    not_calibrated : by camera, the reason.
    files : written files, report and project last.
    adjustments : by camera.
    pixel_mm : side of a pixel in the adjustments.
    mixed : by camera, which pictures differ from the others by their names and by what they show of the camera.
    """

    cameras: tuple[CameraIntrinsics, ...]
    unreadable: Mapping[str, str]
    not_calibrated: Mapping[str, str]
    files: tuple[Path, ...]
    summary: Summary
    adjustments: Mapping[str, Adjustment]
    pixel_mm: float
    mixed: Mapping[str, str] = field(default_factory=dict)

    def plots(self, camera: str = "") -> CameraPlots:
        """Plots of a camera, in px. Raises InputError for an unknown camera."""
        if not camera and len(self.adjustments) == 1:
            camera = next(iter(self.adjustments))
        if camera not in self.adjustments:
            raise InputError(f"There is no calibrated camera {camera!r}. Name one of: {', '.join(self.adjustments)}.")
        return self.adjustments[camera].plots(camera, self.pixel_mm)

    def to_pandas(self) -> Any:
        """One row per parameter of a camera, as pandas.DataFrame. Raises ImportError where pandas is not installed."""
        rows = [
            {"camera": camera.pictures.name, "parameter": name, **each.as_json()}
            for camera in self.cameras
            for name, each in camera.values.items()
        ]
        return data_frame({name: [row[name] for row in rows] for name in rows[0]})

    def __repr__(self) -> str:
        return f"Calibration({'; '.join(map(repr, self.cameras))})"

    def _repr_html_(self) -> str:
        """HTML table of the cameras' parameters, for notebooks."""
        rows = "".join(
            f"<tr><td>{escape(camera.pictures.name)}</td><td>{name}</td><td>{each.value:.7g}</td><td>{each.sigma:.2g}</td></tr>"
            for camera in self.cameras
            for name, each in camera.values.items()
        )
        head = "".join(f"<th>{name}</th>" for name in ("camera", "parameter", "value", "standard deviation"))
        return f"<p>{escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>"

    @property
    def needs_review(self) -> bool:
        """Whether images were left out, or the adjustment or its check has a problem."""
        left_out = self.unreadable or self.not_calibrated or any(camera.left_out for camera in self.cameras)
        return bool(left_out or self.mixed) or self.summary.verdict.exit_code != 0

    @property
    def report(self) -> Path:
        return self.files[-2]

    @property
    def project(self) -> Path:
        return self.files[-1]

    def as_json(self) -> dict[str, Any]:
        return {
            "cameras": [camera.as_json() for camera in self.cameras],
            "unreadable": dict(self.unreadable),
            "not_calibrated": dict(self.not_calibrated),
            "problems": [*self.mixed.values(), *(problem.what for problem in self.summary.verdict.problems)],
            "files": list(map(str, self.files)),
        }

    def print(self, console: Console) -> None:
        """Print the cameras, then the problems, then the files except the report."""
        for each in self.cameras:
            each.print(console)
        console.print("Needs a look." if self.needs_review else "Good: every test was passed.", highlight=False)
        lines = []
        if len(self.cameras) + len(self.not_calibrated) > 1:
            lines.append("Pictures of other sizes or focal lengths are taken for other cameras'.")
        lines += [f"- {name} cannot be read: {why}" for name, why in self.unreadable.items()]
        lines += [f"- {camera} is not calibrated: {why}" for camera, why in self.not_calibrated.items()]
        lines += [f"- {why}" for why in self.mixed.values()]
        for problem in self.summary.verdict.problems:
            lines += [f"- {problem.cause} {problem.detail}".rstrip(), f"  {problem.remedy}".rstrip()]
        lines += [str(file) for file in self.files if file != self.report]
        for line in lines:
            console.print(line, markup=False, highlight=False, soft_wrap=True)


@dataclass
class _CalibrationProject:
    """The project that is written for the pictures; turns and lenses follow what the adjustments show."""

    pictures: BoardPictureFiles
    out: Path
    options: project_files.CalibrationOptions
    lenses: dict[str, LensModel]

    def write(self) -> Project:
        return project_files.write_project(self.out, self.pictures, self.options, self.lenses)

    def adjust_camera(
        self, camera: CameraPictures, marks: Sequence[ComparatorPoint], left_out: Mapping[str, str]
    ) -> tuple[Adjustment, LensChoice | None]:
        """Adjust one camera with its turns and its lens determined. Raises AdjustmentError, or InputError."""
        if any(turned is None for turned in camera.turned_deg.values()):
            camera = find_turns(self.write(), marks, camera)
            cameras = (camera if each.name == camera.name else each for each in self.pictures.cameras)
            self.pictures = replace(self.pictures, cameras=tuple(cameras))
        _check_count(camera, left_out)
        adjustment, choice, project = None, None, self.write()
        if self.options.lens == "auto":
            with suppress(AdjustmentError):  # by the first lens, which a fisheye is not
                adjustment = adjust_marks(project, marks)
            choice = _chosen_lens(build_network(project, marks)[0], adjustment, project, self.options)
            if choice.model != self.lenses[camera.name]:
                self.lenses[camera.name], adjustment = choice.model, None
        if adjustment is None:
            adjustment = adjust_marks(self.write(), marks)
        if not adjustment.converged:
            why = " ".join(adjustment.warnings[:1])
            raise InputError(
                f"the adjustment has no solution ({adjustment.termination}). {why} Take pictures with the "
                "board tilted by 20 degrees and more in different directions, all over the picture."
            )
        return adjustment, choice

    def cameras_by_name(self, camera: CameraPictures, marks: Sequence[ComparatorPoint]) -> str:
        """Sentence on the images of a camera that, by a part of their names, are of different cameras; else empty."""
        project, shown = self.write(), {mark.image for mark in marks}
        for parts in islice(name_parts([name for name in camera.images if name in shown]), MOST_PARTITIONS):
            found = dict[str, CameraIntrinsics]()
            for part, images in parts.items():
                with suppress(AdjustmentError, InputError):
                    adjustment = adjust_marks(project, [mark for mark in marks if mark.image in images])
                    if adjustment.converged:
                        found[part] = camera_intrinsics(adjustment, camera, self.options.pixel_mm, {}, None, None, None)
            if len(found) > 1 and (p := p_of_one_camera(list(found.values()))) < DIFFERENT:
                each = "; ".join(f"*{part}*: {one.centre}" for part, one in found.items())
                return (
                    "Pictures with different names are of different cameras, or of one refocused between them: that "
                    f"they are of one has p = {p:.1g} ({each} px). Give the pictures of one alone, then the others."
                )
        return ""


def _calibrate_cameras(
    given: Sequence[Path], out: Path, options: project_files.CalibrationOptions, reporter: Reporter, workers: int | None
) -> CalibrationResult:
    """Calibrate each camera separately, so that a failure does not affect the others."""
    pictures = find_pictures(given, out)
    project_files.check_folder(out, pictures)
    first: LensModel = "opencv4" if options.lens == "auto" else options.lens
    written = _CalibrationProject(pictures, out, options, {camera.name: first for camera in pictures.cameras})
    project, work = written.write(), WorkOptions(workers=workers)
    run_measure(project, reporter, work)
    marks = read_comparator(project.comparator)
    left_out = _left_out(pictures, marks)
    choices: dict[str, LensChoice | None] = {}
    adjustments, not_calibrated, mixed = dict[str, Adjustment](), dict[str, str](), dict[str, str]()
    with reporter.stage("calibrating") as count:
        for done, camera in enumerate(pictures.cameras, 1):
            count(camera.name, done, len(pictures.cameras))
            own = _used_marks(marks, camera, left_out)
            try:
                adjustments[camera.name], choices[camera.name] = written.adjust_camera(camera, own, left_out)
            except (AdjustmentError, InputError) as error:
                not_calibrated[camera.name] = str(error)
            if several := written.cameras_by_name(camera, own):
                mixed[camera.name] = several
    if not adjustments:
        raise InputError(_nothing(pictures, left_out, not_calibrated, options.board))
    written.pictures, names = written.pictures.select(adjustments)
    project = written.write()
    if any(name != earlier for earlier, name in names.items()):  # the cameras left out had folders of their own
        left_out = {names[image]: why for image, why in left_out.items() if image in names}
        marks = tuple(replace(mark, image=names[mark.image]) for mark in marks if mark.image in names)
        for camera in written.pictures.cameras:
            adjustments[camera.name] = adjust_marks(project, _used_marks(marks, camera, left_out))
    summary = run_all(project, reporter, work)
    checks = read_check(project.check_path).cameras if project.check_path.exists() else {}
    found = []
    for each in written.pictures.cameras:
        adjustment = adjustments[each.name]
        reasons = {**left_out, **adjustment.left_out}
        own_reasons = {name: why for name, why in reasons.items() if name in each.images}
        choice, check = choices[each.name], checks.get(each.name)
        found.append(
            camera_intrinsics(adjustment, each, options.pixel_mm, own_reasons, choice, options.pitch_um, check)
        )
    texts = dict(project_files.camera_files(found, out, options.ros))
    for path, text in texts.items():
        write_atomically(path, text)
    files = (*texts, project.report_path, project.path)
    return CalibrationResult(
        tuple(found), pictures.unreadable, not_calibrated, files, summary, adjustments, options.pixel_mm, mixed
    )


def _used_marks(
    marks: Iterable[ComparatorPoint], camera: CameraPictures, left_out: Mapping[str, str]
) -> list[ComparatorPoint]:
    return [mark for mark in marks if mark.image in camera.images and mark.image not in left_out]


def _left_out(pictures: BoardPictureFiles, marks: Sequence[ComparatorPoint]) -> dict[str, str]:
    """Reasons why images are left out: no board, or too few of its corners."""
    corners = dict.fromkeys((name for camera in pictures.cameras for name in camera.images), 0)
    reasons = dict.fromkeys(corners, "the board was not found")
    for mark in marks:
        corners[mark.image] += mark.status.is_observation
        if not mark.status.is_observation and mark.reason:
            reasons[mark.image] = str(mark.reason)
    return {
        name: f"only {counted(count, 'corner')} of the board found" if count else reasons[name]
        for name, count in corners.items()
        if count < FEWEST_CORNERS
    }


def _check_count(camera: CameraPictures, left_out: Mapping[str, str]) -> None:
    """Raise InputError where too few images show the board."""
    used = set(camera.images) - left_out.keys()
    if len(used) < FEWEST_PICTURES:
        others = _most_common(left_out[name] for name in camera.images if name in left_out)
        raise InputError(
            f"the board is in {counted(len(used), 'picture')} of {camera.width_px} x {camera.height_px} px, and "
            f"{FEWEST_PICTURES} or more with different tilts are needed{others and f' (others: {others})'}. Pictures "
            "that were cut are taken for another camera's: give them as they were taken."
        )


def _chosen_lens(
    network: Network, first: Adjustment | None, project: Project, options: project_files.CalibrationOptions
) -> LensChoice:
    """Select the lens model of a camera by cross-validation over its images, also those left out by the first.

    All marks get one standard deviation, large enough for models with larger misfit than the first, but no larger than
    an adjustment accepts: the first may not suit the lens at all.
    """
    observations, largest_mm = network.observations, largest_sigma_mm(network)
    variance = float(np.median(np.trace(observations.covariance_mm2, axis1=1, axis2=2)) / 2.0)
    variance += (GENEROUS * sum(first.unmodelled_mm.values())) ** 2 if first else largest_mm**2
    variance = min(variance, largest_mm**2)
    covariance = np.broadcast_to(variance * np.eye(2), observations.covariance_mm2.shape).copy()
    alike = replace(network, observations=replace(observations, covariance_mm2=covariance))
    adjusted = partial(adjust, options=adjustment_options(project.adjust))
    return choose_lens(alike, options.square_pixels, options.pixel_mm, adjusted, first.start if first else None)


def _nothing(
    pictures: BoardPictureFiles,
    left_out: Mapping[str, str],
    not_calibrated: Mapping[str, str],
    board: project_files.BoardOptions,
) -> str:
    """Reason why no camera is calibrated."""
    number = sum(len(camera.images) for camera in pictures.cameras)
    if len(left_out) == number:
        found, shown = f"the board was found in none of {counted(number, 'picture')}", ""
        for name in pictures.cameras[0].images[:MOST_RECOGNISED]:
            with suppress(MeasurementError), open_scan(pictures.files[name]) as scan:
                if options := board.differing_options(fitting_board(scan, board.spec)):
                    return f"{found}: the markers of {name} lie as with {options}. Give that if it is the board's."
                found_options = recognise_dots(scan) or recognise_board(scan)
                if found_options and found_options not in board.chessboards:
                    shown = f": what {name} shows fits {found_options}"
                    break
        return (
            f"{found}; of most: {_most_common(left_out.values())}. "
            "Check --board (inner corners of a chessboard, not squares), --kind, --dictionary, --first-id, and that "
            f"the board is in the picture{shown}."
        )
    if len(pictures.cameras) > 1 and all(len(camera.images) < FEWEST_PICTURES for camera in pictures.cameras):
        sizes = listed([f"{camera.width_px} x {camera.height_px} px" for camera in pictures.cameras])
        return (
            f"the {number} pictures have {len(pictures.cameras)} sizes or focal lengths ({sizes}), and "
            f"{FEWEST_PICTURES} or more of one are needed. Pictures that were cut or reduced are taken for other "
            "cameras': give them as they were taken."
        )
    return "; ".join(f"{camera}: {why}" for camera, why in not_calibrated.items()) + (
        f" Left out: {listed_by_reason(left_out)}." if left_out else ""
    )


def _most_common(reasons: Iterable[str]) -> str:
    """The most frequent reason; "" without any."""
    return max(Counter(reasons).items(), key=itemgetter(1), default=("",))[0]


def calibrate(
    pictures: FilePath | Sequence[FilePath],
    board: str,
    square: str,
    *,
    kind: str = "chessboard",
    marker: str | None = None,
    dictionary: str | None = None,
    legacy: bool = False,
    first_id: int = 0,
    lens: str = "auto",
    square_pixels: bool = False,
    pitch_um: float | None = None,
    out: FilePath = OUT,
    ros: bool = False,
    workers: int | None = None,
    reporter: Reporter | None = None,
) -> CalibrationResult:
    """Calibrate digital cameras from images of a board, as `reseau calibrate` does.

    Parameters
    ----------
    pictures : a folder or an image file, or several of these
    board : columns x rows, such as "9x6": inner corners of a chessboard, squares, markers or circles
    square : side of a square, or distance from one marker or circle to the next, with its unit, such as "25mm"
    kind : chessboard, charuco, aprilgrid, aruco, circle-grid or asymmetric-circle-grid
    marker : side of a marker or diameter of a circle, with its unit
    dictionary : of the markers, such as "4X4_50"
    legacy : whether a ChArUco board has the older layout; if not set, both are tried
    first_id : number of the first marker
    lens : opencv4, opencv5, opencv8, fisheye, or auto, by cross-validation
    square_pixels : whether x and y have the same focal length
    pitch_um : side of a pixel, for results in mm
    out : folder of the project, camera.yaml and the report
    ros : whether ROS's camera info is written as well
    workers : number of measuring processes; None: one per core
    reporter : reports the progress, on stderr by default

    Returns
    -------
    CalibrationResult
        Its cameras in px with standard deviations, `adjustments` by camera, plots and a table.

    Raises
    ------
    InputError
        For a wrong option, and where no camera can be calibrated; the message gives the reason.

    Examples
    --------
    >>> result = reseau.calibrate("pictures", board="9x6", square="25mm")  # doctest: +SKIP
    >>> result.plot_uncertainty()  # doctest: +SKIP
    """
    if lens not in LENSES:
        raise InputError(f"--lens {lens}: possible are {', '.join(LENSES)}.{did_you_mean(lens, LENSES)}")
    given = project_files.board_options(kind, board, square, marker, dictionary, legacy, first_id)
    options = project_files.CalibrationOptions(given, LENSES[lens], square_pixels, pitch_um, ros)
    paths = [pictures] if isinstance(pictures, str | os.PathLike) else pictures
    return _calibrate_cameras([Path(path) for path in paths], Path(out), options, reporter or Reporter(), workers)
