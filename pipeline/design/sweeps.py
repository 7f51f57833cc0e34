"""Sweeps: a scene with one quantity varied, and the resulting precision of the camera."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.design.expected import Expected, expect
from pipeline.design.setup import Setup, scene_setup
from pipeline.errors import InputError
from pipeline.files.library import camera_path
from pipeline.files.object_files import ELEMENTS
from pipeline.rendered.scene_file import parse_scene
from pipeline.rendered.scene_tables import Sweep
from pipeline.terminal import Count
from pipeline.text.toml_tables import Table, read_toml
from pipeline.text.wording import did_you_mean

Values = dict[str, Any]

EXTERIOR = {name: ("position" if k < 3 else "angles_deg", k % 3) for k, name in enumerate(ELEMENTS)}
PLANNING_PITCH_UM = 20.0  # default: a scene that is only planned needs no pitch


@dataclass(frozen=True)
class Variations:
    """Values of a scene file, and setups with some of them changed.

    A quantity is a key of the scene file by its dotted name: `design.sigma_height`, `camera.principal_distance_mm`,
    `field.grid.1.relief` (the first of several), `image.NAME.position.3` (the third number). In addition:
    `exterior.IMAGE.X0` .. `kappa_deg`; `field.points`, the number of targets over the same area; `images` and
    `camera.fiducials`, the number of them that is kept.
    """

    path: Path
    values: Values

    @staticmethod
    def read(path: Path) -> "Variations":
        """Read a scene file. Raises InputError."""
        values = copy.deepcopy(dict(read_toml(path, "scene.toml").values))
        # Without a field it is no scene, and is refused with the keys that it has; so is a scan that is no table.
        if "field" in values and isinstance(scan := values.setdefault("scan", {}), dict):
            scan.setdefault("pitch_um", PLANNING_PITCH_UM)
        return Variations(path, values)

    def setup(self, layout: int = 0) -> Setup:
        """The setup, with the random layout of its field of this number."""
        values = self.values | {"seed": self.values.get("seed", 1) + layout} if layout else self.values
        return scene_setup(parse_scene(Table(values, self.path, "")))

    def set_value(self, number: int, sweep: Sweep, value: float | str) -> "Variations":
        """The scene with the quantity of a sweep set to a value. Raises InputError for an unknown quantity."""
        try:
            values = self._changed_values(sweep.quantity, value)
            varied = Variations(self.path, values)
            varied.setup()
        except InputError as error:
            raise InputError(
                f"{self.path}: [design.sweep[{number}]] {sweep.quantity} = {value!r} does not make a scene: {error}"
            ) from None
        return varied

    def _changed_values(self, quantity: str, value: float | str) -> Values:
        values = copy.deepcopy(self.values)
        parts = quantity.split(".")
        if parts[0] == "camera" and isinstance(values.get("camera"), str):
            camera = copy.deepcopy(dict(read_toml(camera_path(values["camera"], self.path.parent)).values))
            for table in (camera, *camera.get("fiducial", [])):
                table.pop("mark", None)  # the drawings of the marks are not needed here
            values["camera"] = camera
        if parts[0] == "exterior":
            if (element := parts[-1]) not in EXTERIOR:
                hint = did_you_mean(element, EXTERIOR)
                raise InputError(
                    f"an exterior orientation has no element {element!r}.{hint} It has {', '.join(EXTERIOR)}."
                )
            image = _member(values.get("image", []), ".".join(parts[1:-1]), "image")
            key, index = EXTERIOR[element]
            image[key] = [*image[key][:index], value, *image[key][index + 1 :]]
        elif quantity == "field.points":
            _spread(values.get("field", {}), _count(quantity, value))
        elif quantity == "images":
            values["image"] = values.get("image", [])[: _count(quantity, value)]
        elif quantity == "camera.fiducials":
            values["camera"]["fiducial"] = values["camera"].get("fiducial", [])[: _count(quantity, value)]
        else:
            _assign(values, parts, value)
        return values


def _count(quantity: str, value: float | str) -> int:
    if not isinstance(value, int) or value < 1:
        raise InputError(f"{quantity} counts things; its values must be whole numbers of at least 1, not {value!r}.")
    return value


def _spread(field: Values, points: int) -> None:
    """Change the number of targets over the same area, as closely as whole rows and columns allow."""
    if field.get("kind", "disks") != "disks":
        raise InputError("field.points varies fields of disks; a board has columns and rows.")
    scatters, grids = field.get("scatter", []), field.get("grid", [])
    now = sum(one["points"] for one in scatters) + sum(one["columns"] * one["rows"] for one in grids)
    if now == 0:
        raise InputError("field.points varies [[field.grid]] and [[field.scatter]], and there is neither.")
    share = points / now
    for scatter in scatters:
        scatter["points"] = max(round(scatter["points"] * share), 1)
    for grid in grids:
        for count, step in (("columns", "right"), ("rows", "up")):
            new = max(round(grid[count] * np.sqrt(share)), 1)
            grid[step] = [length * grid[count] / new for length in grid[step]]
            grid[count] = new
    first = 1
    for part in (*grids, *scatters):  # renumber: the enlarged parts would overlap in their numbers
        part["first"] = first
        first += part["points"] if "points" in part else part["columns"] * part["rows"]


def _assign(values: Values, parts: list[str], value: float | str) -> None:
    node: Any = values
    for i, part in enumerate(parts[:-1]):
        if isinstance(node, list):
            node = _member(node, part, ".".join(parts[:i]))
        elif isinstance(node, dict):
            node = node.setdefault(part, {})
    last = parts[-1]
    if isinstance(node, dict):
        node[last] = value
    elif isinstance(node, list) and last.isdigit() and 1 <= int(last) <= len(node):
        node[int(last) - 1] = value
    else:
        raise InputError(f"{'.'.join(parts[:-1])} is {node!r} and has no {last!r}.")


def _member(entries: list[Any], name: str, what: str) -> Any:
    """Entry of an array of tables, by its name, its id or its number from 1."""
    names = {str(entry.get("name", entry.get("id", ""))): entry for entry in entries if isinstance(entry, dict)}
    if name in names:
        return names[name]
    if name.isdigit() and 1 <= int(name) <= len(entries):
        return entries[int(name) - 1]
    known = [one for one in names if one] or [str(i + 1) for i in range(len(entries))]
    raise InputError(f"there is no {what} {name!r}.{did_you_mean(name, known)} There are {', '.join(known) or 'none'}.")


@dataclass(frozen=True)
class Layouts:
    """Mean and spread of the camera's standard deviations over random layouts of the test field, by name.

    spread: standard deviation over the layouts; 0 for a single one.
    """

    count: int
    mean: Mapping[str, float]
    spread: Mapping[str, float]


@dataclass(frozen=True)
class Step:
    """One value of the quantity and its results; redundancy and null directions are those of the first layout."""

    value: float | str
    points: int
    redundancy: int
    singular: int
    sigmas: Layouts


@dataclass(frozen=True)
class Swept:
    """Result of a sweep."""

    quantity: str
    steps: tuple[Step, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all standard deviations that occur in some step."""
        return tuple(dict.fromkeys(name for step in self.steps for name in step.sigmas.mean))

    @property
    def numeric(self) -> bool:
        return all(not isinstance(step.value, str) for step in self.steps)

    def slope(self, name: str) -> float:
        """Slope of the logarithm of sigma over the logarithm of the value; nan where one of these does not exist."""
        values = [step.value for step in self.steps]
        sigmas = [step.sigmas.mean.get(name, math.nan) for step in self.steps]
        if not all(isinstance(value, int | float) and value > 0.0 for value in values):
            return math.nan
        if not all(0.0 < sigma < math.inf for sigma in sigmas):
            return math.nan
        x, y = np.log(np.array(values, dtype=float)), np.log(np.array(sigmas))
        return float(np.polyfit(x, y, 1)[0])


