"""Entry point of `reseau calibrate`, with its options as given on the command line and in Python."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from pipeline.calibration.board_options import board_options
from pipeline.calibration.calibrate_stage import Calibration, calibrate_pictures
from pipeline.calibration.lens_choice import LensModel, LensSetting
from pipeline.calibration.project_files import CalibrationOptions
from pipeline.errors import InputError
from pipeline.progress import Reporter
from pipeline.text.wording import did_you_mean

OUT = Path("calibration")
LENSES: dict[str, LensSetting] = {"auto": "auto", **{model: model for model in get_args(LensModel)}}


def calibrate(
    pictures: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
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
    out: str | os.PathLike[str] = OUT,
    ros: bool = False,
    workers: int | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
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
    Calibration
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
    given = board_options(kind, board, square, marker, dictionary, legacy, first_id)
    options = CalibrationOptions(given, LENSES[lens], square_pixels, pitch_um, ros)
    paths = [pictures] if isinstance(pictures, str | os.PathLike) else pictures
    return calibrate_pictures([Path(path) for path in paths], Path(out), options, reporter or Reporter(), workers)
