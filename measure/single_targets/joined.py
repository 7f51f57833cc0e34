"""Records of arrays that have one length, put one after the other."""

from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")


def joined(first: Record, *others: Record) -> Record:
    """One record of what several of a kind hold."""
    names = [field.name for field in fields(first)]
    return type(first)(*(np.concatenate([getattr(record, name) for record in (first, *others)]) for name in names))
