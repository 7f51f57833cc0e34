"""`reseau init`: a project made of the scans that there are, with what could not be told of them."""

import glob
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from measure.errors import MeasurementError
from measure.scans.opening import ScanHead
from measure.scans.remote import Address, is_address, scan_path
from pipeline.archive.catalogue import Catalogue, Group, catalogue
from pipeline.archive.sampling import library, name_cameras
from pipeline.errors import InputError
from pipeline.files.library import PREFIX
from pipeline.measuring.scan_kinds import ScanKind
from pipeline.progress import Reporter
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line
from pipeline.text.names import image_name, names_below
from pipeline.text.wording import counted, quoted

Json = dict[str, Any]

OUTPUT = "out"
_LIST = ".txt"
_SHOWN = 12  # of each kind of remark on the terminal
_BROKEN = "cannot be read"
_COPIES = "the same bytes as another scan"
_NAMESAKES = "another picture of the same name is taken"
_UNKNOWN = "no camera is told: give them one in images.csv, and take them out of here"
_FORMATS = ("JPEG", "PNG", "TIFF")  # the later the better, of one name and size


@dataclass(frozen=True, eq=False)
class NewProject:
    """A project to be written at `folder`. given: where scans were looked for; kinds: of each of `found.groups` what
    its samples say; left_out: by reason the files that are not measured."""

    folder: Path
    given: tuple[Path, ...]
    found: Catalogue
    kinds: tuple[ScanKind, ...]
    left_out: Mapping[str, Sequence[Path]]

    @property
    def named(self) -> list[tuple[Group, ScanKind]]:
        return [(group, kind) for group, kind in zip(self.found.groups, self.kinds, strict=True) if chosen(kind)]

    @property
    def unknown(self) -> list[tuple[Group, ScanKind]]:
        return [(group, kind) for group, kind in zip(self.found.groups, self.kinds, strict=True) if not chosen(kind)]

    @property
    def cameras(self) -> dict[Path, str]:
        """The camera of each scan that is to be measured; "" where none is told of any."""
        out = {path for paths in self.left_out.values() for path in paths}
        groups = zip(self.found.groups, self.kinds, strict=True)
        return {path: chosen(kind) for group, kind in groups for path in group.paths if path not in out}

    def remarks(self) -> Iterator[tuple[str, list[str]]]:
        """What needs a look, and the single cases of it."""
        yield "cannot be read, and are left out", list(self.found.broken.values())
        yield (
            "are of no camera that could be told"
            + ("" if self.named else ": draw it in camera.toml (`reseau template camera`), or have its marks learned"),
            [f"{_told(group.folder, group.head, len(group.paths))}: {_why_not(kind)}" for group, kind in self.unknown],
        )
        yield (
            "have marks that several cameras have: that of most calibration reports is taken, images.csv sets another",
            [
                f"{group.folder}: {chosen(kind)} of {', '.join(kind.cameras)}"
                for group, kind in self.named
                if kind.cameras[1:]
            ],
        )
        numbers = defaultdict[str, set[str]](set)
        for _, kind in self.named:
            numbers[chosen(kind)].update(kind.numbers)
        yield (
            "are of several cameras of one type, by their plates: give each a camera file with its number",
            [f"{name}: Nr {', '.join(sorted(own))}" for name, own in numbers.items() if len(own) > 1],
        )
        yield "have a resolution in their files that their marks contradict", [*self._contradicted_pitches()]

    def notes(self) -> Iterator[str]:
        """What is worth knowing and needs no action."""
        for reason in (_COPIES, _NAMESAKES):
            if paths := self.left_out[reason]:
                yield f"{len(paths)} left out: {reason} ({', '.join(map(str, paths[:3]))}{'...' * (len(paths) > 3)})."
        mute = [(group, kind) for group, kind in self.named if group.head.pitch.um is None]
        if mute:
            scans = sum(len(group.paths) for group, _ in mute)
            pixels = [um for _, kind in mute if (um := _pixel_um(kind))]
            spacing_text = f", {np.median(pixels):.1f} um in the samples" if pixels else ""
            are_all = len(mute) == len(self.named)
            sets = "sets it" if are_all else "is that of all scans: to set it, give these a project of their own"
            yield (
                f"{scans} scans do not say their resolution ({mute[0][0].head.pitch.note}): the marks' separations "
                f"tell it{spacing_text}; pitch_um in the project {sets}."
            )
        plates = sorted({number for _, kind in self.named for number in kind.numbers})
        if plates:
            yield f"Cameras' numbers on plates in the samples: {', '.join(plates)}."
        if self.found.endings:
            others = sorted(self.found.endings.items(), key=lambda item: -item[1])[:_SHOWN]
            yield f"Not looked at: {', '.join(f'{count} files {_ending(ending)}' for ending, count in others)}."

    def as_json(self) -> Json:
        return {
            "project": str(self.folder / "project.toml"),
            "images": str(self.folder / "images.csv"),
            "scans": len(self.cameras),
            "kinds": [
                {"folder": str(group.folder), **_head_json(group.head), "camera": chosen(kind), **kind.as_json()}
                for group, kind in zip(self.found.groups, self.kinds, strict=True)
            ],
            "left_out": {reason: [str(path) for path in paths] for reason, paths in self.left_out.items()},
            "broken": {str(path): reason for path, reason in self.found.broken.items()},
            "copies": {str(path): str(first) for path, first in self.found.copies.items()},
            "needs_a_look": {what: cases for what, cases in self.remarks() if cases},
            "notes": list(self.notes()),
        }

    def _contradicted_pitches(self) -> Iterator[str]:
        for group, kind in self.named:
            contradiction = next((against for sample in kind.samples if (against := sample.against_pitch())), "")
            if contradiction:
                yield f"{group.folder}: {contradiction}"


