"""What is believed of film and scanner before any mark is measured."""

from dataclasses import dataclass

SCATTER_MM = 0.005  # of a mark, along an axis: a project's film_sigma_um says it better
AFFINITY_SIGMA = 5e-3  # film stretches by a few parts in ten thousand, an office scanner by several thousandths
SCATTER_DEGREES = 4.0  # of freedom that it is known with: to a third
MOST_BENT_MM = 0.3  # beside an affine transformation


@dataclass(frozen=True)
class BelievedFilm:
    """The scatter of marks by film and scanner, along an axis. is_stated: somebody says so, and adds it to every mark
    where it is adjusted; else a frame that scatters more has to bring all of its scatter along."""

    sigma_mm: float = SCATTER_MM
    is_stated: bool = False

    @property
    def added_later_mm(self) -> float:
        return self.sigma_mm if self.is_stated else 0.0


ANY_FILM = BelievedFilm()
