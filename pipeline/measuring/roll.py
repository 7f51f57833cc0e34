"""Second step of measuring: cross-scan checks of one camera, whose frames get one scan orientation by their text."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.annotations.lines import KnownLine, Line, masked_text
from measure.boards.measure import one_definition
from measure.fiducials.across_frames import check_frames
from measure.fiducials.options import BelievedFilm
from measure.fiducials.scan_orientation import DECIDED, LEAST_REPORTED, bounded, line_score
from measure.flags import Code, Reason, Status
from measure.geometry import POSES, UP_FROM_CAMERA, pose_in_camera
from measure.marks.shapes import WrittenPlace
from measure.results import FrameMeasurement, ScanOrientation
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.scan_task import Measure, ScanOptions, ScanTask, sample_names
from pipeline.results.measured_record import MeasuredScan, unique_fields
from pipeline.terminal import Reporter

_ONE_QUESTION = (
    "the frames are named so that what is written lies alike in all of the camera whose writing was read; nothing says "
    "how the camera has it"
)
_READ_FIRST = 4  # frames of a camera on which all text is read
_WAYS = 2  # scan orientations searched by known lines: more would take as long as reading all text
_LEAST = 6  # letters and digits that a known line needs
_TURNS = ("0", "90", "180", "270")  # directions of text in the camera's frame
_SAME = ("run", "frames", "date")  # fields that identify a frame together with its number


def name_roll(
    tasks: Sequence[ScanTask], scans: Sequence[MeasuredScan], places: Sequence[WrittenPlace], measure: Measure
) -> list[MeasuredScan]:
    """Name the marks of one camera's scans by scan orientations from all of its frames together. Scans whose marks get
    other names by this are measured again.
    """
    both = list(zip(tasks, scans, strict=True))
    free = [scan for task, scan in both if task.options.fiducials.pose == "auto" and not scan.failure]
    poses = poses_of_roll(free, places)
    names = {scan.frame.image: scan.frame.pose.name for scan in free if scan.frame.pose}
    again = [task.fix_orientation(poses[task.name].name) for task in tasks if task.name in poses]
    other = [task for task in again if task.options.fiducials.pose != names.get(task.name)]
    new = {scan.frame.image: scan for scan in (measure(other) if other else ())}
    named = []
    for scan in scans:
        frame, latest = scan.frame, new.get(scan.frame.image, scan)
        if not latest.failure:  # the file was readable before: then the first measurement stays
            pose = poses.get(frame.image, frame.pose)
            scan = replace(latest, frame=replace(latest.frame, pose=pose, writing=frame.writing))
        named.append(scan)
    return named


def add_known_lines(
    tasks: Sequence[ScanTask], measure: Measure, reporter: Reporter
) -> tuple[tuple[ScanTask, ...], Mapping[str, MeasuredScan]]:
    """Add known text lines to the tasks, by which frames with the same scan orientation are recognised.

    Returns
    -------
    The tasks, in their order; and, by image, the few scans measured for this. This sample rarely changes when scans are
    added or removed.
    """
    of_camera = defaultdict[int, list[ScanTask]](list)
    for task in tasks:
        has_marks = bool(task.options.camera.fiducials)  # pictures of a digital camera have none, and no writing
        if has_marks and task.options.fiducials.pose == "auto" and task.options.fiducials.writing == "pose":
            of_camera[id(task.options.camera)].append(task)
    rolls = dict[int, list[ScanTask]]()  # the sample of each camera on which all text is read
    for camera, own in of_camera.items():
        if len(own) > _READ_FIRST:
            few = sample_names([task.name for task in own], _READ_FIRST)
            rolls[camera] = [task for task in own if task.name in few]
    first = [task for own in rolls.values() for task in own]
    measured = dict[str, MeasuredScan]()
    with reporter.stage("reading the writing of scan") as count:
        for done, scan in enumerate(measure(first) if first else (), 1):
            measured[scan.frame.image] = scan
            count(scan.frame.image, done, len(first))
    known = {camera: known_lines([measured[task.name].frame for task in own]) for camera, own in rolls.items()}
    options = dict[int, ScanOptions]()  # keeps shared options shared
    knowing = []
    for task in tasks:
        lines = known.get(id(task.options.camera), ())
        if lines and task.name not in measured and task.options.fiducials.writing == "pose":
            options.setdefault(id(task.options), task.change_options(known_lines=lines).options)
            task = replace(task, options=options[id(task.options)])
        knowing.append(task)
    return tuple(knowing), measured


def known_lines(frames: Sequence[FrameMeasurement]) -> tuple[KnownLine, ...]:
    """Lines by which the scan orientation of frames not yet read can be recognised.

    For each scan orientation that occurs in two or more frames, the line with the most distinct orientation.
    """
    lines = [(known, line) for frame in frames for line in frame.writing or () if (known := _known_line(frame, line))]
    recurring = [
        (known, line)
        for known, line in lines
        if sum(known.side == other.side and known.matches(again) for other, again in lines) > 1
    ]
    best: dict[str, tuple[KnownLine, Line]] = {}
    for known, line in sorted(recurring, key=lambda each: -each[1].lead):
        best.setdefault(known.pose, (known, line))
    return tuple(known for known, _ in list(best.values())[:_WAYS])


def _known_line(frame: FrameMeasurement, line: Line) -> KnownLine | None:
    """The line as it may recur on other frames of the roll; None where it has too little text."""
    letters = masked_text(line.text)
    if frame.pixel_from_camera is None or frame.pose is None or len(letters) < _LEAST or not letters.strip("0"):
        return None
    matrix = frame.pixel_from_camera
    up_from_pixel = np.linalg.inv(matrix[:, :2] @ UP_FROM_CAMERA[frame.pose.name].T)
    outline_mm = (np.array(line.outline_px) - matrix[:, 2]) @ up_from_pixel.T
    return KnownLine(line.text, line.pose, line.side, tuple((float(x), float(y)) for x, y in outline_mm))


def poses_of_roll(scans: Sequence[MeasuredScan], places: Sequence[WrittenPlace]) -> Mapping[str, ScanOrientation]:
    """Scan orientations, by image, that change when all frames of one camera are considered together.

    scans: of one camera, with scan orientations that nobody has set.
    """
    frames = [scan.frame for scan in scans]
    poses = {frame.image: frame.pose for frame in frames if frame.pose is not None and frame.pose.writing}
    if len(poses) < 2:
        return {}
    likelihoods = _writing_likelihoods([frame for frame in frames if frame.image in poses], places)
    alike = [turn for turn in _TURNS if likelihoods[turn] > -DECIDED]
    usual = Counter(_turn(pose) for pose in poses.values())
    chosen = max(alike, key=lambda turn: (likelihoods[turn] > -LEAST_REPORTED, usual[turn]))
    undecided = [frame for frame in frames if frame.image in poses and not poses[frame.image].decided]
    return {frame.image: _joint_orientation(frame, chosen, len(alike) == 1, len(poses)) for frame in undecided}


def _writing_likelihoods(frames: Sequence[FrameMeasurement], places: Sequence[WrittenPlace]) -> Mapping[str, float]:
    """Log-likelihoods of the directions of text in the camera's frame, 0 for the best."""
    # Text that recurs on several frames, except for its digits, is one title or one stamp and counts once.
    texts: dict[str, tuple[ScanOrientation, Line]] = {}
    for frame in frames:
        assert frame.pose is not None
        for line in frame.writing or ():
            texts.setdefault(re.sub(r"[\W\d]", "", line.text) or re.sub(r"\d", "0", line.text), (frame.pose, line))
    certain_turns = {_turn(frame.pose) for frame in frames if frame.pose and frame.pose.decided}
    scores = [sum(line_score(line, places, _scan_pose(pose, turn)) for pose, line in texts.values()) for turn in _TURNS]
    likelihoods = bounded(np.array(scores)) - [DECIDED if certain_turns - {turn} else 0.0 for turn in _TURNS]
    return dict(zip(_TURNS, (likelihoods - likelihoods.max()).tolist(), strict=True))