def init_project(given: Sequence[Path], folder: Path, reporter: Reporter, max_pixels: int | None = None) -> NewProject:
    """Look at every file's head and try some of each kind and folder on the camera library; write project.toml and
    images.csv. Raises InputError where a file of that name is there already, or no scan is found."""
    for path in (folder / "project.toml", folder / "images.csv"):
        if path.exists():
            raise InputError(f"{path} is there already, and init writes over nothing. Give another folder by --out.")
    given = [path for one in given for path in _named(one)]
    for path in given:
        if not isinstance(path, Address) and not path.exists():
            raise InputError(f"there is no {path} (looked for {path.absolute()}). Give folders with scans, or scans.")
    with reporter.stage("looked at") as count:
        try:
            found = catalogue(given, count, max_pixels)
        except MeasurementError as error:
            raise InputError(str(error)) from error
    kinds, unread = name_cameras(found.groups, reporter, max_pixels)
    found = Catalogue(found.groups, {**found.broken, **unread}, found.copies, found.endings)
    new = NewProject(folder, tuple(given), found, tuple(kinds), _left_out(found, kinds))
    write_atomically(folder / "project.toml", project_text(new))
    write_atomically(folder / "images.csv", images_text(new))
    return new


def _named(given: Path) -> list[Path]:
    """Itself, or all that a list of paths and addresses names, a line each."""
    if isinstance(given, Address) or given.suffix.lower() != _LIST or not given.is_file():
        return [given]
    lines = [line.strip() for line in given.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()]
    named = [line for line in lines if line and not line.startswith("#")]
    return [scan_path(line) if is_address(line) else given.parent / line for line in named]


def chosen(kind: ScanKind) -> str:
    """Of cameras with the same marks the one that rests on most calibration reports; "" without any, and where they
    are told by the form of marks alone: then they may be of a camera that is not in the library."""
    return "" if kind.much_alike else max(kind.cameras, key=_reports, default="")


