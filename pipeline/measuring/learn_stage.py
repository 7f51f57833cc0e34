"""What is learned from some scans before all are measured: marks that have no drawing, and each scanner's tone curve.

First templates from one scan find the marks in every other; the mean over all scans is the final template.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from itertools import chain, count
from pathlib import Path

import numpy as np

from measure.marks.shapes import FrameCorner, MarkShape, MarkTemplate, Polygon
from measure.marks.templates import Chip, cut, learn_template, share_origins
from measure.results import MEASURE_REVISION, FrameMeasurement
from measure.scans.opening import declared_tone
from measure.scans.parallel import map_items
from measure.tone.curve import Tone, ToneInformation, power, srgb
from pipeline.files.camera_file import CameraFile, GivenFiducial, camera_text, read_camera
from pipeline.files.mark_table import picture_writer
from pipeline.files.project_file import Project
from pipeline.measuring.first_pictures import first_pictures
from pipeline.measuring.scan_task import Measure, Memory, ScanTask, sample_names, scan_tasks
from pipeline.provenance import content_hash, fingerprint, hash_content, hash_file
from pipeline.results.measured_record import plain_json, read_plain
from pipeline.terminal import Reporter
from pipeline.text.files import write_atomically

_SAMPLES = 8  # scans of a scanner from which its curve is estimated
_SET = "it is set in the project"
_BY = f"# Marks learned by reseau {version('reseau')}"


def learn_marks(
    project: Project, reporter: Reporter, measure: Measure, workers: Executor | None, folder: Path, memory: Memory
) -> Project:
    """Learn the marks of all cameras that need it.

    The folder then holds the templates and a camera file that refers to them, as they will stand in out/learned. Scans
    that cannot be measured are left out. Marks that were learned once stay, whatever scans are added or removed, as
    long as their files stand in out/learned.

    Returns the project with templates for the marks. Raises InputError or MeasurementError where the marks cannot be
    learned.
    """
    # A camera's file in out/learned has the name of the camera file, with a number where it is taken.
    paths = dict.fromkeys(camera.path for camera in project.cameras.values())
    stems, files = {path.stem for path in paths}, dict[Path, str]()
    for path in paths:
        taken = set(files.values())
        numbered = (f"{path.stem}-{number}" for number in count(2))
        is_there = path.stem in taken or path.parent.resolve() == _learned_folder(project).resolve()
        files[path] = next(name for name in numbered if name not in taken | stems) if is_there else path.stem
    known = add_learned_marks(project, memory)
    cameras = dict(known.cameras)
    for name, camera in known.cameras.items():
        if camera.learned:
            place = folder / f"{files[camera.path]}.toml"
            cameras[name] = _learn_marks(project, camera, place, reporter, measure, workers)
            if place.exists():
                memory.remember(_key(project, camera), {"file": place.name, "sha256": hash_file(place)})
    return replace(project, cameras=cameras)


def add_learned_marks(project: Project, memory: Memory) -> Project:
    """Add the marks that were learned earlier, if their files are unchanged; the marks of other cameras remain to be
    learned."""
    cameras = dict(project.cameras)
    for name, camera in project.cameras.items():
        if camera.learned:
            kept = memory.recall(_key(project, camera))
            path = _learned_folder(project) / (kept or {}).get("file", "")
            if kept is None or not path.is_file() or hash_file(path) != kept["sha256"]:
                continue
            learned = read_camera(path)
            camera = replace(camera, fiducials=learned.fiducials, learned_from=learned.learned_from)
        cameras[name] = _check_learned_scan(project, camera)
    return replace(project, cameras=cameras)


def _key(project: Project, camera: CameraFile) -> str:
    """Key of the learned marks: the marks, and the settings they depend on."""
    settings = [project.pitch_um, project.pose, project.film.sigma_mm, MEASURE_REVISION]
    return f"learned {fingerprint([camera.fiducials, camera.frame_mm, camera.clicks, settings])}"


def _learned_folder(project: Project) -> Path:
    return project.output / "learned"


def _check_learned_scan(project: Project, camera: CameraFile) -> CameraFile:
    """Drop the origin of learned marks, and the shares in them, where the project has no such scan."""
    # They then tell nothing of the scan orientations in this project.
    learned = camera.learned_from
    if learned is None or (
        learned.scan in project.scans and content_hash(project.scans[learned.scan]) == learned.sha256
    ):
        return camera
    fiducials = tuple(
        replace(one, mark=replace(one.mark, shares={f"{scan}\n": share for scan, share in one.mark.shares.items()}))
        if isinstance(one.mark, MarkTemplate)  # shares that match no image: a name never contains a line break
        else one
        for one in camera.fiducials
    )
    return replace(camera, fiducials=fiducials, learned_from=None)


def _learn_marks(
    project: Project, camera: CameraFile, place: Path, reporter: Reporter, measure: Measure, workers: Executor | None
) -> CameraFile:
    names = [name for name in project.scans if project.image_camera(name).path == camera.path]
    if not names:
        return camera
    with reporter.stage("learning marks, step") as count:
        count(f"{camera.name}: their first pictures", 0, 3)
        start = first_pictures(camera, _tasks(project, camera, names), workers)
        count(f"{camera.name}: sought in {len(names)} scans by these", 1, 3)
        chips, rivals = _chips(camera.learned, start, _tasks(project, start, names), measure, workers)
        if rivals:
            start = _average_origins(start, rivals)
            chips, _ = _chips(camera.learned, start, _tasks(project, start, names), measure, workers)
        count(f"{camera.name}: averaged", 2, 3)
        mean = _average_chips(start, camera.learned, chips, workers)
    return _store_camera(mean, place, _learned_folder(project))


def _tasks(project: Project, camera: CameraFile, names: Sequence[str]) -> list[ScanTask]:
    """Tasks that measure the fiducials in linear grey values, as templates hold these."""
    own = {name: camera if one.path == camera.path else one for name, one in project.cameras.items()}
    return [task.fiducials_alone("linear") for task in scan_tasks(replace(project, cameras=own), names)]


def _chips(
    learned: Sequence[GivenFiducial],
    start: CameraFile,
    tasks: Sequence[ScanTask],
    measure: Measure,
    workers: Executor | None,
) -> tuple[Mapping[str, list[Chip]], set[str]]:
    """Image patches of every learned mark, by fiducial; and the scan orientations that some frame leaves open."""
    frames = {scan.frame.image: scan.frame for scan in measure(tasks)}
    # Only of frames whose marks have certain names, up to their own symmetry, or the clicked orientation.
    alike = next((one.mark.alike for one in start.fiducials if isinstance(one.mark, MarkTemplate)), ())
    named = [
        (task, frame)
        for task in tasks
        if (frame := frames[task.name]).pose is not None and frame.pixel_from_camera is not None
        if start.learned_from is not None
        if frame.pose.is_unambiguous_up_to(alike) or frame.pose.name == start.learned_from.pose
    ]
    chips = defaultdict[str, list[Chip]](list)
    for of_scan in map_items(workers, partial(_learned_chips, learned), named):
        for id, chip in of_scan.items():
            chips[id].append(chip)
    return chips, {rival for frame in frames.values() if frame.pose for rival in frame.pose.rivals}


def _learned_chips(learned: Sequence[GivenFiducial], named: tuple[ScanTask, FrameMeasurement]) -> Mapping[str, Chip]:
    """Image patches of the learned marks found in one scan."""
    task, frame = named
    matrix = frame.pixel_from_camera
    assert matrix is not None
    found = {mark.point: mark.center_px for mark in frame.marks if mark.status.is_observation}
    with task.open() as scan:
        return {
            one.id: cut(scan, np.column_stack([matrix[:, :2], center]), one.learned_mm, frame.weights)
            for one in learned
            if (center := found.get(one.id)) is not None
        }


def _average_chips(
    start: CameraFile, learned: Sequence[GivenFiducial], chips: Mapping[str, list[Chip]], workers: Executor | None
) -> CameraFile:
    found = [one for one in learned if one.id in chips]
    templates = map_items(workers, _template, [(chips[one.id], one.learned_mm) for one in found])
    mean = {one.id: template for one, template in zip(found, templates, strict=True)}
    camera = replace(start, fiducials=tuple(replace(one, mark=mean.get(one.id, one.mark)) for one in start.fiducials))
    alike = {pose for one in start.fiducials if isinstance(one.mark, MarkTemplate) for pose in one.mark.alike}
    return _average_origins(camera, alike)


def _template(job: tuple[list[Chip], float]) -> MarkTemplate:
    return learn_template(*job)


def _average_origins(camera: CameraFile, poses: Collection[str]) -> CameraFile:
    """Average the origins of the learned marks over scan orientations in which the marks look alike."""
    learned = [one for one in camera.fiducials if isinstance(one.mark, MarkTemplate) and one.mark.learned_mm]
    if not learned:
        return camera
    places = np.array([one.template_origin_mm or one.xy_mm for one in learned])
    marks = [one.mark for one in learned if isinstance(one.mark, MarkTemplate)]
    templates, moves = share_origins(marks, places, poses)
    moved = {
        one.id: replace(one, mark=template, template_origin_mm=(float(x), float(y)))
        for one, template, (x, y) in zip(learned, templates, places + moves, strict=True)
    }
    return replace(camera, fiducials=tuple(moved.get(one.id, one) for one in camera.fiducials))


def _store_camera(camera: CameraFile, place: Path, folder: Path) -> CameraFile:
    """Write the camera to place, of later folder; return it as read back, so that later runs measure the same."""
    save = picture_writer(place.parent, f"{place.stem}-")
    write_atomically(place, camera_text(replace(camera, path=place), save))
    stored = replace(camera, fiducials=read_camera(place).fiducials)
    write_atomically(place, f"{_BY}\n{camera_text(replace(camera, path=folder / place.name), save)}")
    return stored


def prior_tone(setting: float | str, scan: Path) -> Tone:
    """Prior tone curve of a scan, from the setting of the project and the file."""
    if setting == "auto":
        return declared_tone(scan) or Tone.unknown()
    if setting == "srgb":
        return Tone(srgb(), source=_SET)
    return Tone(power(1.0 if isinstance(setting, str) else setting), source=_SET)


def collect_tones(
    project: Project, reporter: Reporter, measure: Measure, memory: Memory
) -> Mapping[str, tuple[ToneInformation, ...]]:
    """Estimate the tone curve of each scanner from a sample of scans whose marks depend on it.

    Scans that cannot be measured are left out. Estimates are kept, whatever scans are added or removed.

    Returns by image, the information from other scans of its scanner.
    """
    names = [name for name in project.scans if _leans_on_tone(project.image_camera(name))]
    if project.tone != "auto" or len(names) < 2:
        return {}
    kinds = defaultdict[str, list[str]](list)
    for name in names:
        kinds[_kind(project, name)].append(name)
    keys = {kind: _tone_key(project, kind, of_kind) for kind, of_kind in kinds.items() if len(of_kind) > 1}
    before = {kind: memory.recall(key) for kind, key in keys.items()}
    samples = {kind: sample_names(kinds[kind], _SAMPLES) for kind, by_image in before.items() if by_image is None}
    tasks = [task.fiducials_alone(project.tone) for task in scan_tasks(project, list(chain(*samples.values())))]
    known = {name: read_plain(ToneInformation, one) for kept in before.values() for name, one in (kept or {}).items()}
    with reporter.stage("tone curve from scan") as count:
        for done, scan in enumerate(measure(tasks), 1):
            count(scan.frame.image, done, len(tasks))
            if scan.frame.tone is not None and scan.frame.tone.information is not None:
                known[scan.frame.image] = scan.frame.tone.information
    for kind, names_of in samples.items():
        memory.remember(keys[kind], {name: plain_json(known[name]) for name in names_of if name in known})
    by_image = dict[str, tuple[ToneInformation, ...]]()
    for kind, kept in before.items():
        of_kind = samples[kind] if kept is None else list(kept)
        by_others = {name: tuple(known[one] for one in of_kind if one in known and one != name) for name in of_kind}
        by_all = tuple(known[one] for one in of_kind if one in known)
        by_image |= {name: by_others.get(name, by_all) for name in kinds[kind]}
    return by_image


def _tone_key(project: Project, kind: str, names: Sequence[str]) -> str:
    """Key of a scanner's estimates: the marks and settings that they depend on."""
    firsts = {project.image_camera(name).path: name for name in reversed(names)}
    tasks = scan_tasks(project, sorted(firsts.values()))
    options = sorted(task.fiducials_alone(project.tone).options.json for task in tasks)
    return f"tone curve {fingerprint([kind, options, MEASURE_REVISION])}"


def _kind(project: Project, image: str) -> str:
    """Group of scans with one tone curve: same scanner, file type and declared curve."""
    scan = project.scans[image]
    curve_hash = hash_content(np.ascontiguousarray(prior_tone(project.tone, scan).base).tobytes())[:8]
    return f"{project.image_scanner(image)} {scan.suffix.lower()} {curve_hash}"


def _leans_on_tone(camera: CameraFile) -> bool:
    """Whether a camera has marks that an error of the curve displaces: those with edges on one side only."""
    parts = [part for one in camera.layout_marks if isinstance(one.mark, MarkShape) for part in one.mark.parts]
    corners = [one for one in camera.layout_marks if isinstance(one.mark, FrameCorner)]
    return bool(corners) or any(isinstance(part, Polygon) for part in parts)
