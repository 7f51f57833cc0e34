"""Marks measured by reseau and by other methods in the same pictures, against their truth.

python -m benchmarks compared [MARKS] [SETTING ...] [--kind KIND ...] [--blur BLUR ...]
    [--hipp PYTHON] [--keep FILE]

MARKS: of every cell, those of cameras of eight; 104 where none is given. SETTING: of the names below; all where none is
given. --keep: rows of the table are written there, and those that stand in it are not made anew. --hipp: the
interpreter of an environment with hipp 0.2.

A camera has its own turn and scale. What a user of another method has is one template of each camera: NCC and ECC the
drawing without noise, in the camera's usual turn, scale and blur; hipp a cut from a scan as noisy as the others.
All but reseau look for light marks: pictures of dark ones are inverted.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from true_marks import KIND, KINDS, Kind, TrueMark, some_mark

from benchmarks.kept_rows import KeptRows
from benchmarks.measured_marks import CONTRAST, GROUND, drawn, measured
from benchmarks.other_methods import METHODS, Template, hipp

Array = NDArray[np.float64]

SNRS, BLURS_PX = (20.0, 100.0), (0.6, 1.0, 1.6, 2.5)
SEED = 21
OF_A_CAMERA = 8  # marks measured with one template
BOUNDS = 5  # cameras whose bound is computed: it is seconds, and hardly differs
SPARE_PX = 4  # of the drawn template beyond what the mark takes


@dataclass(frozen=True)
class Setting:
    """How a camera's scans differ from one another, standard deviations, and how far starts are off.

    turn in rad, scale, blur: of its logarithm, start_px: at most, along either axis.
    """

    name: str
    turn: float
    scale: float
    blur: float
    start_px: float
    has_gradient: bool


# As in an archive: three Wild frames of film_scans/aerial lie 0.3 degrees apart (standard deviation), blurs of one
# frame's marks differ by 5 %.
SETTINGS = {
    setting.name: setting
    for setting in (
        Setting("archive", turn=5e-3, scale=1e-3, blur=0.05, start_px=1.5, has_gradient=True),
        Setting("best", turn=2e-3, scale=2e-3, blur=0.0, start_px=0.5, has_gradient=False),
    )
}


@dataclass(frozen=True, eq=False)
class Scans:
    """Of one camera: the marks and their pictures (n, size, size) light on dark, the drawn template, and the scan that
    a template is cut from."""

    marks: tuple[TrueMark, ...]
    pictures: Array
    drawing: Template
    cut: Template


def scans_of(setting: Setting, base: TrueMark, snr: float, rng: np.random.Generator) -> Scans:
    """A camera whose marks look about like base."""

    def mark_of(blur_px: float) -> TrueMark:
        turn, scale = rng.normal(0, setting.turn), rng.normal(0, setting.scale)
        linear = np.array([[1 + scale, -turn], [turn, 1 + scale]]) @ base.place[:, :2]
        center = (base.size - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        return TrueMark(base.kind, np.column_stack([linear, center]), base.size, blur_px)

    def picture_of(mark: TrueMark) -> Array:
        grey, sign = drawn(mark, rng) if setting.has_gradient else (GROUND + CONTRAST * mark.picture, 1)
        lit = grey if sign > 0 else 2 * GROUND + CONTRAST - grey
        return lit + CONTRAST / snr * rng.standard_normal(lit.shape)

    marks = tuple(mark_of(base.blur_px) for _ in range(OF_A_CAMERA))
    usual = mark_of(base.blur_px * float(np.exp(rng.normal(0, setting.blur))))
    cut = Template(picture_of(usual), usual.place[:, 2])
    return Scans(marks, np.stack([picture_of(mark) for mark in marks]), _drawing(base, usual.blur_px), cut)


def _drawing(base: TrueMark, blur_px: float) -> Template:
    middle = (base.size - 1) // 2
    ideal = TrueMark(base.kind, np.column_stack([base.place[:, :2], [middle, middle]]), base.size, blur_px)
    reach = reach_of(base) + SPARE_PX
    part = slice(middle - reach, middle + reach + 1)
    return Template(GROUND + CONTRAST * ideal.picture[part, part], np.full(2, float(reach)))


def reach_of(mark: TrueMark) -> int:
    """Pixels from the window's middle to the mark's farthest that are changed by a hundredth of its contrast."""
    return int(np.ceil(np.abs(np.argwhere(mark.picture > 0.01) - (mark.size - 1) / 2).max()))


@dataclass(frozen=True, eq=False)
class Errors:
    """Of one method: (cameras, n, 2) px, nan where it gave no place."""

    px: Array

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.nanmean(self.px**2)))

    @property
    def rms_about_mean(self) -> float:
        """Each camera's mean error being taken off, as an adjustment does: of as many as tell it, without bias."""
        n = np.isfinite(self.px).sum(axis=1, keepdims=True)
        off = self.px - np.nanmean(self.px, axis=1, keepdims=True)
        return float(np.sqrt(np.nanmean(off**2 * n / np.maximum(n - 1, 1))))

    @property
    def lost(self) -> int:
        return int(np.isnan(self.px[..., 0]).sum())

    def words(self) -> str:
        lost = f"-{self.lost}" if self.lost else ""
        return f"{f'{self.rms:.4f} {self.rms_about_mean:.4f}{lost}':>18}"


