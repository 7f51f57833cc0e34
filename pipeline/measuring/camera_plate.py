"""What a camera's own plate says, held against its file: another camera's plate is a problem, its own worth a note."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from measure.annotations.fields import CAMERA, Line, find_fields
from measure.flags import Code, Reason
from pipeline.files.camera_file import CameraFile
from pipeline.results.measured_scan import MeasuredScan

_OTHER_CONE = 0.02  # of the principal distance: cameras of one cone differ by less
_MAKERS = ("Wild", "Zeiss", "Jena", "Fairchild")


def plate_of(lines: Sequence[Line]) -> dict[str, str]:
    """Maker, number and principal distance in mm, as far as one plate says them."""
    found = {name: {field.value for field in find_fields(lines) if field.name == name} - {""} for name in CAMERA}
    return {name: next(iter(values)) for name, values in found.items() if len(values) == 1}


def is_whole_plate(lines: Sequence[Line]) -> bool:
    """Whether they say all that a plate says."""
    return len(plate_of(lines)) == len(CAMERA)


def contradictions(camera: CameraFile, plate: dict[str, str]) -> list[str]:
    """How a plate says that it is of another camera, a clause each."""
    told = []
    makers = [maker for maker in _MAKERS if maker.lower() in camera.name.lower()]
    if "camera_type" in plate and makers and plate["camera_type"] not in makers:
        told.append(f"it is of a camera by {plate['camera_type']}")
    given = camera.principal_distance_mm
    if given and "principal_distance_mm" in plate:
        read = float(plate["principal_distance_mm"])
        if abs(read / given - 1.0) > _OTHER_CONE:
            told.append(f"it gives a principal distance of {read:g} mm")
    if camera.number and plate.get("camera_number", camera.number) != camera.number:
        told.append(f"it gives the number {plate['camera_number']}, the file {camera.number}")
    return told


def with_plates(
    camera: CameraFile, scans: Sequence[MeasuredScan], cameras: Mapping[str, CameraFile]
) -> list[MeasuredScan]:
    """The scans of one camera with what their plates say. A principal distance that was read changes nothing. cameras:
    all of the project, by the names that images.csv has for them."""
    plates = {scan.frame.image: plate_of(scan.frame.writing or ()) for scan in scans}
    numbers = sorted({plate["camera_number"] for plate in plates.values() if "camera_number" in plate})
    known = {other.number: name for name, other in cameras.items() if other.number}
    return [_told(camera, scan, plates[scan.frame.image], numbers, known) for scan in scans]


def _told(
    camera: CameraFile, scan: MeasuredScan, plate: dict[str, str], numbers: Sequence[str], known: Mapping[str, str]
) -> MeasuredScan:
    problems, notes = [], []
    against = contradictions(camera, plate)
    if against:
        named = known.get(plate.get("camera_number", ""), "")
        its_own = f"the camera {named}, whose number that is," if named else "its own camera"
        problems.append(
            f"the plate in the picture is not of {camera.name}: {' and '.join(against)}. Give this scan {its_own} by "
            "the column camera of images.csv, or see in frames.csv whether the plate is misread."
        )
    if len(numbers) > 1 and "camera_number" in plate and not camera.number:
        problems.append(
            f"the scans of {camera.name} show plates of several cameras, Nr {', '.join(numbers)}: each has a "
            "calibration of its own. Give each a camera file with its number, by the column camera of images.csv, or "
            "see in frames.csv whether a number is misread."
        )
    if "principal_distance_mm" in plate and not against and camera.principal_distance_mm:
        number = f" (Nr {plate['camera_number']})" if "camera_number" in plate else ""
        notes.append(
            f"The camera's plate{number} says a principal distance of {plate['principal_distance_mm']} mm, its file "
            f"{camera.principal_distance_mm:g} mm: worth taking as an approximation, and nothing is changed by it."
        )
    frame = replace(scan.frame, problems=(*scan.frame.problems, *(Reason(each, Code.PLATE) for each in problems)))
    return replace(scan, frame=frame, notes=(*scan.notes, *notes))
