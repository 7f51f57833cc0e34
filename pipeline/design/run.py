"""`reseau design`: predict the precision of a scene's photographs, without any image."""

from pathlib import Path

from pipeline.design.alternatives import Alternative, alternatives
from pipeline.design.design_file import Design
from pipeline.design.expected import alone, expect
from pipeline.design.summary import plot_sweep
from pipeline.design.sweeps import Variations, over_layouts, sweep
from pipeline.progress import Reporter
from pipeline.results.record_json import write_record
from pipeline.text.atomic import check_writable


def run_design(scene_path: Path, out_dir: Path | None, reporter: Reporter) -> Design:
    """Plan a scene, vary it, and write design.json and the plots of its sweeps.

    Parameters
    ----------
    out_dir : None: a folder next to the scene file, with its name and "-design".

    Raises
    ------
    InputError, AdjustmentError : the scene cannot be planned.
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
    for number, each in enumerate(setup.settings.sweep, 1):
        with reporter.stage("varying") as count:
            swept.append(sweep(scene, number, each, count))
        word = f"sweep of {each.quantity}" if f"sweep of {each.quantity}" not in files else f"sweep {number}"
        files[word] = folder / f"sweep-{number}-{each.quantity}.svg"
        plot_sweep(swept[-1], files[word])
    design = Design(scene.path, expected, without_given, layouts, helpful, tuple(swept), files)
    write_record(design.content(), files["design"])
    return design
