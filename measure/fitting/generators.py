"""How a mark may lie and look otherwise than it is drawn: the generators of its scale, rotation, stretch and shear."""

import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import Disk, Mark, MarkTemplate, Ring
from measure.match_options import Freedom

# Changes of the mark's linear part: (I + e G) times it, G a generator.
_TURN, _SCALE = ((0.0, -1.0), (1.0, 0.0)), ((1.0, 0.0), (0.0, 1.0))
_STRETCH, _SHEAR = ((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0))
_OF_FREEDOM: dict[Freedom, tuple[tuple[tuple[float, float], tuple[float, float]], ...]] = {
    "shift": (),
    "similarity": (_SCALE, _TURN),
    "affine": (_SCALE, _TURN, _STRETCH, _SHEAR),
    "ellipse": (_SCALE, _STRETCH, _SHEAR),
}


def generators(freedom: Freedom, mark: Mark) -> NDArray[np.float64]:
    """(n, 2, 2) of the changes that a fit estimates, scale and rotation first; a round mark has no rotation."""
    shown = [each for each in _OF_FREEDOM[freedom] if not (each is _TURN and is_round(mark))]
    return np.array(shown).reshape(-1, 2, 2)


def are_strains(generators: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) which of the changes (n, 2, 2) are of stretch or shear: symmetric, and the area stays."""
    symmetric = np.all(generators == generators.swapaxes(1, 2), axis=(1, 2))
    return np.asarray(symmetric & (np.trace(generators, axis1=1, axis2=2) == 0))


def is_round(mark: Mark) -> bool:
    """Whether every rotation leaves the mark as it is."""
    if isinstance(mark, MarkTemplate):
        return False
    centred = all(isinstance(part, Disk | Ring) and part.center_mm == (0.0, 0.0) for part in mark.parts)
    return centred and not any(mark.perspective)
