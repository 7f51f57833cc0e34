"""The tone curve of each scanner: as the project sets it, as the files say it, or else from a few of its scans, before
all are measured."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import numpy as np

from measure.errors import MeasurementError
from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.marks.shapes import FrameCorner, Mark, MarkShape, Polygon
from measure.scans.declared_tone import declared_tone
from measure.scans.tone import SaidOfTone, Tone, power, srgb
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.measuring.learn_stage import pose_of
from pipeline.progress import Reporter

_SAMPLES = 4  # scans of a scanner that tell its curve to the others
_SET = "it is set in the project"


@dataclass(frozen=True, eq=False)
class ScannerTones:
    """What a few scans said of their scanner's curve: by scanner and kind of file, then by image."""

    said: Mapping[str, Mapping[str, SaidOfTone]] = field(default_factory=dict)

    def tone_of(self, project: Project, image: str) -> Tone:
        """What is believed of the curve of a scan before it is measured: what it says itself is not in it yet."""
        path = project.scans[image]
        prior = _prior(project, path)
        if prior.is_known:
            return prior
        others = [said for name, said in self.said.get(_kind(project, image, prior), {}).items() if name != image]
        return prior.told(others)[0] if others else prior


def scanner_tones(project: Project, reporter: Reporter, workers: Executor) -> ScannerTones:
    """From some scans of each scanner, where marks of the camera lean on the curve. A scan that cannot be measured says
    nothing."""
    names = [name for name in project.scans if _leans_on_tone(project.camera_of(name))]
    if project.tone != "auto" or len(names) < 2:
        return ScannerTones()
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(_kind(project, name, _prior(project, project.scans[name])), []).append(name)
    samples = {kind: _spread(of_kind) for kind, of_kind in kinds.items() if len(of_kind) > 1}
    count = sum(map(len, samples.values()))
    said: dict[str, dict[str, SaidOfTone]] = {}
    with reporter.stage("tone curve looked for in") as tell:
        done = 0
        for kind, of_kind in samples.items():
            for name, told in zip(of_kind, workers.map(_said, [project] * len(of_kind), of_kind), strict=True):
                done += 1
                tell(name, done, count)
                if told is not None:
                    said.setdefault(kind, {})[name] = told
    return ScannerTones(said)


def _prior(project: Project, scan: Path) -> Tone:
    if project.tone == "auto":
        return declared_tone(scan) or Tone.unknown()
    if project.tone == "srgb":
        return Tone(srgb(), source=_SET)
    return Tone(power(1.0 if isinstance(project.tone, str) else project.tone), source=_SET)


def _kind(project: Project, image: str, prior: Tone) -> str:
    """One scanner codes light in one way, but for files of another kind or that say another curve."""
    told = sha256(np.ascontiguousarray(prior.base).tobytes()).hexdigest()[:8]
    return f"{project.scanner_of(image)} {project.scans[image].suffix.lower()} {told}"


def _leans_on_tone(camera: CameraFile) -> bool:
    """Whether it has marks that another curve moves: those with edges on one side only."""
    return any(_has_tip(one.mark) for one in camera.drawn)


def _has_tip(mark: Mark | object) -> bool:
    if isinstance(mark, FrameCorner):
        return True
    return isinstance(mark, MarkShape) and any(isinstance(part, Polygon) for part in mark.parts)


def _spread(names: Sequence[str]) -> list[str]:
    """Some of them, from the first to the last."""
    places = np.unique(np.linspace(0, len(names) - 1, min(_SAMPLES, len(names))).round().astype(int))
    return [names[place] for place in places]


def _said(project: Project, name: str) -> SaidOfTone | None:
    """What one scan's marks say of its curve."""
    camera = project.camera_of(name)
    try:
        with project.open_scan(name) as scan:
            seen = scan.seen_through(_prior(project, project.scans[name]))
            options = FiducialOptions(pose_of(project, camera, scan.name), film_sigma_mm=project.film_sigma_mm)
            frame = measure_fiducials(seen, camera.layout(), project.pitch_um or scan.pitch_um, options)
    except MeasurementError:
        return None
    return None if frame.tone is None else frame.tone.said
