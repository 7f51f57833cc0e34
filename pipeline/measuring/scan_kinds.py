"""The kinds of scans among many: those of one shape and pitch, of which a few tell for all which camera they are of."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from measure.errors import MeasurementError
from measure.scans.opening import read_head
from pipeline.errors import InputError
from pipeline.measuring.camera_identification import Identification

Json = dict[str, Any]

_ENDINGS = (".tif", ".tiff", ".jpg", ".jpeg", ".png")
_ALIKE = 0.03  # of their sides: scans of one roll are cut by hand
SAMPLES = 3  # scans of each kind
_TELLING = {"camera_type", "principal_distance_mm"}  # of a plate's fields: what tells cameras apart


@dataclass(frozen=True)
class ScanKind:
    """Scans (paths) of about width_px x height_px, of one file format; samples: what those say that were tried."""

    paths: tuple[Path, ...]
    width_px: int
    height_px: int
    samples: tuple[Identification, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that most samples name, no sample with a camera contradicts, and no plate."""
        named = [names for names in self._named if names]
        if 2 * len(named) <= len(self.samples):
            return ()
        against = frozenset(name for sample in self.samples for name in sample.contradicted)
        return tuple(sorted(frozenset.intersection(*named) - against))

    @property
    def much_alike(self) -> tuple[str, ...]:
        """Other cameras whose solid marks are drawn much like those that are named, where no plate says which."""
        if any(_TELLING & sample.plate.keys() for sample in self.samples):
            return ()
        others = dict.fromkeys(name for sample in self.samples for name in sample.much_alike())
        return tuple(others) if self.cameras else ()

    @property
    def numbers(self) -> tuple[str, ...]:
        """Of cameras, as their plates in the samples have them."""
        return tuple(sorted({sample.plate.get("camera_number", "") for sample in self.samples} - {""}))

    def sentence(self) -> str:
        scans = f"{len(self.paths)} scan{'s' * (len(self.paths) > 1)} of about {self.width_px} x {self.height_px} px"
        if self.cameras:
            return f"{scans}: {' or '.join(self.cameras)}, by {len(self.samples)} of them."
        return f"{scans}: {self.why_not()}."

    def why_not(self) -> str:
        """Why no camera is named, a part of a sentence."""
        counts = Counter(name for names in self._named for name in names)
        if not counts:
            return f"no camera stands out in {len(self.samples)} of them"
        counts_text = ", ".join(f"{name} in {count}" for name, count in counts.most_common())
        if 2 * sum(map(bool, self._named)) > len(self.samples) and frozenset.intersection(*filter(None, self._named)):
            return f"what is seen are marks of {counts_text}, and the camera's plate in the picture says another one"
        return f"of {len(self.samples)} samples not all show the same camera ({counts_text})"

    @property
    def _named(self) -> list[frozenset[str]]:
        """The cameras that each sample names."""
        return [frozenset(name for trial in sample.best for name in trial.cameras) for sample in self.samples]

    def as_json(self) -> Json:
        return {
            "scans": [str(path) for path in self.paths],
            "size_px": [self.width_px, self.height_px],
            "best": list(self.cameras),
            "sentence": self.sentence(),
            "samples": [sample.as_json() for sample in self.samples],
        }


@dataclass(frozen=True)
class ManyScans:
    """unread: by path, why a scan could not be tried."""

    kinds: tuple[ScanKind, ...]
    unread: Mapping[Path, str]

    @property
    def all_named(self) -> bool:
        return not self.unread and all(kind.cameras for kind in self.kinds)

    def as_json(self) -> Json:
        unread = [{"scan": str(path), "reason": reason} for path, reason in self.unread.items()]
        return {"kinds": [kind.as_json() for kind in self.kinds], "unread": unread}


def scan_files(given: Sequence[Path]) -> list[Path]:
    """The files, and all scans in and below the folders, in order of their names. Raises InputError where a folder
    holds none."""
    files = list[Path]()
    for path in given:
        if not path.is_dir():
            files.append(path)
            continue
        found = sorted(file for file in path.rglob("*") if file.suffix.lower() in _ENDINGS and file.is_file())
        if not found:
            raise InputError(
                f"{path}: the folder holds no scan. Files that end in {', '.join(_ENDINGS)} are looked for."
            )
        files += found
    return list(dict.fromkeys(files))


def identify_kinds(paths: Sequence[Path], identify: Callable[[Path], Identification]) -> ManyScans:
    """Some scans of each kind, tried one by one."""
    kinds, unread = list[ScanKind](), dict[Path, str]()
    for (width, height), own in _alike(paths, unread):
        samples = list[Identification]()
        for path in spread(own):
            try:
                samples.append(identify(path))
            except MeasurementError as error:
                unread[path] = str(error)
        kinds.append(ScanKind(own, width, height, tuple(samples)))
    return ManyScans(tuple(kinds), unread)


def print_kinds(many: ManyScans, console: Console) -> None:
    for kind in many.kinds:
        console.print(kind.sentence(), style="bold", highlight=False, soft_wrap=True)
        for sample in kind.samples:
            console.print(f"    {sample.sentence()}", highlight=False, soft_wrap=True)
    for reason in many.unread.values():
        console.print(f"not tried: {reason}", highlight=False, soft_wrap=True)


def _alike(paths: Sequence[Path], unread: dict[Path, str]) -> list[tuple[tuple[int, int], tuple[Path, ...]]]:
    """Sizes, each with the scans of it and of one format; those that cannot be opened go to unread."""
    kinds: list[tuple[str, tuple[int, int], list[Path]]] = []
    for path in paths:
        try:
            head, ending = read_head(path), path.suffix.lower()
        except MeasurementError as error:
            unread[path] = str(error)
            continue
        size = (head.width_px, head.height_px)
        alike = (own for other, known, own in kinds if other == ending and np.allclose(size, known, rtol=_ALIKE))
        own = next(alike, None)
        if own is None:
            kinds.append((ending, size, [path]))
        else:
            own.append(path)
    if not kinds:
        raise InputError("\n".join(unread.values()))
    return [(size, tuple(own)) for _, size, own in kinds]


def spread(paths: Sequence[Path]) -> list[Path]:
    """The samples among scans, from the first to the last."""
    chosen = np.unique(np.linspace(0, len(paths) - 1, SAMPLES).round().astype(int))
    return [paths[index] for index in chosen]
