"""Array types shared by the modules."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Samples = NDArray[np.uint8 | np.uint16]
