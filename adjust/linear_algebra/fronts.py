"""Elimination order of the unknowns of a network, and its division into fronts.

The images of a strip or block share points only with their neighbours, and all share the camera: their reduced normal
equations are banded and bordered. The Cuthill-McKee order of the groups of unknowns, one group per image, makes the
band narrow; the border is eliminated last. A front is a run of neighbouring groups that are eliminated together as one
dense matrix. Its Schur complement is passed to the front that owns the first remaining unknown (Duff and Reid 1983, The
multifrontal solution of indefinite sparse symmetric linear equations). A small network is a single front.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from adjust.array_types import Indices

FRONT_COST = 1e6  # overhead of a front, in unknowns times columns squared of dense algebra in the same time


@dataclass(frozen=True)
class Front:
    """Front: unknowns first to stop (excluded), eliminated together, and the later ones (a,) connected with them."""

    first: int
    stop: int
    after: Indices

    @property
    def own(self) -> slice:
        return slice(self.first, self.stop)

    @property
    def count(self) -> int:
        return self.stop - self.first

    @property
    def width(self) -> int:
        """Number of unknowns of the front, own and later ones."""
        return self.count + len(self.after)

    @property
    def columns(self) -> Indices:
        """Unknowns (k + a,) of the front, own ones first."""
        return np.concatenate([np.arange(self.first, self.stop), self.after])

    def places(self, unknowns: Indices) -> Indices:
        """Positions of unknowns within the front."""
        behind = self.count + np.searchsorted(self.after, unknowns)
        return np.where(unknowns < self.stop, unknowns - self.first, behind)


@dataclass(frozen=True)
class Fronts:
    """All fronts of a network, in the order of elimination."""

    members: tuple[Front, ...]

    @staticmethod
    def single(count: int) -> "Fronts":
        """A single front of all unknowns."""
        return Fronts((Front(0, count, np.empty(0, dtype=np.intp)),))

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Front]:
        return iter(self.members)

    def __getitem__(self, i: int) -> Front:
        return self.members[i]

    @property
    def count(self) -> int:
        """Number of unknowns of all fronts."""
        return self.members[-1].stop

    def home(self, unknowns: Indices) -> Indices:
        """Front (...,) that holds unknowns (..., s) together: the owner of the first of them."""
        return np.asarray(np.searchsorted(self._starts, unknowns.min(axis=-1), side="right") - 1)

    @cached_property
    def table(self) -> Indices:
        """(f, 5) table of the fronts, for the compiled kernels.

        Columns: first unknown, number of own unknowns, offset of the front's matrix in an array of all, offset of its
        later unknowns in `later_unknowns`, and their number.
        """
        count, later = np.array([(front.count, len(front.after)) for front in self], dtype=np.intp).T
        sizes = (count + later) ** 2
        return np.column_stack([self._starts, count, np.cumsum(sizes) - sizes, np.cumsum(later) - later, later])

    @cached_property
    def later_unknowns(self) -> Indices:
        """Later unknowns of all fronts, one front after the other."""
        return np.concatenate([front.after for front in self])

    @cached_property
    def _starts(self) -> Indices:
        return np.array([front.first for front in self.members], dtype=np.intp)


def band_order(meeting: csr_array) -> Indices:
    """Order groups (g,) of unknowns by the reverse Cuthill-McKee algorithm, so that connected groups are close.

    meeting (g, g): adjacency matrix, with an entry for any two groups that occur in the same block of observations.
    """
    return np.asarray(reverse_cuthill_mckee(meeting, symmetric_mode=True), dtype=np.intp)


def make_fronts(meeting: csr_array, sizes: Indices, border: int) -> Fronts:
    """Divide ordered groups of unknowns and a border into fronts.

    Parameters
    ----------
    meeting : (g, g) adjacency matrix of the groups, as in `band_order`, in elimination order.
    sizes : (g,) numbers of unknowns of the groups.
    border : number of unknowns that may be connected with all groups.

    Notes
    -----
    Neighbouring groups are merged as long as this lowers the cost per eliminated unknown. The later unknowns of a run
    are passed on, all of them, to its first later group.
    """
    size, count = np.append(sizes, border), len(sizes)
    handed_on: list[set[int]] = [set() for _ in range(count + 1)]
    runs: list[_Run] = []
    for group in range(count + 1):
        neighbours = meeting.indices[slice(*meeting.indptr[group : group + 2])] if group < count else ()
        later = {int(i) for i in neighbours if i > group} | handed_on[group] | {count}
        if runs:
            last = runs[-1]
            together = _Run(last.first, group + 1, (last.later | later) - {group})
            if together.cost(size) <= last.cost(size):
                runs[-1] = together
                continue
            handed_on[min(last.later)] |= last.later
            later |= handed_on[group]
        runs.append(_Run(group, group + 1, later - {group}))
    stops = np.cumsum(size)
    starts = stops - size
    fronts = [
        Front(
            int(starts[run.first]),
            int(stops[run.stop - 1]),
            np.concatenate([np.arange(starts[i], stops[i]) for i in sorted(run.later)] or [np.empty(0, np.intp)]),
        )
        for run in runs
        if stops[run.stop - 1] > starts[run.first]
    ]
    return Fronts(tuple(fronts)) if fronts else Fronts.single(0)


@dataclass(frozen=True)
class _Run:
    """Groups first to stop (excluded), and the later ones connected with them."""

    first: int
    stop: int
    later: set[int]

    def cost(self, size: Indices) -> float:
        """Cost per eliminated unknown; size (g + 1,): numbers of unknowns of the groups."""
        own = int(size[self.first : self.stop].sum())
        width = own + int(size[list(self.later)].sum())
        return width**2 + FRONT_COST / max(own, 1)
