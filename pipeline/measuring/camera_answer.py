"""What trying the library's cameras on a scan says: which of them stand out, in words, in figures and as JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.padding import Padding

Json = dict[str, Any]

_OUTSTANDING = 2.0  # times what chance finds
CLOSE = 0.85  # of the best score: a camera that comes so near is not told from it
_SHRUNK = 0.03  # of its size: more than film and cameras of a model differ by


@dataclass(frozen=True)
class Trial:
    """What became of the cameras that share a layout of marks.

    found: marks that are observations, of drawn ones. likeness: their mean correlation with the drawing; snr: the
    median of contrast over noise. score: 0 to 1, as `_score` has it. chance: the score of the same marks in wrong
    places, the layout stretched; None where no such comparison is needed. residual_sigmas, residual_mm: what an affine
    transformation leaves, per axis, in standard deviations of marks and given places; None where it leaves nothing
    over. expected: how many constellations that answer as well at reduced size chance makes in such a scan, infinite
    where none answers at the given pitch. pixel_um: what the marks' separations say a pixel measures, None without any.
    """

    cameras: tuple[str, ...]
    found: int
    drawn: int
    likeness: float
    snr: float
    score: float
    chance: float | None
    residual_sigmas: float | None
    residual_mm: float | None
    reason: str
    seconds: float
    expected: float
    pixel_um: float | None = None

    @property
    def against_chance(self) -> str:
        if self.chance is None:
            return f"chance makes {self.expected:.1g} constellations that answer as well in such a scan"
        return f"the same marks in wrong places score {self.chance:.2f}"

    @property
    def stands_out(self) -> bool:
        return self.score > 0.0 and (self.chance is None or self.score >= _OUTSTANDING * self.chance)


@dataclass(frozen=True)
class Identification:
    """The trials, best first, and what follows from them. unreported: by name, what cameras without any calibration
    report rest on. pitch_um: of the scan in x and y, as given or as its file has it. plate: what the camera's own plate
    says, by field; contradicted: by name, how it says that it is of no such camera. alike: by name, other cameras whose
    marks are drawn much like its own."""

    scan: Path
    trials: tuple[Trial, ...]
    unreported: Mapping[str, str] = field(default_factory=dict)
    pitch_um: tuple[float, float] | None = None
    plate: Mapping[str, str] = field(default_factory=dict)
    contradicted: Mapping[str, Sequence[str]] = field(default_factory=dict)
    alike: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def best(self) -> tuple[Trial, ...]:
        """The trial that stands out, and those that come too near to be told from it."""
        standing = [trial for trial in self.trials if trial.stands_out]
        return tuple(trial for trial in standing if trial.score >= CLOSE * standing[0].score)

    def sentence(self) -> str:
        if not self.best:
            return (
                f"{self.scan.name}: no camera of the library stands out. Its marks may be none of those drawn, or too "
                "faint; --pitch helps where the scan's file does not say it."
            )
        first = self.best[0]
        told = (
            f"{self.scan.name}: {' or '.join(first.cameras)}, score {first.score:.2f}: {first.found} of {first.drawn} "
            f"marks, likeness {first.likeness:.2f}, signal-to-noise {first.snr:.1f}; {first.against_chance}."
        )
        if len(self.best) > 1:
            told += f" {' or '.join(self.best[1].cameras)} comes close with {self.best[1].score:.2f}."
        elif len(first.cameras) > 1:
            told += " Their marks are alike; the data strip or the focal length must decide."
        named = [name for trial in self.best for name in trial.cameras if name in self.unreported]
        told += "".join(f" {name} rests on no calibration report: {self.unreported[name]}." for name in named)
        against = self.against_pitch()
        return told + self._of_forms() + self._of_plate() + (f" {against}" if against else "")

    def much_alike(self) -> tuple[str, ...]:
        """Other cameras whose marks are drawn much like those that stand out: wings, notches or arrows."""
        best = [name for trial in self.best for name in trial.cameras]
        others = (other for name in best for other in self.alike.get(name, ()) if other not in best)
        return tuple(dict.fromkeys(others))

    def _of_forms(self) -> str:
        """That a name rests on the form of marks alone, of which others have much the same."""
        others = " or ".join(self.much_alike())
        if not others:
            return ""
        return (
            f" That rests on the form of its marks alone, and {others} has marks much like them: compare the drawings."
        )

    def _of_plate(self) -> str:
        """What the plate says of the cameras that stand out."""
        if not self.plate:
            return ""
        words = {"camera_type": "{}", "camera_number": "Nr {}", "principal_distance_mm": "principal distance {} mm"}
        read = ", ".join(word.format(self.plate[name]) for name, word in words.items() if name in self.plate)
        standing = [name for trial in self.best for name in trial.cameras]
        left = [name for name in standing if name not in self.contradicted]
        if not left:
            return f" Its plate says {read}, which none of them is."
        agree = f"; of these that is {' or '.join(left)}" if len(left) < len(standing) else ""
        return f" Its plate says {read}{agree}."

    def against_pitch(self) -> str:
        """A sentence where the pitch cannot be right if the scan is of the best camera; else nothing."""
        trial = self.best[0] if self.best else None
        if self.pitch_um is None or trial is None or trial.pixel_um is None:
            return ""
        pitch_um = math.sqrt(math.prod(self.pitch_um))
        if abs(trial.pixel_um / pitch_um - 1) < _SHRUNK:
            return ""
        return (
            f"Its marks lie as far apart as they should only if a pixel measures {trial.pixel_um:.1f} um, not "
            f"{pitch_um:.1f}: if the scan is of this camera, the pitch that --pitch or its file gives is wrong."
        )

    def as_json(self) -> Json:
        trials = [{**asdict(trial), "stands_out": trial.stands_out} for trial in self.trials]
        best = [name for trial in self.best for name in trial.cameras]
        told = {"scan": str(self.scan), "best": best, "sentence": self.sentence(), "trials": trials}
        return {**told, "plate": dict(self.plate), "contradicted": sorted(self.contradicted)}


def print_identification(identification: Identification, console: Console) -> None:
    for trial in identification.trials:
        console.print(", ".join(trial.cameras), style="bold", highlight=False)
        console.print(Padding(_figures(trial), (0, 0, 0, 4)), highlight=False)
    console.print(identification.sentence(), highlight=False, soft_wrap=True)


def _figures(trial: Trial) -> str:
    if not trial.found:
        return f"{trial.score:.2f}: {trial.reason}"
    words = [f"{trial.score:.2f}: {trial.found} of {trial.drawn} marks, likeness {trial.likeness:.2f}"]
    words.append(f"signal-to-noise {trial.snr:.1f}")
    if trial.residual_mm is not None:
        words.append(f"affine residual {trial.residual_mm:.3f} mm ({trial.residual_sigmas:.0f} sigma)")
    if math.isfinite(trial.expected):
        words.append(f"by chance {trial.expected:.1g}")
    if trial.chance is not None:
        words.append(f"in wrong places {trial.chance:.2f}")
    return f"{', '.join(words)}; {trial.seconds:.0f} s"
