"""Types of arrays and paths shared by the modules."""

import os

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
FilePath = str | os.PathLike[str]
Samples = NDArray[np.uint8 | np.uint16]
