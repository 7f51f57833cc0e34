"""`reseau init`: create a project from scans, and report what could not be determined."""

import glob
import os
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from measure.errors import MeasurementError
from measure.scans.remote import Address, is_address, scan_path
from pipeline.archive import scan_groups
from pipeline.errors import InputError
from pipeline.files.camera_file import read_camera
from pipeline.files.library import PREFIX, library_path, read_library
from pipeline.terminal import Reporter
from pipeline.text.csv_table import csv_line
from pipeline.text.files import check_writable, image_name, names_below, split_lines, write_atomically
from pipeline.text.wording import count_sentence, counted, listed, quoted
from pipeline.workers import worker_pool

OUTPUT = "out"
_SHOWN = 12  # remarks of each kind on the terminal
_BROKEN = "cannot be read"
_COPIES = "the same bytes as another scan"
_NAMESAKES = "another picture of the same name is taken"
_UNKNOWN = "their camera is unknown: add them to images.csv with one, and remove them from `exclude`"
_DIGITAL = "pictures by a digital camera, which `reseau calibrate` takes"
TEMPLATE_COMMAND = "reseau template camera --marks cross --square 212 > camera.toml"
_FORMATS = ("JPEG", "JPEG 2000", "PNG", "TIFF")  # in ascending order of preference among scans of one name and size