def _joint_orientation(frame: FrameMeasurement, turn: str, is_determined: bool, frames: int) -> ScanOrientation:
    """Scan orientation of a frame with text in this direction. is_determined: whether all frames
    determine it."""
    assert frame.pose is not None
    pose = replace(frame.pose, name=_scan_pose(frame.pose, turn))
    plain, mirrored = (
        max((value for name, value in pose.written.items() if name.endswith("m") == is_mirrored), default=0.0)
        for is_mirrored in (False, True)
    )
    # Whether the scan is mirrored is known by the frame alone; the frame itself may be a false detection.
    is_face_known = abs(plain - mirrored) >= DECIDED
    fiducials = [mark.status for mark in frame.marks if mark.kind == "fiducial"]
    is_doubted = Status.MEASURED not in fiducials or any(problem in frame.pose.evidence for problem in frame.problems)
    if is_doubted or not is_face_known:
        like = f"named {pose.name} as the other frames of the camera, so that its writing lies as theirs."
        return replace(pose, evidence=(*pose.evidence, like)) if pose.name != frame.pose.name else pose
    if not is_determined:
        return replace(pose, evidence=(f"{_ONE_QUESTION}.", *pose.evidence[1:]), roll=_ONE_QUESTION)
    together = f"what is written lies alike in {frames} frames of the camera, and together they tell how it has it."
    return replace(pose, decided=True, evidence=(together, *pose.evidence[1:]))


