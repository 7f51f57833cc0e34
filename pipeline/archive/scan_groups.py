"""Scans of folders and stores, in groups of one format, size and resolution: samples of each are tried to identify the
camera of all."""

import os
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from measure.boards.find import recognise_board
from measure.errors import MeasurementError
from measure.marks.shapes import is_made_of_areas
from measure.scans.opening import ScanHead, open_scan, read_head
from measure.scans.parallel import map_items
from measure.scans.remote import Address, list_addresses
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.library import library_names, library_path
from pipeline.files.scan_files import each_once, folders_below
from pipeline.measuring.camera_identification import Identification
from pipeline.measuring.camera_trials import identify
from pipeline.provenance import alike_groups, content_hash, parts_hash
from pipeline.terminal import Count, Reporter
from pipeline.text.files import SCAN_ENDINGS
from pipeline.text.wording import counted

SAMPLES = 3  # scans tried of each group
_ALIKE = 0.03  # largest relative difference of sides: scans of one roll are cut by hand
_SAME_PITCH = 0.01
_EVERY = 200  # files between progress reports
_SHAPES = (4 / 3, 3 / 2, 16 / 9)  # aspect ratios of digital cameras' images; their sides are multiples of:
_SIDES_PX = 8
CANDIDATES = 3  # cameras that are named where several are possible
_TELLING = {"camera_type", "principal_distance_mm"}  # fields of a plate that distinguish cameras


