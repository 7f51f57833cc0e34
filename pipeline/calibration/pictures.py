"""Pictures of a digital camera: the files, their sizes, and quarter turns between them."""

import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from measure.errors import MeasurementError
from measure.scans.jpeg import jpeg_colour_tags
from measure.scans.metadata import DECODING_ERRORS, exif_number
from measure.scans.opening import ScanHead, read_head
from pipeline.adjusting.adjust_stage import adjustment_options
from pipeline.adjusting.network import build_network
from pipeline.errors import InputError
from pipeline.files.object_files import GivenImages
from pipeline.files.project_file import Project
from pipeline.files.scan_files import folders_below
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.files import SCAN_ENDINGS, names_below

_Kind = tuple[int, int, float | None]  # width, height, focal length
QUARTERS_DEG = (90, 270)
TURNS_BY_TAG = {6: 90, 8: 270}  # Exif's Orientation of images that viewers turn back
UNREAD_ENDINGS = (".heic", ".heif", ".avif", ".webp", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf")
MOST_GROUPS, FEWEST_IN_GROUP = 8, 5  # of images by their names; fewer do not show that cameras differ
PLAIN = 20.0  # twice the log-likelihood ratio; odds of e to the 10
FEWEST_PICTURES = 3  # of a flat board with known turns, needed for principal distance and principal point


@dataclass(frozen=True)
class CameraPictures:
    """Images of one size and one focal length (from their Exif tags, None without), some of them turned by 90 or 270
    degrees.

    Attributes
    ----------
    turned_deg : by image, the counter-clockwise turn relative to the others; None where the tag does not give it.
    unsure_turns : images whose contents do not determine it either.
    """

    name: str
    width_px: int
    height_px: int
    focal_mm: float | None
    images: tuple[str, ...]
    turned_deg: Mapping[str, int | None] = field(default_factory=dict)
    unsure_turns: tuple[str, ...] = ()


@dataclass(frozen=True)
class BoardPictureFiles:
    """Image files. files: by the image's name; cameras: the one with the most images first; unreadable: by image, the
    reason."""

    files: Mapping[str, Path]
    cameras: tuple[CameraPictures, ...]
    unreadable: Mapping[str, str]

    def select(self, cameras: Collection[str]) -> tuple["BoardPictureFiles", dict[str, str]]:
        """The images of some cameras, named below the folder that they share, and {earlier name: name}."""
        own = [camera for camera in self.cameras if camera.name in cameras]
        earlier = [image for camera in own for image in camera.images]
        names = dict(zip(earlier, names_below([self.files[image] for image in earlier]), strict=True))
        renamed = tuple(
            replace(
                camera,
                images=tuple(names[image] for image in camera.images),
                turned_deg={names[image]: turned for image, turned in camera.turned_deg.items()},
                unsure_turns=tuple(names[image] for image in camera.unsure_turns),
            )
            for camera in own
        )
        return replace(self, files={names[image]: self.files[image] for image in earlier}, cameras=renamed), names


def find_pictures(given: Sequence[Path], out: Path) -> BoardPictureFiles:
    """Find the images among files and below folders, and group them by camera. Files below `out` are ignored.

    Raises InputError where no image can be read.
    """
    paths = list(dict.fromkeys(_files(given, out.resolve())))
    if not paths:
        where = ", ".join(map(str, given))
        raise InputError(f"{where}: there is no picture ({', '.join(SCAN_ENDINGS)}). Name the folder that has them.")
    heads, errors = dict[Path, ScanHead](), dict[Path, str]()
    for path in paths:
        if path.suffix.lower() in UNREAD_ENDINGS:
            errors[path] = f"{path} is of a kind that is not read: convert it to JPEG, PNG or TIFF, as large as it is"
            continue
        try:
            heads[path] = read_head(path)
        except MeasurementError as error:
            errors[path] = str(error)
    names = names_below(heads)  # as the project, which lists these alone, names them
    files = dict(zip(names, heads, strict=True))
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        alike = " and ".join(str(path) for name, path in zip(names, heads, strict=True) if name == twice[0])
        more = f", and so are {len(twice) - 1} others" if len(twice) > 1 else ""
        raise InputError(
            f"{alike} are called {twice[0]!r}{more}: names have no ending. Give files of one kind "
            "in place of the folder, as *.png."
        )
    unreadable = dict(zip(names_below(paths, errors), errors.values(), strict=True))
    groups, turns = defaultdict[_Kind, list[str]](list), dict[str, int | None]()
    for name, path in files.items():
        exif: Mapping[str, Any] = {}
        with suppress(*DECODING_ERRORS, OSError):
            exif = jpeg_colour_tags(path).exif
        size = heads[path].width_px, heads[path].height_px
        groups[*size, exif_number(exif.get("FocalLength"))].append(name)
        turns[name] = TURNS_BY_TAG.get(exif.get("Orientation", 1))
    if not groups:
        raise InputError(f"No picture can be read: {next(iter(unreadable.values())).rstrip('.')}.")
    by_count = sorted(groups.items(), key=lambda group: -len(group[1]))
    kinds = dict[_Kind, list[str]]()
    for (width, height, focal), images in by_count:  # the more frequent of a size and the size with sides exchanged
        turned = (height, width, focal)
        kinds.setdefault(turned if turned in kinds else (width, height, focal), []).extend(images)
    cameras = [
        CameraPictures(name, *kind, tuple(images), {each: turns[each] for each in images if each not in groups[kind]})
        for name, (kind, images) in zip(_names(list(kinds)), kinds.items(), strict=True)
    ]
    return BoardPictureFiles(files, tuple(cameras), unreadable)


def _files(given: Iterable[Path], out: Path) -> Iterator[Path]:
    for path in given:
        if not path.is_dir():
            if not path.exists():
                raise InputError(f"{path}: there is no such file or folder.")
            yield path
            continue
        for below in sorted(folders_below(path)):
            folder = path / below
            if folder.resolve() == out or out in folder.resolve().parents:
                continue
            found = [folder / name for name in sorted(os.listdir(folder)) if not name.startswith(".")]
            read = [file for file in found if file.suffix.lower() in SCAN_ENDINGS]
            yield from read
            stems = {file.stem for file in read}  # a raw picture beside its JPEG is none that is missing
            yield from (file for file in found if file.suffix.lower() in UNREAD_ENDINGS and file.stem not in stems)


def _names(cameras: Sequence[_Kind]) -> list[str]:
    """Names of the cameras: "camera" for a single one; else with the properties that distinguish them."""
    if len(cameras) == 1:
        return ["camera"]
    sizes = {(width, height) for width, height, _ in cameras}
    focals = {focal for *_, focal in cameras}
    names = []
    for width, height, focal in cameras:
        parts = [f"{width}x{height}"] if len(sizes) > 1 else []
        parts += ["no-focal-length" if focal is None else f"{focal:g}mm"] if len(focals) > 1 else []
        names.append("camera-" + "-".join(parts))
    return names


def name_parts(images: Iterable[str]) -> Iterator[Mapping[str, list[str]]]:
    """Partitions of images by a part of their names, a number or what stands beside numbers, as in left01 or cam2_01:
    those into few groups of enough images."""
    parts, earlier = {name: re.findall(r"\d+|\D+", name) for name in images}, list[list[list[str]]]()
    for place in range(min(map(len, parts.values()), default=0)):
        groups = defaultdict[str, list[str]](list)
        for name, own in parts.items():
            groups[own[place]].append(name)
        is_apart = 1 < len(groups) <= MOST_GROUPS and min(map(len, groups.values())) >= FEWEST_IN_GROUP
        if is_apart and [*groups.values()] not in earlier:
            earlier.append([*groups.values()])
            yield groups


def find_turns(project: Project, marks: Sequence[ComparatorPoint], camera: CameraPictures) -> CameraPictures:
    """Determine the quarter turn of each image; `unsure_turns`: those that fit equally with both turns.

    The principal point and the decentring distortion, which turn with the image, distinguish the turns. Each image is
    resected with the lens of those with known turns; where these are too few, all are adjusted with either turn. Raises
    AdjustmentError or InputError where the images with known turns have no solution.
    """
    open_turns = [name for name in camera.images if camera.turned_deg.get(name, 0) is None]
    known = {name: turn for name, turn in camera.turned_deg.items() if turn is not None}
    shown = {mark.image for mark in marks}
    sought = [name for name in open_turns if name in shown]
    if not sought:
        return replace(camera, turned_deg=known | dict.fromkeys(open_turns, QUARTERS_DEG[0]))
    fixed = sorted(shown - set(sought))
    adjusted = partial(adjust, options=adjustment_options(project.adjust))

    def turned_network(images: Collection[str], turns: Mapping[str, int]) -> Network:
        given = project.given_images or GivenImages({}, {})
        turned = replace(project, given_images=replace(given, turned_deg=turns))
        return build_network(turned, [mark for mark in marks if mark.image in images])[0]

    groups = [[name] for name in sought]
    lens: Adjustment | None = None
    if len(fixed) >= FEWEST_PICTURES:
        lens = adjusted(turned_network(fixed, known))
    else:
        groups = [sought]  # all with the same turn
    turns, unsure = dict[str, int](), list[str]()
    for group in groups:
        fits = dict[int, Adjustment]()
        for turn in QUARTERS_DEG:
            images = group if lens else [*fixed, *group]
            network = turned_network(images, known | dict.fromkeys(group, turn))
            if lens is not None:
                network = replace(network, cameras=(_held_camera(network.cameras[0], lens),))
            with suppress(AdjustmentError):
                fits[turn] = adjusted(network)
        best = min(fits, key=lambda turn: fits[turn].vpv, default=QUARTERS_DEG[0])
        turns |= dict.fromkeys(group, best)
        if not _is_plain(fits, best):
            unsure += group
    sure = [turns[name] for name in sought if name not in unsure]
    usual = max(QUARTERS_DEG, key=sure.count) if sure else QUARTERS_DEG[0]
    turns |= dict.fromkeys([*unsure, *(name for name in open_turns if name not in shown)], usual)
    return replace(camera, turned_deg=known | turns, unsure_turns=tuple(unsure))


def _is_plain(fits: Mapping[int, Adjustment], best: int) -> bool:
    """Whether one turn fits significantly better than the other."""
    if len(fits) < len(QUARTERS_DEG):
        return bool(fits)
    variance = max(fits[best].vpv / max(fits[best].redundancy, 1), 1.0)
    return all((fit.vpv - fits[best].vpv) / variance > PLAIN for turn, fit in fits.items() if turn != best)


def _held_camera(camera: Camera, fitted: Adjustment) -> Camera:
    """The camera with its adjusted parameters held fixed."""

    def prior(name: str) -> Prior:
        return Prior(fitted.value(Parameter.interior(camera.name, name)), 0.0)

    distortion = replace(camera.distortion, parameters={name: prior(name) for name in camera.distortion.parameters})
    return replace(
        camera, principal_distance_mm=prior("c"), x0_mm=prior("x0"), y0_mm=prior("y0"), distortion=distortion
    )
