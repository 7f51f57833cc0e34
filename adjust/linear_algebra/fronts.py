"""An order in which the unknowns of a network are eliminated, and the fronts in which that is done.

The images of a strip or of a block share points with their neighbours alone, and all of them share the camera: their
reduced equations are a band with a border. Groups of unknowns, one an image, are put into the order of Cuthill and
McKee, which makes the band narrow, and the border behind. A front is a run of neighbours that are eliminated together
as one dense matrix; what it leaves goes to the front that owns the first unknown that it touches (Duff and Reid 1983,
The multifrontal solution of indefinite sparse symmetric linear equations). A small network is a single front.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from adjust.array_types import Indices

FRONT_COST = 1e6  # of handling a front, in unknowns times columns squared: what dense algebra does in that time


@dataclass(frozen=True)
class Front:
    """Unknowns first to stop (excluded), which are eliminated together, and the later ones (a,) that these meet."""

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
        """How many unknowns it touches."""
        return self.count + len(self.after)

    @property
    def columns(self) -> Indices:
        """The unknowns (k + a,) that it touches."""
        return np.concatenate([np.arange(self.first, self.stop), self.after])

    def places(self, unknowns: Indices) -> Indices:
        """Where some of the unknowns that it touches stand among them."""
        behind = self.count + np.searchsorted(self.after, unknowns)
        return np.where(unknowns < self.stop, unknowns - self.first, behind)


@dataclass(frozen=True)
class Fronts:
    """All fronts of a network, in the order of elimination."""

    members: tuple[Front, ...]

    @staticmethod
    def single(count: int) -> "Fronts":
        """All unknowns eliminated together."""
        return Fronts((Front(0, count, np.empty(0, dtype=np.intp)),))

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Front]:
        return iter(self.members)

    def __getitem__(self, i: int) -> Front:
        return self.members[i]

    @property
    def count(self) -> int:
        """The unknowns of all."""
        return self.members[-1].stop

    def home(self, unknowns: Indices) -> Indices:
        """The front (...,) that holds unknowns (..., s) together: which owns the first of them."""
        return np.asarray(np.searchsorted(self._starts, unknowns.min(axis=-1), side="right") - 1)

    @cached_property
    def table(self) -> Indices:
        """(f, 5) of every front: its first unknown, how many it owns, where its square begins if all stand one behind
        the other, where those that it meets later begin in `later_unknowns`, and how many these are."""
        count, later = np.array([(front.count, len(front.after)) for front in self], dtype=np.intp).T
        sizes = (count + later) ** 2
        return np.column_stack([self._starts, count, np.cumsum(sizes) - sizes, np.cumsum(later) - later, later])

    @cached_property
    def later_unknowns(self) -> Indices:
        """Those that the fronts meet later, one front behind the other."""
        return np.concatenate([front.after for front in self])

    @cached_property
    def _starts(self) -> Indices:
        return np.array([front.first for front in self.members], dtype=np.intp)


def band_order(meeting: csr_array) -> Indices:
    """Groups (g,) in an order in which those that some block meets together are near each other.

    meeting (g, g): an entry for every two groups that some block of observations meets both of.
    """
    if meeting.shape[0] == 0:
        return np.empty(0, dtype=np.intp)
    return np.asarray(reverse_cuthill_mckee(meeting, symmetric_mode=True), dtype=np.intp)


def make_fronts(meeting: csr_array, sizes: Indices, border: int) -> Fronts:
    """The fronts of groups of some unknowns each (g,), in their order, and of a border of unknowns that all may meet.

    meeting as in `band_order`. Neighbours are put together as long as that makes the elimination of an unknown cheaper.
    What a run of them leaves is handed on, all of it, to the first group that it meets later.
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
    """Groups first to stop (excluded), and the later ones that these meet."""

    first: int
    stop: int
    later: set[int]

    def cost(self, size: Indices) -> float:
        """Of the elimination of an unknown; size (g + 1,): the unknowns of every group."""
        own = int(size[self.first : self.stop].sum())
        width = own + int(size[list(self.later)].sum())
        return width**2 + FRONT_COST / max(own, 1)
