"""The second step of measuring: the scans of one camera beside one another. What was measured stays as it is; what is
checked is made anew whenever a scan comes to them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NewType

from measure.boards.corners import one_definition
from measure.fiducials.across_frames import judged
from measure.fiducials.options import BelievedFilm
from measure.results import FrameMeasurement
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.roll import Roll
from pipeline.results.measured_scan import MeasuredScan

CheckedScan = NewType("CheckedScan", MeasuredScan)  # beside the others of its camera


def checked(
    camera: CameraFile,
    measured: Sequence[MeasuredScan],
    roll: Roll,
    again: Iterable[MeasuredScan],
    film: BelievedFilm,
) -> tuple[CheckedScan, ...]:
    """The scans of one camera as all of them together show them, in their order: their poses, one definition of the
    places of crossings, the fiducials judged together.

    camera: with templates in the place of marks that were learned. again: the scans of `roll.tasks`, measured.
    """
    scans = roll.named([scan for scan in measured if not scan.failure], {scan.frame.image: scan for scan in again})
    marks = one_definition([scan.frame.marks for scan in scans])
    frames = [replace(scan.frame, marks=own) for scan, own in zip(scans, marks, strict=True)]
    told = {
        scan.frame.image: replace(scan, frame=frame)
        for scan, frame in zip(scans, _judged(camera, frames, scans, film), strict=True)
    }
    return tuple(CheckedScan(told.get(scan.frame.image, scan)) for scan in measured)


def _judged(
    camera: CameraFile, frames: Sequence[FrameMeasurement], scans: Sequence[MeasuredScan], film: BelievedFilm
) -> Sequence[FrameMeasurement]:
    """The fiducials judged together, if the camera has any."""
    if not camera.drawn:
        return frames
    return judged(frames, camera.layout(), [scan.pitch_um for scan in scans], film).frames
