"""`reseau design`: from a scene file to what its photographs would give, without any picture."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from adjust.problem.parameter import Parameter
from pipeline.design.alternatives import Alternative, alternatives
from pipeline.design.design_file import Json, design_json
from pipeline.design.expected import Expected, alone, expect
from pipeline.design.summary import plot_sweep, print_design
from pipeline.design.sweeps import Layouts, Swept, Variations, over_layouts, sweep
from pipeline.progress import Reporter
from pipeline.text.atomic import check_writable, write_atomically


@dataclass(frozen=True, eq=False)
class Design:
    """A plan that was carried out. files: what was written, by a word for it; content: that of design.json."""

    expected: Expected
    alone: Mapping[Parameter, float]
    layouts: Layouts
    helpful: tuple[Alternative, ...]
    swept: tuple[Swept, ...]
    content: Json
    files: dict[str, Path]

    @property
    def needs_a_look(self) -> bool:
        """Whether something is not determined, or hardly."""
        return bool(self.expected.plan.singular or self.expected.plan.adjustment.warnings)

    def print(self, console: Console) -> None:
        """For a person."""
        print_design(self.expected, self.alone, self.layouts, self.helpful, self.swept, self.files, console)


def run_design(scene_path: Path, out_dir: Path | None, reporter: Reporter) -> Design:
    """Plan a scene, vary it, and write design.json and the pictures of its sweeps.

    out_dir None: a folder beside the scene, of its name with "-design". Raises InputError or AdjustmentError.
    """
    folder = out_dir or scene_path.with_name(f"{scene_path.stem}-design")
    scene = Variations.read(scene_path)
    setup = scene.setup()
    check_writable(folder)
    with reporter.stage("planning") as count:
        count(scene_path.name, 0, 1)
        expected = expect(setup)
        without_given = alone(expected)
        layouts = over_layouts(scene, expected)
    helpful: tuple[Alternative, ...] = ()
    if setup.settings.alternatives:
        with reporter.stage("trying") as count:
            helpful = alternatives(expected, count)
    swept = []
    files = {"design": folder / "design.json"}
    for number, asked in enumerate(setup.settings.sweeps, 1):
        with reporter.stage("varying") as count:
            swept.append(sweep(scene, number, asked, count))
        picture = folder / f"sweep-{number}-{asked.quantity}.svg"
        plot_sweep(swept[-1], picture)
        files[f"sweep of {asked.quantity}"] = picture
    pictures = [path.name for path in files.values()][1:]
    content = design_json(scene, expected, without_given, layouts, helpful, tuple(zip(swept, pictures, strict=True)))
    write_atomically(files["design"], json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return Design(expected, without_given, layouts, helpful, tuple(swept), content, files)
