"""Unit of lengths in the image: mm and µm for film, pixels for a digital camera."""

from dataclasses import dataclass

UM_PER_MM = 1000.0


@dataclass(frozen=True)
class ImageUnit:
    """Unit of image coordinates. pixel_um None: mm for coordinates and µm for residuals; otherwise px for both."""

    pixel_um: float | None = None

    @property
    def is_pixel(self) -> bool:
        return self.pixel_um is not None

    @property
    def long_name(self) -> str:
        """Unit of image coordinates and principal distances."""
        return "px" if self.is_pixel else "mm"

    @property
    def short_name(self) -> str:
        """Unit of residuals, distortion and their standard deviations."""
        return "px" if self.is_pixel else "µm"

    @property
    def per_mm(self) -> float:
        """Units of coordinates per mm."""
        return 1.0 if self.pixel_um is None else UM_PER_MM / self.pixel_um

    @property
    def per_um(self) -> float:
        """Units of residuals per µm."""
        return 1.0 if self.pixel_um is None else 1.0 / self.pixel_um

    @property
    def decimals(self) -> int:
        """Decimals of a printed residual."""
        return 3 if self.is_pixel else 1


FILM_UNIT = ImageUnit()
