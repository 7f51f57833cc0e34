"""The unit in which lengths in a camera's image are stated: mm and µm, or pixels of a digital camera."""

from dataclasses import dataclass

UM_PER_MM = 1000.0


@dataclass(frozen=True)
class ImageUnit:
    """mm for places and µm for residuals; of a digital camera, whose pixels are pixel_um wide, px for both."""

    pixel_um: float | None = None

    @property
    def is_pixel(self) -> bool:
        return self.pixel_um is not None

    @property
    def long_name(self) -> str:
        """Of places and principal distances."""
        return "px" if self.is_pixel else "mm"

    @property
    def short_name(self) -> str:
        """Of residuals, distortion and their standard deviations."""
        return "px" if self.is_pixel else "µm"

    @property
    def per_mm(self) -> float:
        """Places and principal distances in this unit to a mm."""
        return 1.0 if self.pixel_um is None else UM_PER_MM / self.pixel_um

    @property
    def per_um(self) -> float:
        """Residuals in this unit to a µm."""
        return 1.0 if self.pixel_um is None else 1.0 / self.pixel_um

    @property
    def decimals(self) -> int:
        """Of a residual as it is printed."""
        return 3 if self.is_pixel else 1


FILM_UNIT = ImageUnit()
