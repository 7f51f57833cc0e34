"""One picture that the tests of scan files store in every way, and read back."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure import open_scan

HEIGHT, WIDTH = 203, 317


def picture(dtype: type[np.unsignedinteger[Any]] = np.uint16, channels: int = 1) -> NDArray[Any]:
    """Smooth and detailed, over the whole range of its type, no two channels alike."""
    rows, cols = np.mgrid[0:HEIGHT, 0:WIDTH]
    planes = [
        0.5 + 0.4 * np.sin(cols / (9 + k)) * np.cos(rows / 13) + 0.1 * ((rows + cols + k) % 2) for k in range(channels)
    ]
    top = float(np.iinfo(dtype).max)
    values = np.stack(planes, -1) * top
    return np.asarray(np.clip(values, 0, top).astype(dtype)[..., 0 if channels == 1 else slice(None)])


def whole(path: Path) -> NDArray[np.float32]:
    with open_scan(path) as scan:
        return scan.window(0, 0, scan.width_px, scan.height_px)