def _why_not(kind: ScanKind) -> str:
    if not kind.cameras:
        return kind.why_not()
    found, drawn = np.sum([(trial.found, trial.drawn) for sample in kind.samples for trial in sample.best[:1]], axis=0)
    return (
        f"perhaps {' or '.join(kind.cameras)}, {found} of {drawn} marks seen, but that rests on the form of its marks "
        f"alone, and {' or '.join(kind.much_alike)} has marks much like them: compare the drawings with a scan"
    )


def project_text(new: NewProject) -> str:
    """project.toml. Raises InputError where no scan is left."""
    cameras = new.cameras
    if not cameras:
        given, reason = ", ".join(map(str, new.given)), next(iter(new.found.broken.values()), "")
        raise InputError(f"{given}: of {counted(new.found.files, 'file')} none can be read as a scan. {reason}".strip())
    names = defaultdict[str, int](int)
    for camera in cameras.values():
        names[camera] += 1
    usual = max(names, key=lambda name: names[name])
    camera = f"{PREFIX}{usual}" if usual else "camera.toml"
    lines = [
        "# What `reseau init` found. Paths are relative to it; `reseau template project` shows what may stand in it.",
        "",
        f"camera = {quoted(camera)}    # of {names[usual]} scans; images.csv has each one's own",
        f"scans = [{', '.join(quoted(pattern) for pattern in _patterns(new))}]",
        *_exclude_lines(new),
        f"output = {quoted(OUTPUT)}",
        "",
        "[object]",
        'images = "images.csv"',
    ]
    return "\n".join(lines) + "\n"


def images_text(new: NewProject) -> str:
    """images.csv."""
    named = zip(names_below(new.cameras), new.cameras.values(), strict=True)
    rows = sorted((name, f"{PREFIX}{camera}" if camera else "") for name, camera in named)
    return "\n".join([csv_line(("image", "camera")), *map(csv_line, rows)]) + "\n"


def print_new_project(new: NewProject, console: Console) -> None:
    """Totals by camera and kind; what needs a look; what to do next."""

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, soft_wrap=True, markup=False)

    say(f"{new.found.files} files looked at.")
    for (camera, form), (scans, folders) in sorted(_totals(new).items()):
        say(f"{camera or 'camera not told'}: {scans} scans in {folders} folder{'s' * (folders > 1)}, {form}", "bold")
    for what, cases in new.remarks():
        if cases:
            say(f"Needs a look: {what}:", "yellow")
            for case in cases[:_SHOWN]:
                say(f"    {case}")
            if len(cases) > _SHOWN:
                say(f"    and {len(cases) - _SHOWN} more; --json lists all")
    for note in new.notes():
        say(note)
    project = new.folder / "project.toml"
    say(f"Written: {project}, {new.folder / 'images.csv'} ({len(new.cameras)} scans).")
    say(f"Next: look at them, then `reseau measure {project}`.")


def _left_out(found: Catalogue, kinds: Sequence[ScanKind]) -> dict[str, list[Path]]:
    """By reason. Where no camera is told at all, the project's own file has to say it, and is of all scans."""
    groups = list(zip(found.groups, kinds, strict=True))
    is_named = any(chosen(kind) for kind in kinds)
    broken = [path for path in found.broken if isinstance(path, Address) or path.exists() or path.is_symlink()]
    unknown = [path for group, kind in groups if is_named and not chosen(kind) for path in group.paths]
    taken = set(broken) | set(unknown)
    whole = [(path, group.head) for group in found.groups for path in group.paths if path not in taken]
    return {_BROKEN: broken, _COPIES: list(found.copies), _NAMESAKES: _namesakes(whole), _UNKNOWN: unknown}


def _namesakes(scans: Iterable[tuple[Path, ScanHead]]) -> list[Path]:
    """Pictures beside which a better one of the same name stands in their folder."""
    best = dict[str, tuple[tuple[int, int], Path]]()
    worse = list[Path]()
    for path, head in scans:
        rank = (head.width_px * head.height_px, _FORMATS.index(head.file_format))
        name = image_name(str(path))
        if name not in best or rank > best[name][0]:
            worse += [best[name][1]] if name in best else []
            best[name] = (rank, path)
        else:
            worse.append(path)
    return worse


