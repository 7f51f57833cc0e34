"""Tone curve of each scanner: from the project, the files, or estimated from some of its scans before all are
measured."""

from collections.abc import Mapping, Sequence
from hashlib import sha256
from itertools import chain
from pathlib import Path

import numpy as np

from measure.marks.shapes import FrameCorner, Mark, MarkShape, Polygon
from measure.results import MEASURE_REVISION
from measure.scans.opening import declared_tone
from measure.tone.curve import Tone, ToneInformation, power, srgb
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.measuring.scan_task import Measure, Memory, sample_names, scan_tasks
from pipeline.progress import Reporter
from pipeline.provenance import fingerprint
from pipeline.results.measured_record import read_tone_information, tone_information_record

_SAMPLES = 8  # scans of a scanner from which its curve is estimated
_SET = "it is set in the project"


def tone_before(setting: float | str, said: Sequence[ToneInformation], scan: Path) -> Tone:
    """Prior tone curve of a scan, from the project, the file and other scans. The scan's own estimate is not yet
    included.

    Parameters
    ----------
    setting : from the project.
    said : information from other scans.
    """
    return _prior(setting, scan).include_information(said)


def collect_tones(
    project: Project, reporter: Reporter, measure: Measure, memory: Memory
) -> Mapping[str, tuple[ToneInformation, ...]]:
    """Estimate the tone curve of each scanner from a sample of scans whose marks depend on it.

    Scans that cannot be measured are left out. Estimates are kept, whatever scans are added or removed.

    Returns
    -------
    By image, the information from other scans of its scanner.
    """
    names = [name for name in project.scans if _leans_on_tone(project.image_camera(name))]
    if project.tone != "auto" or len(names) < 2:
        return {}
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(_kind(project, name), []).append(name)
    keys = {kind: _key(project, kind, of_kind) for kind, of_kind in kinds.items() if len(of_kind) > 1}
    before = {kind: memory.recall(key) for kind, key in keys.items()}
    samples = {kind: sample_names(kinds[kind], _SAMPLES) for kind, by_image in before.items() if by_image is None}
    tasks = [task.fiducials_alone(project.tone) for task in scan_tasks(project, list(chain(*samples.values())))]
    known = {name: read_tone_information(one) for kept in before.values() for name, one in (kept or {}).items()}
    with reporter.stage("tone curve estimated from") as tell:
        for done, scan in enumerate(measure(tasks), 1):
            tell(scan.frame.image, done, len(tasks))
            if scan.frame.tone is not None and scan.frame.tone.information is not None:
                known[scan.frame.image] = scan.frame.tone.information
    for kind, names_of in samples.items():
        memory.remember(keys[kind], {name: tone_information_record(known[name]) for name in names_of if name in known})
    by_image = dict[str, tuple[ToneInformation, ...]]()
    for kind, kept in before.items():
        of_kind = samples[kind] if kept is None else list(kept)
        by_others = {name: tuple(known[one] for one in of_kind if one in known and one != name) for name in of_kind}
        by_all = tuple(known[one] for one in of_kind if one in known)
        by_image |= {name: by_others.get(name, by_all) for name in kinds[kind]}
    return by_image


def _key(project: Project, kind: str, names: Sequence[str]) -> str:
    """Key of a scanner's estimates: the marks and settings that they depend on."""
    firsts = {project.image_camera(name).path: name for name in reversed(names)}
    tasks = scan_tasks(project, sorted(firsts.values()))
    options = sorted(task.fiducials_alone(project.tone).options_json() for task in tasks)
    return f"tone {fingerprint([kind, options, MEASURE_REVISION])}"


def _prior(setting: float | str, scan: Path) -> Tone:
    if setting == "auto":
        return declared_tone(scan) or Tone.unknown()
    if setting == "srgb":
        return Tone(srgb(), source=_SET)
    return Tone(power(1.0 if isinstance(setting, str) else setting), source=_SET)


def _kind(project: Project, image: str) -> str:
    """Group of scans with one tone curve: same scanner, file type and declared curve."""
    scan = project.scans[image]
    curve_hash = sha256(np.ascontiguousarray(_prior(project.tone, scan).base).tobytes()).hexdigest()[:8]
    return f"{project.image_scanner(image)} {scan.suffix.lower()} {curve_hash}"


def _leans_on_tone(camera: CameraFile) -> bool:
    """Whether a camera has marks that an error of the curve displaces: those with edges on one side only."""
    return any(_has_tip(one.mark) for one in camera.layout_marks)


def _has_tip(mark: Mark | object) -> bool:
    if isinstance(mark, FrameCorner):
        return True
    return isinstance(mark, MarkShape) and any(isinstance(part, Polygon) for part in mark.parts)
