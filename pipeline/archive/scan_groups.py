"""Scan groups: scans of one format, size and resolution, of which a few are tried to name the camera of all."""

import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from measure.boards.find import recognise_board
from measure.errors import MeasurementError
from measure.scans.opening import ScanHead, open_scan, read_head
from measure.scans.parallel import map_items
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.camera_identification import Identification
from pipeline.measuring.camera_trials import identify
from pipeline.progress import Count, Reporter
from pipeline.text.wording import counted

SAMPLES = 3  # scans of each group
_ALIKE = 0.03  # of their sides: scans of one roll are cut by hand
_SAME_PITCH = 0.01
_EVERY = 200  # files after which it is told how far it is
_SHAPES = (4 / 3, 3 / 2, 16 / 9)  # of digital cameras' pictures, whose sides are multiples of this:
_SIDES_PX = 8
CANDIDATES = 3  # cameras that are named where several may be it
_TELLING = {"camera_type", "principal_distance_mm"}  # of a plate's fields: what tells cameras apart


@dataclass(frozen=True, eq=False)
class ScanGroup:
    """Scans that are alike. head: that of the first; folder: where they stand; samples: what those show that were
    tried."""

    folder: Path
    head: ScanHead
    paths: tuple[Path, ...]
    samples: tuple[Identification, ...] = ()

    @property
    def to_try(self) -> list[Path]:
        """The samples among the scans, from the first to the last."""
        chosen = np.unique(np.linspace(0, len(self.paths) - 1, SAMPLES).round().astype(int))
        return [self.paths[index] for index in chosen]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that most samples name, no sample with a camera contradicts, and no plate."""
        named = [names for names in self._named if names]
        if 2 * len(named) <= len(self.samples):
            return ()
        against = frozenset(name for sample in self.samples for name in sample.contradicted)
        return tuple(sorted(frozenset.intersection(*named) - against))

    @property
    def candidates(self) -> tuple[str, ...]:
        """The few cameras that most samples show, of these those with the most calibration reports."""
        counts, reports = Counter(name for names in self._named for name in names), self._reports
        ranked = sorted(counts, key=lambda name: (-counts[name], -reports.get(name, 0), name))
        return tuple(ranked[:CANDIDATES])

    @property
    def board(self) -> str:
        """The calibration board that most samples show, as `reseau calibrate` takes it."""
        boards = Counter(sample.board for sample in self.samples if sample.board)
        ((board, count),) = boards.most_common(1) or [("", 0)]
        return board if 2 * count >= len(self.samples) else ""

    @property
    def digital(self) -> str:
        """What tells that these are pictures by a digital camera, a part of a sentence; "" of scans of film."""
        if self.head.camera:
            return f"taken by {self.head.camera}"
        if self.board:
            return "pictures of a calibration board"
        is_named = any(self._named)
        return "" if is_named or not has_sensor_size(self.head) else "of the size of digital cameras' pictures"

    @property
    def calibrate_command(self) -> str:
        """The command that calibrates the camera of such pictures."""
        return f"reseau calibrate {shlex.quote(str(self.folder))} {self.board or '--board COLUMNSxROWS'} --square SIZE"

    @property
    def camera(self) -> str:
        """Of cameras with the same marks the one that rests on most calibration reports; "" without any, and where the
        form of marks alone names them: then they may be of a camera that is not in the library."""
        if self.much_alike or self.digital:
            return ""
        return max(self.cameras, key=lambda name: self._reports.get(name, 0), default="")

    @property
    def much_alike(self) -> tuple[str, ...]:
        """Other cameras whose solid marks are drawn much like those that are named, where no plate says which."""
        if self.has_telling_plate:
            return ()
        others = dict.fromkeys(name for sample in self.samples for name in sample.much_alike())
        return tuple(others) if self.cameras else ()

    @property
    def has_telling_plate(self) -> bool:
        """Whether a plate in a sample tells cameras apart."""
        return any(_TELLING & sample.plate.keys() for sample in self.samples)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Of cameras, as their plates in the samples have them."""
        return tuple(sorted({sample.plate.get("camera_number", "") for sample in self.samples} - {""}))

    @property
    def pixel_um(self) -> float | None:
        """What the marks say of a pixel, the median of the samples."""
        pixels = [trial.pixel_um for sample in self.samples for trial in sample.best[:1] if trial.pixel_um]
        return float(np.median(pixels)) if pixels else None

    def sentence(self) -> str:
        """How many scans of which size, and their camera."""
        count, size = len(self.paths), f"about {self.head.width_px} x {self.head.height_px} px"
        names = f"{' or '.join(self.cameras)}, by {len(self.samples)} of them" if self.camera else self.why_not()
        return f"{count} scan{'s' * (count > 1)} of {size}: {names}."

    def why_not(self) -> str:
        """Why no camera is named, a part of a sentence."""
        if self.digital:
            board = f"the command has the board that they show ({self.board})" if self.board else "no board was found"
            return f"{self.digital}, no film: {board}"
        if self.cameras:
            firsts = [trial for sample in self.samples for trial in sample.best[:1]]
            found, drawn = sum(trial.found for trial in firsts), sum(trial.drawn for trial in firsts)
            alike = " or ".join(self.much_alike[:CANDIDATES])
            return (
                f"perhaps {' or '.join(self.candidates)}, {found} of {drawn} marks found, but that rests on the form "
                f"of its marks alone, and {alike} has marks much like them: compare the drawings with a scan"
            )
        counts = Counter(name for names in self._named for name in names)
        if not counts:
            return f"no camera stands out in {len(self.samples)} of them"
        counts_text = ", ".join(f"{name} in {counts[name]}" for name in self.candidates)
        if 2 * sum(map(bool, self._named)) > len(self.samples) and frozenset.intersection(*filter(None, self._named)):
            return f"the marks are those of {counts_text}, but the camera's plate in the picture names another camera"
        return f"of {len(self.samples)} samples not all show the same camera ({counts_text})"

    @property
    def _reports(self) -> Mapping[str, int]:
        return {name: count for sample in self.samples for name, count in sample.reports.items()}

    @property
    def _named(self) -> list[frozenset[str]]:
        """The cameras that each sample names."""
        return [frozenset(name for trial in sample.best for name in trial.cameras) for sample in self.samples]

    def as_json(self) -> Mapping[str, object]:
        """For programs."""
        return {
            "scans": [str(path) for path in self.paths],
            "size_px": [self.head.width_px, self.head.height_px],
            "best": list(self.cameras),
            "camera": self.camera,
            "candidates": list(self.candidates),
            "digital": self.digital,
            "board": self.board,
            "sentence": self.sentence(),
            "samples": [sample.as_json() for sample in self.samples],
        }