def _patterns(new: NewProject) -> list[str]:
    """Of the scans below each given folder, as the project finds them: every ending of one as it is written."""
    patterns = dict[str, None]()
    for given in new.given:
        if isinstance(given, Address):
            patterns |= dict.fromkeys(_address_patterns(new, given))
            continue
        shown = _seen_from(new.folder, given)
        if not given.is_dir():
            patterns[shown] = None
            continue
        start = "" if shown == "." else f"{glob.escape(shown)}/"
        endings = {path.suffix for path in new.cameras if path.is_relative_to(given)}
        patterns |= dict.fromkeys(f"{start}**/*{ending}" for ending in sorted(endings))
    return list(patterns)


def _address_patterns(new: NewProject, given: Address) -> list[str]:
    """Stores find what a pattern names; of servers every scan is named."""
    below = [path for path in new.cameras if path.is_relative_to(given)]
    if below == [given] or not _has_patterns(given):
        return [path.location if isinstance(path, Address) else str(path) for path in below]
    return [f"{glob.escape(given.location)}/**/*{ending}" for ending in sorted({path.suffix for path in below})]


def _has_patterns(path: Path) -> bool:
    return not isinstance(path, Address) or str(path).startswith("s3:")


def _exclude_lines(new: NewProject) -> list[str]:
    """With the reason of each; the project's own results are no scans of it."""
    excluded = list[str]()
    if any((new.folder.absolute() / OUTPUT).is_relative_to(given.absolute()) for given in new.given):
        excluded += [f"    {quoted(f'{OUTPUT}/**/*')},    # what the project itself writes"]
    for reason, paths in new.left_out.items():
        endings = {scan.suffix for scan in new.cameras}
        found = [path for path in paths if path.suffix in endings and _has_patterns(path)]
        excluded += [f"    # {reason}"] if found else []
        excluded += [f"    {quoted(_seen_from(new.folder, path))}," for path in found]
    return ["exclude = [", *excluded, "]"] if excluded else []


def _seen_from(folder: Path, path: Path) -> str:
    return path.location if isinstance(path, Address) else Path(os.path.relpath(path, folder)).as_posix()


def _totals(new: NewProject) -> dict[tuple[str, str], tuple[int, int]]:
    """Scans and folders by camera and form."""
    scans, folders = defaultdict[tuple[str, str], int](int), defaultdict[tuple[str, str], set[Path]](set)
    for group, kind in zip(new.found.groups, new.kinds, strict=True):
        key = (chosen(kind), _form(group.head))
        scans[key] += len(group.paths)
        folders[key].add(group.folder)
    return {key: (count, len(folders[key])) for key, count in scans.items()}


def _alike(kind: ScanKind) -> bool:
    return len(kind.cameras) > 1


def _told(folder: Path, head: ScanHead, scans: int) -> str:
    return f"{folder}, {scans} scans, {_form(head)}"


def _form(head: ScanHead) -> str:
    pitch = (
        "no resolution"
        if head.pitch.um is None
        else f"{' x '.join(f'{um:.3g}' for um in sorted(set(head.pitch.um)))} um"
    )
    colours = "colour" if head.channels > 1 else "grey"
    return f"{head.file_format} {head.bits} bit {colours}, about {head.width_px} x {head.height_px} px, {pitch}"


def _head_json(head: ScanHead) -> Json:
    return {"format": head.file_format, "bits": head.bits, "channels": head.channels, "pitch_um": head.pitch.um}


def _pixel_um(kind: ScanKind) -> float | None:
    """What the marks say of a pixel, the median of the samples."""
    pixels = [trial.pixel_um for sample in kind.samples for trial in sample.best[:1] if trial.pixel_um]
    return float(np.median(pixels)) if pixels else None


def _ending(ending: str) -> str:
    return f"that end in {ending}" if ending else "without an ending"


def _reports(name: str) -> int:
    source = library()[name].source
    return source.reports if source else 0