@dataclass(frozen=True, eq=False)
class NewProject:
    """A project to be written to `folder`.

    given: files and folders that were searched; left_out: {reason: files that are not measured}.
    """

    folder: Path
    given: tuple[Path, ...]
    found: scan_groups.Catalogue
    left_out: Mapping[str, Sequence[Path]]

    @property
    def named(self) -> list[scan_groups.ScanGroup]:
        return [group for group in self.found.groups if group.camera]

    @property
    def needs_review(self) -> bool:
        """Whether anything is left to decide."""
        return any(cases for _, cases in self.remarks())

    @property
    def digital(self) -> list[scan_groups.ScanGroup]:
        """Groups of images taken by digital cameras."""
        return [group for group in self.found.groups if group.digital]

    @property
    def unknown(self) -> list[scan_groups.ScanGroup]:
        """Groups of film scans of an unknown camera."""
        return [group for group in self.found.groups if not group.camera and not group.digital]

    @property
    def cameras(self) -> dict[Path, str]:
        """{scan to be measured: its camera}; "" where no camera of the project is known."""
        out = {path for paths in self.left_out.values() for path in paths}
        return {path: group.camera for group in self.found.groups for path in group.paths if path not in out}

    @property
    def sentence(self) -> str:
        """Sentence with the number of measurable scans, and why the others are not."""
        scans = {"without a camera": self.unknown, "by a digital camera": self.digital}
        rest = {word: sum(len(group.paths) for group in groups) for word, groups in scans.items()}
        rest |= {"broken": len(self.left_out[_BROKEN])}
        rest |= {"copies": len(self.left_out[_COPIES]) + len(self.left_out[_NAMESAKES])}
        return count_sentence("can be measured", len(self.cameras) if self.named else 0, self.found.files, rest)

    def remarks(self) -> Iterator[tuple[str, list[str]]]:
        """Yield what needs a look, with its cases."""
        yield "cannot be read, and are left out", list(self.found.unread.values())
        yield (
            "show no known camera" + ("" if self.named else ": draw it, or have its marks learned"),
            [
                line
                for group in self.unknown
                for line in (f"{_place(group)}: {group.why_not()}", *_candidate_lines(group.candidates))
            ],
        )
        yield (
            "have marks of several cameras: the one with most calibration reports is taken, images.csv sets another",
            [
                line
                for camera, folders in self._alike_cameras().items()
                for line in (f"{', '.join(folders)}: {camera[0]}", *_candidate_lines(camera[1:]))
            ],
        )
        yield (
            "are named by the form of solid marks alone, which a camera that the library lacks may share: compare the "
            "drawing with a scan",
            [f"{_place(group)}: {group.camera}" for group in self.named if group.rests_on_form],
        )
        yield (
            "are in a group of which a sample does not show the camera; others may be among them: "
            "`reseau cameras --scan FILE` names a scan's, images.csv sets it",
            [
                f"{_place(group)}: {group.camera}, not found in {listed([path.name for path in group.unlike])}"
                for group in self.named
                if group.unlike
            ],
        )
        yield ("are no scans of film, and are left out", [f"{_place(one)}: {one.why_not()}" for one in self.digital])
        numbers = defaultdict[str, set[str]](set)
        for group in self.named:
            numbers[group.camera].update(group.numbers)
        yield (
            "are of several cameras of one type, by their plates: give each a camera file with its number",
            [f"{name}: Nr {', '.join(sorted(own))}" for name, own in numbers.items() if len(own) > 1],
        )
        against = {group: [why for sample in group.samples if (why := sample.against_pitch())] for group in self.named}
        yield (
            "have a resolution in their files that their marks contradict",
            [f"{group.folder}: {sentences[0]}" for group, sentences in against.items() if sentences],
        )

    def notes(self) -> Iterator[str]:
        """Yield information that needs no action."""
        for reason in (_COPIES, _NAMESAKES):
            if paths := self.left_out[reason]:
                yield f"{len(paths)} left out: {reason} ({', '.join(map(str, paths[:3]))}{'...' * (len(paths) > 3)})."
        mute = [group for group in self.named if group.head.pitch.um is None]
        if mute:
            scans = sum(len(group.paths) for group in mute)
            pixels = [um for group in mute if (um := group.pixel_um)]
            spacing_text = f", {np.median(pixels):.1f} µm in the samples" if pixels else ""
            are_all = len(mute) == len(self.named)
            sets = "sets it" if are_all else "is that of all scans: to set it, give these a project of their own"
            yield (
                f"{counted(scans, 'scan')} without a resolution ({mute[0].head.pitch.note}): the marks' separations "
                f"tell it{spacing_text}; pitch_um in the project {sets}."
            )
        plates = sorted({number for group in self.named for number in group.numbers})
        if plates:
            yield f"Cameras' numbers on plates in the samples: {', '.join(plates)}."
        if self.found.endings:
            others = sorted(self.found.endings.items(), key=lambda item: -item[1])[:_SHOWN]
            named = (
                f"{counted(count, 'file')} {f'with the ending {end}' if end else 'without an ending'}"
                for end, count in others
            )
            yield f"Not examined: {', '.join(named)}."

    def as_json(self) -> Mapping[str, object]:
        return {
            "project": str(self.folder / "project.toml"),
            "images": str(self.folder / "images.csv"),
            "scans": len(self.cameras),
            "kinds": [
                {
                    "folder": str(group.folder),
                    "format": group.head.file_format,
                    "bits": group.head.bits,
                    "channels": group.head.channels,
                    "pitch_um": group.head.pitch.um,
                    **group.as_json(),
                }
                for group in self.found.groups
            ],
            "left_out": {reason: [str(path) for path in paths] for reason, paths in self.left_out.items()},
            "broken": {str(path): reason for path, reason in self.found.unread.items()},
            "copies": {str(path): str(first) for path, first in self.found.copies.items()},
            "digital": {str(group.folder): group.calibrate_command for group in self.digital},
            "needs_a_look": {what: cases for what, cases in self.remarks() if cases},
            "notes": list(self.notes()),
        }

    def _alike_cameras(self) -> Mapping[tuple[str, ...], list[str]]:
        """{cameras with the same marks, the chosen one first: folders of their scans}."""
        alike = defaultdict[tuple[str, ...], list[str]](list)
        for group in self.named:
            if group.cameras[1:]:
                others = [name for name in group.candidates if name != group.camera][: scan_groups.CANDIDATES - 1]
                alike[group.camera, *others].append(str(group.folder))
        return {cameras: sorted(set(folders)) for cameras, folders in alike.items()}