@dataclass(frozen=True)
class GroupedScans:
    """unread: by path, why a scan cannot be read."""

    groups: tuple[ScanGroup, ...]
    unread: Mapping[Path, str]

    @property
    def all_named(self) -> bool:
        """Whether every scan is of a camera that is known."""
        return not self.unread and all(group.camera for group in self.groups)

    def as_json(self) -> Mapping[str, object]:
        """For programs."""
        unread = [{"scan": str(path), "reason": reason} for path, reason in self.unread.items()]
        return {"kinds": [group.as_json() for group in self.groups], "unread": unread}


def group_scans(
    files: Sequence[Path], count: Count, max_pixels: int | None = None, by_folder: bool = True
) -> GroupedScans:
    """Group scans by format, channels, bits, resolution and about their size. Of each some kilobytes are read.

    by_folder: whether the scans of each folder are groups of their own.
    """
    heads, unread = defaultdict[tuple[object, ...], list[tuple[int, ScanHead]]](list), dict[Path, str]()
    members = defaultdict[tuple[Path, int], list[tuple[Path, ScanHead]]](list)
    number = 0
    for done, path in enumerate(files):
        if done % _EVERY == 0:
            count("files", done, len(files))
        try:
            head = read_head(path, max_pixels)
        except MeasurementError as error:
            unread[path] = str(error)
            continue
        alike = heads[head.file_format, head.channels, head.bits, head.pitch.um is None, head.camera]
        own = next((known for known, other in alike if _is_like(other, head)), None)
        if own is None:
            own, number = number, number + 1
            alike.append((own, head))
        members[path.parent if by_folder else Path(), own].append((path, head))
    groups = (
        ScanGroup(some[0][0].parent, some[0][1], tuple(path for path, _ in some))
        for _, some in sorted(members.items(), key=lambda item: item[0])
    )
    return GroupedScans(tuple(groups), unread)