def sweep(scene: Variations, number: int, planned: Sweep, progress: Count = lambda *_: None) -> Swept:
    """Carry out a sweep. number: of the sweep in the scene, for messages. Raises InputError for an unknown quantity."""
    varied = [scene.set_value(number, planned, value) for value in planned.values]
    steps = []
    for done, variation in enumerate(varied, 1):
        value: float | str = planned.values[done - 1]
        progress(f"{planned.quantity} = {value}", done, len(varied))
        first = expect(variation.setup())
        adjustment = first.plan.adjustment
        sigmas = over_layouts(variation, first)
        steps.append(Step(value, len(first.network.points), adjustment.redundancy, len(first.plan.singular), sigmas))
    return Swept(planned.quantity, tuple(steps))


def over_layouts(scene: Variations, first: Expected) -> Layouts:
    """Standard deviations of the camera over as many layouts as the scene asks for. first: result of the first
    layout."""
    count = first.setup.settings.layouts
    found = [first.camera_sigmas, *(expect(scene.setup(layout)).camera_sigmas for layout in range(1, count))]
    mean = {name: float(np.mean([sigmas[name] for sigmas in found])) for name in first.camera_sigmas}
    with np.errstate(invalid="ignore"):
        spread = {name: float(np.std([sigmas[name] for sigmas in found])) for name in mean}
    return Layouts(count, mean, {name: 0.0 if math.isinf(mean[name]) else spread[name] for name in spread})
