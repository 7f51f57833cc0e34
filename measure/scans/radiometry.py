"""From the numbers that a file stores to grey or colour values that grow with light."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.uint8 | np.uint16]


@dataclass(frozen=True, eq=False)
class Radiometry:
    """channels: 1 (grey) or 3 (red, green, blue), the first samples of a pixel; what follows them (transparency)
    is left out; full_scale_dn: the largest value; inverted: 0 is white; palette: (entries, 3) colours.
    """

    channels: int
    full_scale_dn: float
    inverted: bool = False
    palette: Samples | None = None

    @classmethod
    def of_palette(cls, colormap: NDArray[np.generic]) -> "Radiometry":
        """colormap (3, entries) as TIFF stores it: 16 bits, in some old files 8. All grey: one channel."""
        palette = np.asarray(colormap, np.uint16).T
        if palette.max() < 256:
            palette = palette * np.uint16(257)
        if np.all(palette == palette[:, :1]):
            palette = palette[:, :1]
        return cls(palette.shape[1], 65535.0, palette=np.ascontiguousarray(palette))

    @property
    def sample_bytes(self) -> int:
        return 1 if self.full_scale_dn < 256 else 2

    def apply(self, stored: NDArray[np.generic]) -> Samples:
        """(height, width, channels) values of (height, width, samples) stored numbers."""
        if self.palette is not None:
            indices = np.minimum(stored[..., 0].astype(np.intp), len(self.palette) - 1)
            return self.palette[indices]
        dtype = np.uint8 if self.sample_bytes == 1 else np.uint16
        samples: Samples = np.ascontiguousarray(stored[..., : self.channels], dtype)
        return dtype(self.full_scale_dn) - samples if self.inverted else samples