def init_project(given: Sequence[Path], folder: Path, reporter: Reporter, max_pixels: int | None = None) -> NewProject:
    """Examine all files' heads, identify cameras from samples of each group, and write project.toml and images.csv.

    Raises InputError, before a scan is opened, where one of these files exists or none can be written; where no scan is
    found.
    """
    for path in (folder / "project.toml", folder / "images.csv"):
        if path.exists():
            raise InputError(f"{path} is there already, and init writes over nothing. Give another folder by --out.")
    check_writable(next(place for place in (folder, *folder.absolute().parents) if place.exists()))
    given = [path for one in given for path in _given_paths(one)]
    for path in given:
        if not isinstance(path, Address) and not path.exists():
            raise InputError(f"there is no {path} (searched at {path.absolute()}). Give folders with scans, or scans.")
    with reporter.stage("examining file") as count:
        try:
            found = scan_groups.catalogue(given, count, max_pixels)
        except MeasurementError as error:
            raise InputError(str(error)) from error
    trial = partial(scan_groups.identify_sample, cameras=read_library(), pitch_um=None, max_pixels=max_pixels)
    with worker_pool(sum(len(group.to_try) for group in found.groups)) as workers:
        found = scan_groups.name_cameras(found, trial, reporter, workers)
    new = NewProject(folder, tuple(given), found, _left_out(found))
    if new.digital and not new.cameras:
        lines = [f"{_place(group)}, {group.digital}: {group.calibrate_command}" for group in new.digital]
        where = listed(list(map(str, given)))
        raise InputError("\n".join([f"{where}: no scan of film. SIZE: of a square, as 25mm.", *lines]))
    text, names = project_text(new), names_below(new.cameras)
    for name, path in zip(names, new.cameras, strict=True):
        if not name.isprintable() or any(unicodedata.category(letter) == "Cs" for letter in str(path)):
            raise InputError(
                f"the file name {str(path)!a} is not text in UTF-8 on one line, so nothing was written. Rename it."
            )
    rows = sorted(
        (name, f"{PREFIX}{camera}" if camera else "") for name, camera in zip(names, new.cameras.values(), strict=True)
    )
    images = [csv_line(("image", "camera")), *map(csv_line, rows)]
    write_atomically(folder / "project.toml", text)
    write_atomically(folder / "images.csv", "\n".join(images) + "\n")
    return new


def _given_paths(given: Path) -> list[Path]:
    """The path itself, or the entries of a list file: one path or address per line."""
    if isinstance(given, Address) or given.suffix.lower() != ".txt" or not given.is_file():
        return [given]
    text = given.read_text(encoding="utf-8-sig", errors="surrogateescape")
    lines = [line.strip() for line in split_lines(text)]
    named = [line for line in lines if line and not line.startswith("#")]
    return [scan_path(line) if is_address(line) else given.parent / line for line in named]


def project_text(new: NewProject) -> str:
    """Content of project.toml. Raises InputError where no scan is left."""
    cameras = new.cameras
    if not cameras:
        given, reason = ", ".join(map(str, new.given)), next(iter(new.found.unread.values()), "")
        raise InputError(f"{given}: of {counted(new.found.files, 'file')} none can be read as a scan. {reason}".strip())
    ((usual, count),) = Counter(cameras.values()).most_common(1)
    camera = f"camera = {quoted(PREFIX + usual)}    # of {counted(count, 'scan')}; images.csv has each one's own"
    if not usual:
        camera = f'# camera = "camera.toml"    # draw it: {TEMPLATE_COMMAND}'
    excluded = list[str]()
    if any((new.folder.absolute() / OUTPUT).is_relative_to(given.absolute()) for given in new.given):
        excluded.append(f"    {quoted(f'{OUTPUT}/**/*')},    # what the project itself writes")
    endings = {scan.suffix for scan in cameras}
    for reason, paths in new.left_out.items():
        found = [path for path in paths if path.suffix in endings and _has_patterns(path)]
        excluded += [f"    # {reason}"] if found else []
        excluded += [f"    {quoted(_relative_name(new.folder, path))}," for path in found]
    lines = [
        "# What `reseau init` found. Paths are relative to it; `reseau template project` shows what may stand in it.",
        "",
        camera,
        f"scans = [{', '.join(quoted(pattern) for pattern in _patterns(new))}]",
        *(["exclude = [", *excluded, "]"] if excluded else []),
        f"output = {quoted(OUTPUT)}",
        "",
        "[object]",
        'images = "images.csv"',
    ]
    return "\n".join(lines) + "\n"


def print_new_project(new: NewProject, console: Console) -> None:
    """Print totals by camera, what needs a look, and what was written."""

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, soft_wrap=True, markup=False)

    say(f"{counted(new.found.files, 'file')} examined: {new.sentence}.")
    of_camera = defaultdict[str, list[scan_groups.ScanGroup]](list)
    for group in new.found.groups:
        of_camera[group.camera or ("digital camera" if group.digital else "camera unknown")].append(group)
    for camera, groups in sorted(of_camera.items()):
        scans, folders = sum(len(group.paths) for group in groups), len({group.folder for group in groups})
        say(f"{camera}: {counted(scans, 'scan')} in {counted(folders, 'folder')}", "bold")
    for what, cases in new.remarks():
        if cases:
            say(f"Needs a look: scans that {what}:", "yellow")
            for case in cases[:_SHOWN]:
                say(f"    {case}")
            if len(cases) > _SHOWN:
                say(f"    and {len(cases) - _SHOWN} more; --json lists all")
    for note in new.notes():
        say(note)
    say(f"Written: {new.folder / 'project.toml'}, {new.folder / 'images.csv'} ({counted(len(new.cameras), 'scan')}).")