def _is_like(one: ScanHead, other: ScanHead) -> bool:
    sides = (one.width_px, other.width_px), (one.height_px, other.height_px)
    pitches = zip(one.pitch.um or (), other.pitch.um or (), strict=True)
    return all(abs(a - b) <= _ALIKE * a for a, b in sides) and all(abs(a - b) <= _SAME_PITCH * a for a, b in pitches)


def has_sensor_size(head: ScanHead) -> bool:
    """Whether a picture is as digital cameras make them: of one of their shapes, without a resolution."""
    short, long = sorted((head.width_px, head.height_px))
    is_whole = short % _SIDES_PX == long % _SIDES_PX == 0
    return is_whole and head.pitch.um is None and any(abs(long / short / shape - 1) < 1e-3 for shape in _SHAPES)


Sample = tuple[Path, tuple[str, ...]]  # a scan, and cameras that another one of its group shows
Try = Callable[[Sample], Identification | str]


def name_cameras(grouped: GroupedScans, identified: Try, reporter: Reporter, workers: Executor | None) -> GroupedScans:
    """The groups with what their samples show. identified: of a scan, or why it cannot be read. Cameras that the first
    sample of a group shows are the first to be tried on the others."""
    total = sum(len(group.to_try) for group in grouped.groups)
    of_groups = f"scans of {counted(len(grouped.groups), 'group')} on the camera library"
    answers = dict[Path, Identification | str]()
    with reporter.stage("tried") as count:
        for is_first in (True, False):
            samples: list[Sample] = [
                (path, () if is_first else _camera_names(answers[group.to_try[0]]))
                for group in grouped.groups
                for path in (group.to_try[:1] if is_first else group.to_try[1:])
            ]
            for (path, _), answer in zip(samples, map_items(workers, identified, samples), strict=True):
                answers[path] = answer
                count(of_groups, len(answers), total)
    groups = [
        replace(
            group, samples=tuple(answer for path in group.to_try if isinstance(answer := answers[path], Identification))
        )
        for group in grouped.groups
    ]
    unread = {path: answer for path, answer in answers.items() if isinstance(answer, str)}
    return GroupedScans(tuple(part for group in groups for part in _split_cameras(group)), {**grouped.unread, **unread})


def _split_cameras(group: ScanGroup) -> list[ScanGroup]:
    """The group; where all its scans were tried and show several cameras, the scans of each."""
    if group.camera or group.digital or len(group.samples) < len(group.paths) or len(group.paths) < 2:
        return [group]
    parts = defaultdict[str, list[Identification]](list)
    for sample in group.samples:
        parts[replace(group, samples=(sample,)).camera].append(sample)
    return [replace(group, paths=tuple(one.scan for one in own), samples=tuple(own)) for own in parts.values()]


def _camera_names(answer: Identification | str) -> tuple[str, ...]:
    """Those that a sample shows."""
    best = answer.best if isinstance(answer, Identification) else ()
    return tuple(name for trial in best for name in trial.cameras)


def trial_of_cameras(cameras: Mapping[str, CameraFile], pitch_um: float | None, max_pixels: int | None) -> Try:
    """What tries cameras on a scan, in any process."""
    return partial(_identified, cameras=cameras, pitch_um=pitch_um, max_pixels=max_pixels)


def _identified(
    sample: Sample, cameras: Mapping[str, CameraFile], pitch_um: float | None, max_pixels: int | None
) -> Identification | str:
    path, likely = sample
    try:
        head = read_head(path, max_pixels)
        board = _board(path, max_pixels) if head.camera or has_sensor_size(head) else ""
        if board or head.camera:
            return Identification(path, (), board=board)
        found = identify(path, cameras, pitch_um, Reporter(Console(quiet=True)), max_pixels, likely)
        is_scan = head.pitch.um is not None
        return found if found.best or is_scan else replace(found, board=_board(path, max_pixels))
    except MeasurementError as error:
        return str(error)


def _board(path: Path, max_pixels: int | None) -> str:
    with open_scan(path, max_pixels) as scan:
        return recognise_board(scan)


def print_groups(grouped: GroupedScans, console: Console) -> None:
    """Every group with its samples."""
    for group in grouped.groups:
        console.print(group.sentence(), style="bold", highlight=False, soft_wrap=True)
        for sample in group.samples:
            console.print(f"    {sample.sentence()}", highlight=False, soft_wrap=True)
    for reason in grouped.unread.values():
        console.print(f"not tried: {reason}", highlight=False, soft_wrap=True)