def errors_of(setting: Setting, cameras: Sequence[Scans], rng: np.random.Generator, python: str) -> Iterator[Errors]:
    """Of reseau, of each of the other methods, and of hipp where there is an interpreter with it."""
    truth = np.array([[mark.place[:, 2] for mark in camera.marks] for camera in cameras])

    def by_reseau(mark: TrueMark, grey: Array) -> Array | None:
        found = measured(mark, grey, rng)
        return None if found is None else found.center_px

    def placed(places: Sequence[Sequence[Array | None]]) -> Errors:
        return Errors(np.array([[(np.nan, np.nan) if p is None else p for p in row] for row in places]) - truth)

    yield placed([[by_reseau(*pair) for pair in zip(c.marks, c.pictures, strict=True)] for c in cameras])
    starts = truth + rng.uniform(-setting.start_px, setting.start_px, truth.shape)
    for method in METHODS.values():
        yield placed(
            [
                [method(grey, start, camera.drawing) for grey, start in zip(camera.pictures, own, strict=True)]
                for camera, own in zip(cameras, starts, strict=True)
            ]
        )
    if python:
        reach = max(reach_of(camera.marks[0]) for camera in cameras)
        pictures = np.stack([camera.pictures for camera in cameras])
        yield Errors(hipp(python, [camera.cut for camera in cameras], pictures, reach) - truth)


def row(setting: Setting, kind: Kind, blur: float, snr: float, count: int, python: str) -> str:
    """One line of the table."""
    rng = np.random.default_rng([SEED, KINDS.index(kind), int(10 * blur), int(snr)])
    bases = [some_mark(kind, blur, rng) for _ in range(count // OF_A_CAMERA)]
    cameras = [scans_of(setting, base, snr, rng) for base in bases]
    bound = np.sqrt(np.mean([np.trace(base.bound(1 / snr)) / 2 for base in bases[:BOUNDS]]))
    words = "".join(errors.words() for errors in errors_of(setting, cameras, rng, python))
    return f"{kind.name:14}{blur:5.1f}{snr:5.0f}{bound:9.4f}{words}"


def main() -> None:
    """Print the table of each setting asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("marks", type=int, nargs="?", default=104)
    parser.add_argument("settings", nargs="*", choices=[*SETTINGS, []])
    parser.add_argument("--hipp", default="")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--kind", action="append", choices=list(KIND))
    parser.add_argument("--blur", action="append", type=float)
    arguments = parser.parse_args()
    rows = KeptRows(arguments.keep)
    names = ["reseau", *METHODS, *(["hipp"] if arguments.hipp else [])]
    for name in arguments.settings or SETTINGS:
        setting = SETTINGS[name]
        print(f"\n{setting}\nrms in px, and each camera's mean error taken off; -n: gave no place")
        print(f"{'':14}{'blur':>5}{'SNR':>5}{'bound':>9}" + "".join(f"{each:>18}" for each in names))
        for kind in [KIND[each] for each in arguments.kind or KIND]:
            for blur in arguments.blur or BLURS_PX:
                for snr in SNRS:
                    compute = partial(row, setting, kind, blur, snr, arguments.marks, arguments.hipp)
                    rows.print(f"{name} {arguments.marks} {kind.name} {blur} {snr}", compute)


if __name__ == "__main__":
    main()