@dataclass(frozen=True, eq=False)
class ScanGroup:
    """Scans of one format, size and resolution.

    samples: identifications of the scans that were tried.
    """

    folder: Path
    head: ScanHead
    paths: tuple[Path, ...]
    samples: tuple[Identification, ...] = ()

    @property
    def to_try(self) -> list[Path]:
        """Scans to be tried, spread evenly from the first to the last."""
        chosen = np.unique(np.linspace(0, len(self.paths) - 1, SAMPLES).round().astype(int))
        return [self.paths[index] for index in chosen]

    @property
    def _common(self) -> frozenset[str]:
        """Cameras that are common to the samples with a result, if most have one."""
        named = [names for names in self._named if names]
        return frozenset.intersection(*named) if 2 * len(named) > len(self.samples) else frozenset()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras common to most samples, without those that a sample's plate contradicts."""
        return tuple(sorted(self._common.difference(*(sample.contradicted for sample in self.samples))))

    @property
    def candidates(self) -> tuple[str, ...]:
        """The few cameras that most samples show; among equals, those with the most calibration reports."""
        counts, reports = self._counts, self._reports
        ranked = sorted(counts, key=lambda name: (-counts[name], -reports.get(name, 0), name))
        return tuple(ranked[:CANDIDATES])

    @property
    def board(self) -> str:
        """Calibration board that at least half of the samples show, as an argument of `reseau calibrate`."""
        boards = Counter(sample.board for sample in self.samples if sample.board)
        ((board, count),) = boards.most_common(1) or [("", 0)]
        return board if 2 * count >= len(self.samples) else ""

    @property
    def digital(self) -> str:
        """Why these are images of a digital camera, as part of a sentence; "" for scans of film."""
        if self.head.camera:
            return f"taken by {self.head.camera}"
        if self.board:
            return "pictures of a calibration board"
        is_named = any(self._named)
        return "" if is_named or not has_sensor_size(self.head) else "of the size of digital cameras' pictures"

    @property
    def calibrate_command(self) -> str:
        """Command that calibrates the camera of digital images."""
        return f"reseau calibrate {shlex.quote(str(self.folder))} {self.board or '--board COLUMNSxROWS'} --square SIZE"

    @property
    def camera(self) -> str:
        """The identified camera; among cameras with the same marks, the one with the most calibration reports.

        "" where none is identified, or solid marks alone identify it although another camera has similar ones, or the
        file gives another pitch: the true camera may then be missing from the library.
        """
        is_against_pitch = any(sample.against_pitch() for sample in self.samples)  # likely a false alarm of such marks
        if self.much_alike or self.digital or (is_against_pitch and self.rests_on_form):
            return ""
        return max(self.cameras, key=lambda name: self._reports.get(name, 0), default="")

    @property
    def much_alike(self) -> tuple[str, ...]:
        """Other cameras with similar solid marks, where no plate decides."""
        if self.has_telling_plate:
            return ()
        others = dict.fromkeys(name for sample in self.samples for name in sample.much_alike())
        return tuple(others) if self.cameras else ()

    @property
    def unlike(self) -> list[Path]:
        """Samples that do not show the identified camera: others may be among the group's scans."""
        return [sample.scan for sample in self.samples if self.camera and self.camera not in sample.best_names()]

    @property
    def rests_on_form(self) -> bool:
        """Whether solid marks (wings, notches, arrows) alone identify the camera."""
        known = [] if self.has_telling_plate else [name for name in self.cameras if name in library_names()]
        marks = [mark for name in known for mark in read_camera(library_path(name)).layout().marks]
        return bool(marks) and all(map(is_made_of_areas, marks))

    @property
    def has_telling_plate(self) -> bool:
        """Whether a plate in a sample distinguishes cameras."""
        return any(_TELLING & sample.plate.keys() for sample in self.samples)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Serial numbers of cameras on the plates in the samples."""
        return tuple(sorted({sample.plate.get("camera_number", "") for sample in self.samples} - {""}))

    @property
    def pixel_um(self) -> float | None:
        """Pixel pitch from the separations of marks, µm: the median of the samples."""
        pixels = [trial.pixel_um for sample in self.samples for trial in sample.best[:1] if trial.pixel_um]
        return float(np.median(pixels)) if pixels else None

    def sentence(self) -> str:
        """Sentence with the number and size of the scans, and their camera."""
        count, size = len(self.paths), f"about {self.head.width_px} x {self.head.height_px} px"
        names = f"{' or '.join(self.cameras)}, by {len(self.samples)} of them" if self.camera else self.why_not()
        return f"{count} scan{'s' * (count > 1)} of {size}: {names}."

    def why_not(self) -> str:
        """Why no camera is named, as part of a sentence."""
        if self.digital:
            board = f"the command has the board that they show ({self.board})" if self.board else "no board was found"
            return f"{self.digital}, no film: {board}"
        if self.cameras:
            firsts = [trial for sample in self.samples for trial in sample.best[:1]]
            found, drawn = sum(trial.found for trial in firsts), sum(trial.drawn for trial in firsts)
            alike = " or ".join(self.much_alike[:CANDIDATES])
            against = f"{alike} has marks much like them" if alike else "their separations contradict the file's pitch"
            return (
                f"perhaps {' or '.join(self.candidates)}, {found} of {drawn} marks found, but that rests on the form "
                f"of its marks alone, and {against}: compare the drawings with a scan"
            )
        if not self._counts:
            coarse = next((text for sample in self.samples if (text := sample.too_coarse())), "")
            return f"no camera stands out in {len(self.samples)} of them{coarse and f'.{coarse}'.rstrip('.')}"
        counts_text = ", ".join(f"{name} in {self._counts[name]}" for name in self.candidates)
        if self._common:
            return f"the marks are those of {counts_text}, but the camera's plate in the picture names another camera"
        return f"of {len(self.samples)} samples not all show the same camera ({counts_text})"

    @property
    def _reports(self) -> Mapping[str, int]:
        return {name: count for sample in self.samples for name, count in sample.reports.items()}

    @property
    def _named(self) -> list[frozenset[str]]:
        """Cameras that each sample names."""
        return [frozenset(sample.best_names()) for sample in self.samples]

    @property
    def _counts(self) -> Counter[str]:
        """Number of samples that name each camera."""
        return Counter(name for names in self._named for name in names)

    def as_json(self) -> Mapping[str, object]:
        """Content for JSON output."""
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


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Catalogue of scans.

    Attributes
    ----------
    unread : {file: why it cannot be read}.
    copies : {file: the file with the same bytes that stands for it}.
    endings : number of files that are not scans, by file name ending.
    """

    groups: tuple[ScanGroup, ...]
    unread: Mapping[Path, str]
    copies: Mapping[Path, Path] = field(default_factory=dict)
    endings: Mapping[str, int] = field(default_factory=dict)

    @property
    def files(self) -> int:
        """Number of files that were examined."""
        return sum(len(group.paths) for group in self.groups) + len(self.unread) + len(self.copies)

    @property
    def all_named(self) -> bool:
        """Whether the camera of every scan is known."""
        return not self.unread and all(group.camera for group in self.groups)

    def as_json(self) -> Mapping[str, object]:
        """Content for JSON output."""
        unread = [{"scan": str(path), "reason": reason} for path, reason in self.unread.items()]
        return {"kinds": [group.as_json() for group in self.groups], "unread": unread}


