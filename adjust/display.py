"""Display of results: plots of a camera, which need Matplotlib, and tables for pandas, where it is installed."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.array_types import Array, Mask
from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Lens
from adjust.quality.lens_uncertainty import distortion_curves, is_defined_over_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BAND = 1.959964  # in standard deviations, half width of the 95 % band
LONGEST = 0.08  # length of the longest vectors, fraction of the longer side of the image
CELLS = 8  # cells of the coverage along the longer side
FEWEST_LEVELS = 5
CORNER = 0.05  # of the longer side: nearer to a corner than this the labels of contours overlap
ROUND = (1.0, 2.0, 5.0)  # mantissas of round numbers
FINER = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
TARGET, FIDUCIAL, OUTLINE = "#1f5fa8", "#c2571a", "#777777"


@dataclass(frozen=True, eq=False)
class CameraPlots:
    """Data for the plots of one camera, in its frame.

    Attributes
    ----------
    name : name of the camera.
    lens : lens with covariance.
    places_mm, vectors_mm : (n, 2) observations and their residuals, along the camera's axes.
    is_fiducial : (n,) which observations are fiducials.
    images : number of images of the camera.
    corners_mm : (2, 2) lower left and upper right corner of the image.
    uncertainty : returns places (r, c, 2) over the image and standard deviations (r, c) in mm, for a distance of the
        points.
    pixel_mm : side of a pixel; if given, plots are in px, y down.
    """

    name: str
    lens: Lens
    places_mm: Array
    vectors_mm: Array
    is_fiducial: Mask
    images: int
    corners_mm: Array
    uncertainty: Callable[[float], tuple[Array, Array]]
    pixel_mm: float | None = None

    def plot_residuals(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the residuals of all images as vectors over the image area.

        Parameters
        ----------
        axes : Matplotlib axes; default: a new figure
        """
        axes = self._frame(axes)
        places, vectors = self._places(self.places_mm), self._lengths(self.vectors_mm)
        sizes = np.hypot(*vectors.T)
        longest = max(float(np.percentile(sizes, 99)) if len(sizes) else 0.0, 1e-9)
        to_vector = longest / (LONGEST * float(np.ptp(self._places(self.corners_mm), axis=0).max()))
        for rows, color, label in ((~self.is_fiducial, TARGET, "targets"), (self.is_fiducial, FIDUCIAL, "fiducials")):
            if rows.any():
                style: dict[str, Any] = {"color": color, "label": label, "width": 0.0025}
                style |= {"angles": "xy", "scale_units": "xy", "scale": to_vector}
                quiver = axes.quiver(*places[rows].T, *vectors[rows].T, **style)
        if not len(sizes):
            axes.set_title(f"{self.name}: no residuals", loc="left", fontsize=10)
            return axes
        key = _round_below(longest)
        axes.quiverkey(quiver, 0.95, -0.1, key, f"{key:g} {self._short_unit}", labelpos="W")
        if self.is_fiducial.any():
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.11), ncols=2, frameon=False, fontsize="small")
        rms = " × ".join(f"{axis:.3g}" for axis in np.sqrt((vectors**2).mean(axis=0)))
        axes.set_title(f"{self.name}: residuals, rms {rms} {self._short_unit}", loc="left", fontsize=10)
        return axes

    def plot_distortion(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the distortion over the radius with 95 % bands; grey where no target was observed.

        Parameters
        ----------
        axes : Matplotlib axes; default: a new figure
        """
        axes = _axes(axes, (7.0, 4.0))
        corners = np.stack(np.meshgrid(*self.corners_mm.T), axis=-1).reshape(-1, 2)
        reach = float(np.hypot(*(corners - self.lens.interior[1:]).T).max())
        if is_defined_over_frame(self.lens):
            reach = min(reach, *self.lens.distortion.half_mm)
        curves = distortion_curves(self.lens, reach)
        radius, um = curves.radius_mm * self._per_mm, 1e-3 * self._lengths_per_mm
        drawn = [(curves.radial_um, curves.radial_sigma_um, TARGET, "radial")]
        if (curves.asymmetric_um > 1e-6).any():
            label = "without the radial part, largest of all directions"
            drawn.append((curves.asymmetric_um, curves.asymmetric_sigma_um, FIDUCIAL, label))
        for value, sigma, color, label in drawn:
            axes.plot(radius, um * value, color=color, label=label)
            axes.fill_between(
                radius, um * (value - BAND * sigma), um * (value + BAND * sigma), color=color, alpha=0.25, linewidth=0
            )
        targets_mm = self.places_mm[~self.is_fiducial] - self.lens.interior[1:]
        observed = float(np.hypot(*targets_mm.T).max(initial=0.0)) * self._per_mm
        if observed < radius[-1]:
            axes.axvspan(observed, radius[-1], color="#dddddd", zorder=0, label="no targets")
        axes.set_xlim(0.0, radius[-1])
        axes.set_xlabel(f"radius from the principal point ({'mm' if self.pixel_mm is None else 'px'})")
        axes.set_ylabel(f"displacement ({self._short_unit})")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
        axes.set_title(f"{self.name}: distortion, 95 % bands", loc="left", fontsize=10)
        return axes

    def plot_uncertainty(self, distance: float = np.inf, axes: "Axes | None" = None) -> "Axes":
        """Draw the standard deviation of projected points over the image area, with contours.

        Parameters
        ----------
        distance : distance of the points from the camera in object units; default: infinity
        axes : Matplotlib axes; default: a new figure
        """
        places_mm, sigma_mm = self.uncertainty(distance)
        axes = self._frame(axes)
        from matplotlib.colors import LogNorm

        places, sigma = self._places(places_mm), sigma_mm * self._lengths_per_mm
        levels = contour_levels(sigma)
        is_wide = len(levels) > 1 and levels[-1] > 3.0 * levels[0]
        norm = LogNorm(levels[0], levels[-1]) if is_wide else None
        x, y = np.moveaxis(places, -1, 0)
        filled = axes.contourf(x, y, sigma, levels=levels, cmap="viridis_r", norm=norm, extend="both")
        lines = axes.contour(x, y, sigma, levels=levels, colors="black", linewidths=0.6)
        low, high = np.sort(self._places(self.corners_mm), axis=0)
        for label in axes.clabel(lines, fmt="%g", fontsize=8):
            inward = np.minimum(label.get_position() - low, high - label.get_position())
            label.set_visible(bool(inward.max() > CORNER * (high - low).max()))
        colours = axes.figure.colorbar(filled, ax=axes, format="%g", shrink=0.8)
        colours.set_label(f"standard deviation ({self._short_unit})")
        where = "at infinity" if np.isinf(distance) else f"at a distance of {distance_text(distance)}"
        axes.set_title(f"{self.name}: projected points {where}", loc="left", fontsize=10)
        return axes

    def plot_coverage(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the observed targets and their number in each cell of the image area.

        Parameters
        ----------
        axes : Matplotlib axes; default: a new figure
        """
        axes = self._frame(axes)
        places, corners = (
            self._places(self.places_mm[~self.is_fiducial]),
            np.sort(self._places(self.corners_mm), axis=0),
        )
        sides = np.diff(corners, axis=0)[0]
        counts = np.maximum(np.rint(CELLS * sides / sides.max()), 1).astype(int)
        edges = [np.linspace(low, high, count + 1) for low, high, count in zip(*corners, counts, strict=True)]
        number, *_ = np.histogramdd(places, bins=edges)
        shown = axes.pcolormesh(*edges, np.ma.masked_equal(number.T, 0), cmap="Blues", vmin=0, alpha=0.8)
        axes.figure.colorbar(shown, ax=axes, shrink=0.8, label="targets in a cell")
        axes.plot(*places.T, ".", color="black", markersize=1.5)
        share = 100 * (number > 0).mean()
        title = f"{self.name}: {len(places)} targets in {self.images} images, {share:.0f} % of the cells"
        axes.set_title(title, loc="left", fontsize=10)
        return axes

    def _frame(self, axes: "Axes | None") -> "Axes":
        """Axes with the outline of the image."""
        low, high = np.sort(self._places(self.corners_mm), axis=0)
        width, height = high - low
        axes = _axes(axes, (7.0, min(1.0 + 6.0 * float(height / width), 9.0)))
        axes.plot(*np.transpose([low, (high[0], low[1]), high, (low[0], high[1]), low]), color=OUTLINE, linewidth=0.8)
        axes.set_aspect("equal")
        if self.pixel_mm is not None:
            axes.invert_yaxis()
        axes.set_xlabel("column (px)" if self.pixel_mm is not None else "x' (mm)")
        axes.set_ylabel("row (px)" if self.pixel_mm is not None else "y' (mm)")
        return axes

    def _places(self, places_mm: Array) -> Array:
        return places_mm * self._per_mm * ([1.0, 1.0] if self.pixel_mm is None else [1.0, -1.0])

    def _lengths(self, vectors_mm: Array) -> Array:
        """Residuals along the axes of the plot."""
        return vectors_mm * self._lengths_per_mm * ([1.0, 1.0] if self.pixel_mm is None else [1.0, -1.0])

    @property
    def _per_mm(self) -> float:
        return 1.0 if self.pixel_mm is None else 1.0 / self.pixel_mm

    @property
    def _lengths_per_mm(self) -> float:
        """Scale of residuals and standard deviations to µm or px."""
        return 1e3 if self.pixel_mm is None else 1.0 / self.pixel_mm

    @property
    def _short_unit(self) -> str:
        return "µm" if self.pixel_mm is None else "px"


class PlottedResult(ABC):
    """Result whose cameras can be plotted; `plots` returns the data."""

    @abstractmethod
    def plots(self, camera: str = "") -> CameraPlots:
        """Collect the data for the plots of a camera; its name is optional where there is one."""

    def plot_residuals(self, camera: str = "", axes: "Axes | None" = None) -> "Axes":
        """Draw the residuals of all images as vectors over the image area."""
        return self.plots(camera).plot_residuals(axes)

    def plot_distortion(self, camera: str = "", axes: "Axes | None" = None) -> "Axes":
        """Draw the distortion over the radius with 95 % bands."""
        return self.plots(camera).plot_distortion(axes)

    def plot_uncertainty(self, distance: float = np.inf, camera: str = "", axes: "Axes | None" = None) -> "Axes":
        """Draw the standard deviation of projected points over the image area; default: points at infinity."""
        return self.plots(camera).plot_uncertainty(distance, axes)

    def plot_coverage(self, camera: str = "", axes: "Axes | None" = None) -> "Axes":
        """Draw the observed targets and their number in each cell of the image area."""
        return self.plots(camera).plot_coverage(axes)


def contour_levels(values: Array) -> list[float]:
    """Choose round contour levels: by ratios, finer if these are too few, or equidistant for close values."""
    finite = values[np.isfinite(values)]
    if not finite.size or not finite.max() > 0.0:
        raise AdjustmentError("No point of the picture has a standard deviation: nothing was estimated of the camera.")
    low, high = max(float(finite.min()), 1e-3 * float(finite.max())), float(finite.max())
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for series in (ROUND, FINER):
        levels = sorted(float(f"{m * power:.3g}") for power in powers for m in series if low <= m * power <= high)
        if len(levels) >= FEWEST_LEVELS:
            return levels
    step = _round_below(max(high - low, 1e-3 * high) / FEWEST_LEVELS)
    return [float(f"{k * step:.6g}") for k in range(int(np.ceil(low / step)), int(high / step) + 1)] or [high]


def distance_text(distance: float) -> str:
    """Format a distance in object units with four digits."""
    return np.format_float_positional(distance, precision=4, fractional=False, trim="-")


def _round_below(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(f"{max(m for m in ROUND if m * power <= value * (1.0 + 1e-9)) * power:.3g}")


def _axes(axes: "Axes | None", size_in: tuple[float, float]) -> "Axes":
    """Return the axes, or those of a new figure. Raises ImportError without Matplotlib."""
    if axes is not None:
        return axes
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise ImportError(
            'Plots need Matplotlib, which this installation lacks. Install: pip install "reseau[plots]".'
        ) from None
    return plt.subplots(figsize=size_in, layout="constrained")[1]


def data_frame(columns: dict[str, Any]) -> Any:
    """Make a pandas.DataFrame. Raises ImportError without pandas."""
    try:
        import pandas as pd
    except ImportError:
        raise ImportError("Tables need pandas, which this installation lacks. Install: pip install pandas.") from None
    return pd.DataFrame(columns)
