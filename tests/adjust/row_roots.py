"""Roots of the cofactor matrices of adjusted rows, put together from the reduced rows that reliability is made from."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from adjust.linear_algebra.factor import Blocks, Factor


def row_roots(factor: Factor, blocks: Iterable[Blocks]) -> Iterator[NDArray[np.float64]]:
    """G (b, m, k) of blocks as these were factorised: G G' are the cofactor matrices of each one's adjusted rows."""
    for rows in factor.reduced_rows(blocks):
        yield np.concatenate([rows.own, rows.through @ factor.triangle.group_roots(rows.shared)], axis=2)