def _left_out(found: scan_groups.Catalogue) -> dict[str, list[Path]]:
    """{reason: files}."""
    # Without any identified camera, the camera file to be added covers all scans: none is left out for it.
    is_named = any(group.camera for group in found.groups)
    unknown, digital, namesakes = list[Path](), list[Path](), list[Path]()
    best = dict[str, tuple[tuple[int, int], Path]]()  # by name in its folder: size and format, scan
    for group in found.groups:
        if group.digital:
            digital += group.paths
            continue
        if is_named and not group.camera:
            unknown += group.paths
            continue
        rank = (group.head.width_px * group.head.height_px, _FORMATS.index(group.head.file_format))
        for path in group.paths:
            name = image_name(str(path))
            if path in found.unread:
                continue
            if name in best and rank <= best[name][0]:
                namesakes.append(path)
                continue
            namesakes += [best[name][1]] if name in best else []
            best[name] = rank, path
    return {
        _BROKEN: [path for path in found.unread if isinstance(path, Address) or path.exists() or path.is_symlink()],
        _COPIES: list(found.copies),
        _NAMESAKES: namesakes,
        _UNKNOWN: unknown,
        _DIGITAL: digital,
    }


def _patterns(new: NewProject) -> list[str]:
    """Patterns of the scans below each given folder for `scans`, one for each spelling of an ending; for servers, which
    cannot be searched, the address of every scan."""
    patterns, cameras = dict[str, None](), new.cameras
    for given in new.given:
        shown = _relative_name(new.folder, given)
        if not isinstance(given, Address) and not given.is_dir():
            patterns[shown] = None
            continue
        below = [path for path in cameras if path.is_relative_to(given)]
        if isinstance(given, Address) and (below == [given] or not _has_patterns(given)):
            patterns |= dict.fromkeys(_relative_name(new.folder, path) for path in below)
            continue
        start = "" if shown == "." else f"{glob.escape(shown)}/"
        patterns |= dict.fromkeys(f"{start}**/*{ending}" for ending in sorted({path.suffix for path in below}))
    return list(patterns)


def _has_patterns(path: Path) -> bool:
    return not isinstance(path, Address) or str(path).startswith("s3:")


def _relative_name(folder: Path, path: Path) -> str:
    return path.location if isinstance(path, Address) else Path(os.path.relpath(path, folder)).as_posix()


def _place(group: scan_groups.ScanGroup) -> str:
    """File of a single scan; else the folder, with the form of the group's scans."""
    if len(group.paths) == 1:
        return str(group.paths[0])
    head, resolution = group.head, "no resolution"
    if head.pitch.um is not None:
        resolution = f"{' x '.join(f'{um:.3g}' for um in sorted(set(head.pitch.um)))} µm"
    form = f"{head.file_format} {head.bits} bit {'colour' if head.channels > 1 else 'grey'}"
    size = f"about {head.width_px} x {head.height_px} px"
    return f"{group.folder}, {counted(len(group.paths), 'scan')}, {form}, {size}, {resolution}"


def _candidate_lines(names: Sequence[str]) -> list[str]:
    """One line for each camera of the library, with what distinguishes it: frame, principal distance, marks, source of
    its numbers."""
    lines = []
    for name in names:
        camera = read_camera(library_path(name))
        frame_mm = " x ".join(f"{side:g}" for side in camera.frame_mm or ())
        places = [one.xy_mm for one in camera.fiducials]
        corners = sum(abs(x) > 0.5 * abs(y) and abs(y) > 0.5 * abs(x) for x, y in places)
        counts = ((corners, "corner"), (len(places) - corners, "side"))
        marks = " and ".join(f"{number} {word}" for number, word in counts if number)
        c_mm = f"c {camera.principal_distance_mm:.1f} mm, " if camera.principal_distance_mm else ""
        source = camera.source.text if camera.source else "no source"
        lines.append(f"    {name}: frame {frame_mm} mm, {c_mm}{marks} marks, {source}")
    return lines