def catalogue(given: Sequence[Path], count: Count, max_pixels: int | None = None, by_folder: bool = True) -> Catalogue:
    """Catalogue the scans given as files, addresses and folders (with all subfolders), including stores and servers.

    Scans are grouped by format, channels, bits, camera, resolution and approximate size. Some kilobytes of each are
    read, and only the files' names are held in memory.

    by_folder: form separate groups for each folder, and leave out copies. Raises InputError where there is no scan, and
    MeasurementError where an address cannot be listed.
    """
    files, endings = find_scan_files(given)
    heads, unread = defaultdict[tuple[object, ...], list[tuple[int, ScanHead]]](list), dict[Path, str]()
    members = defaultdict[tuple[Path, int], list[tuple[Path, ScanHead]]](list)
    number = 0
    for number_read, path in enumerate(files, 1):
        if number_read % _EVERY == 0 or number_read == len(files):
            count("", number_read, len(files))
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
    copies = dict[Path, Path]()
    if by_folder:
        # The original has the shortest name: copies are called `Copy of 0001` or `0001 (1)`.
        by_name = sorted((path for path in files if path not in unread), key=lambda path: len(path.name))
        for original, *others in alike_groups(by_name, lambda path: path.stat().st_size, parts_hash, content_hash):
            copies |= dict.fromkeys(others, original)
    groups = (
        ScanGroup(some[0][0].parent, some[0][1], tuple(path for path, _ in some if path not in copies))
        for _, some in sorted(members.items(), key=lambda item: item[0])
    )
    return Catalogue(tuple(group for group in groups if group.paths), unread, copies, endings)


def _is_like(one: ScanHead, other: ScanHead) -> bool:
    sides = (one.width_px, other.width_px), (one.height_px, other.height_px)
    pitches = zip(one.pitch.um or (), other.pitch.um or (), strict=True)
    return all(abs(a - b) <= _ALIKE * a for a, b in sides) and all(abs(a - b) <= _SAME_PITCH * a for a, b in pitches)


def has_sensor_size(head: ScanHead) -> bool:
    """Whether an image has the size of a digital camera's: one of their aspect ratios, and no resolution in its
    file."""
    short, long = sorted((head.width_px, head.height_px))
    is_whole = short % _SIDES_PX == long % _SIDES_PX == 0
    return is_whole and head.pitch.um is None and any(abs(long / short / shape - 1) < 1e-3 for shape in _SHAPES)


Sample = tuple[Path, tuple[str, ...]]  # a scan, and the cameras that another one of its group shows
Try = Callable[[Sample], Identification | str]


def name_cameras(grouped: Catalogue, identified: Try, reporter: Reporter, workers: Executor | None) -> Catalogue:
    """Identify the cameras of groups from samples.

    identified: identification of a scan, or why it cannot be read. Cameras found in the first sample of a group are
    tried first on the others.
    """
    total = sum(len(group.to_try) for group in grouped.groups)
    of_groups = counted(len(grouped.groups), "group")
    answers = dict[Path, Identification | str]()
    with reporter.stage("trying the camera library on scan") as count:
        for is_first in (True, False):
            samples: list[Sample] = [
                (path, () if is_first or isinstance(found := answers[group.to_try[0]], str) else found.best_names())
                for group in grouped.groups
                for path in (group.to_try[:1] if is_first else group.to_try[1:])
            ]
            for (path, _), answer in zip(samples, map_items(workers, identified, samples), strict=True):
                answers[path] = answer
                count(of_groups, len(answers), total)
    unread = {path: answer for path, answer in answers.items() if isinstance(answer, str)}
    known = {path: answer for path, answer in answers.items() if not isinstance(answer, str)}
    groups = [
        replace(one, samples=tuple(known[path] for path in one.to_try if path in known)) for one in grouped.groups
    ]
    parts = tuple(part for group in groups for part in _split_cameras(group))
    return replace(grouped, groups=parts, unread={**grouped.unread, **unread})