def _turn(pose: ScanOrientation) -> str:
    """Direction of the text in the camera's frame, if the frame has this scan orientation."""
    return pose_in_camera(pose.writing, pose.name)


def _scan_pose(pose: ScanOrientation, turn: str) -> str:
    """Scan orientation of a frame whose text has this direction in the camera's frame."""
    return next(name for name in POSES if pose_in_camera(pose.writing, name) == turn)


# Cross-scan checks of one camera. The measurements stay as they are; the checks are repeated whenever a scan is added.


def check_scans(camera: CameraFile, measured: Sequence[MeasuredScan], film: BelievedFilm) -> tuple[MeasuredScan, ...]:
    """Check the scans of one camera against one another: the definition of crossings, and fiducials.

    camera : with templates for the marks that were learned. Returns the scans in their order.
    """
    scans = [scan for scan in measured if not scan.failure]
    marks = one_definition([scan.frame.marks for scan in scans])
    frames: Sequence[FrameMeasurement] = [
        replace(scan.frame, marks=own) for scan, own in zip(scans, marks, strict=True)
    ]
    if camera.layout_marks:
        frames = check_frames(frames, camera.layout(), [scan.pitch_um for scan in scans], film).frames
    by_image = {scan.frame.image: replace(scan, frame=frame) for scan, frame in zip(scans, frames, strict=True)}
    return tuple(by_image.get(scan.frame.image, scan) for scan in measured)


def note_same_frames(scans: Sequence[MeasuredScan], part_of: Callable[[str], str]) -> list[MeasuredScan]:
    """Add a problem to scans whose text names the same frame.

    Parameters
    ----------
    part_of : the frame of which an image is one of several partial scans; these share a frame on purpose.
    """
    # The number identifies a frame together with the run, its frames or the date.
    fields = {scan.frame.image: unique_fields(scan.frame.writing or (), ("frame", *_SAME)) for scan in scans}
    named = defaultdict[str, list[str]](list)
    for image, values in fields.items():
        if "frame" in values and len(values) > 1:
            named[", ".join(f"{field} {value}" for field, value in values.items())].append(image)
    problems = dict[str, Reason]()
    for text, images in named.items():
        for own in images:
            alike = [image for image in images if not (part_of(own) and part_of(image) == part_of(own))]
            if others := [image for image in alike if image != own]:
                problems[own] = Reason(
                    f"its writing says {text}, and so does that of {' and '.join(others)}: these are scans of one "
                    "frame, or a line is misread. Leave one of them out, or look at frames.csv.",
                    Code.AMBIGUOUS,
                )
    return [scan.changed(problems=[problems[name]] if (name := scan.frame.image) in problems else []) for scan in scans]