def _split_cameras(group: ScanGroup) -> list[ScanGroup]:
    """The group itself, or one group per camera if all its scans were tried and show several cameras."""
    if group.camera or group.digital or len(group.samples) < len(group.paths) or len(group.paths) < 2:
        return [group]
    parts = defaultdict[str, list[Identification]](list)
    for sample in group.samples:
        parts[replace(group, samples=(sample,)).camera].append(sample)
    return [replace(group, paths=tuple(one.scan for one in own), samples=tuple(own)) for own in parts.values()]


def identify_sample(
    sample: Sample, cameras: Mapping[str, CameraFile], pitch_um: float | None, max_pixels: int | None
) -> Identification | str:
    """Try cameras on a scan; return why it cannot be read otherwise."""
    path, likely = sample
    try:
        head = read_head(path, max_pixels)
        board = ""
        if head.camera or has_sensor_size(head):
            with open_scan(path, max_pixels) as scan:
                board = recognise_board(scan)
        if board or head.camera:
            return Identification(path, (), board=board)
        found = identify(path, cameras, pitch_um, Reporter(Console(quiet=True)), max_pixels, likely)
        if found.best or head.pitch.um is not None:
            return found
        with open_scan(path, max_pixels) as scan:
            return replace(found, board=recognise_board(scan))
    except MeasurementError as error:
        return str(error)


def print_groups(grouped: Catalogue, console: Console) -> None:
    """Print every group with its samples."""
    for group in grouped.groups:
        console.print(group.sentence(), style="bold", highlight=False, soft_wrap=True)
        for sample in group.samples:
            console.print(f"    {sample.sentence()}", highlight=False, soft_wrap=True)
    for reason in grouped.unread.values():
        console.print(f"not tried: {reason}", highlight=False, soft_wrap=True)


def find_scan_files(given: Sequence[Path]) -> tuple[list[Path], Counter[str]]:
    """Return the given files and all scans in and below the folders, sorted by name, and a count of other files by
    ending.

    Hidden files are skipped. A file is returned once, however many links lead to it, as the project's patterns find it.
    Raises InputError where there is no scan.
    """
    files, endings = set[Path](), Counter[str]()
    for path in given:
        is_listed = isinstance(path, Address) and path.suffix.lower() not in SCAN_ENDINGS
        if not is_listed and not path.is_dir():
            files.add(path)
            continue
        for file in list_addresses(path) if isinstance(path, Address) else _files_below(path):
            if file.suffix.lower() in SCAN_ENDINGS:
                files.add(file)
            else:
                endings[file.suffix] += 1
    if not files:
        where, others = ", ".join(map(str, given)), ", ".join(sorted(ending or "nothing" for ending in endings))
        held = f" There are files that end in {others}." if others else ""
        raise InputError(
            f"{where}: no scan there, nor below. Files that end in {', '.join(SCAN_ENDINGS)} are scans.{held}"
        )
    named = set(given)
    own = each_once({str(file): file in named for file in sorted(files) if not isinstance(file, Address)}, ())
    return sorted(file for file in files if isinstance(file, Address) or str(file) in own), endings


def _files_below(folder: Path) -> Iterator[Path]:
    """Files in and below a folder that are not hidden."""
    for place in folders_below(folder):
        with suppress(OSError), os.scandir(folder / place) as entries:
            names = [entry.name for entry in entries if not entry.is_dir() and not entry.name.startswith(".")]
            yield from (folder / place / name for name in names)
