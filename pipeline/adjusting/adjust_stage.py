"""`reseau adjust` and `reseau choose`: adjust comparator coordinates, with scanner terms and the eccentricity of disks;
select film deformation and distortion model."""

import os
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from adjust.functional_model.scanner import carriage_terms, smooth_terms
from adjust.model_selection.model_choice import Choice, choose
from adjust.model_selection.scanner_choice import bent_network, choose_bends
from adjust.problem.estimates import adjusted_image, adjusted_places
from adjust.problem.network import Network
from adjust.problem.observations import Observations
from adjust.solution.adjustment import Options, adjust, adjust_unmodelled
from adjust.solution.result import Adjustment
from measure.results import ON_FILM
from pipeline.adjusting.network import build_network
from pipeline.archive.made_from import adjusted_from
from pipeline.errors import InputError
from pipeline.files.project_file import ASSUMED_PITCH_UM, Project
from pipeline.files.project_tables import AdjustSettings
from pipeline.measuring import target_field
from pipeline.publishing import unpublished
from pipeline.results.comparator_file import ComparatorPoint, has_pixels_alone, read_comparator
from pipeline.results.record_json import write_record
from pipeline.results.stage_files import choice_content
from pipeline.terminal import Reporter, uncut_table
from pipeline.text.wording import listed
from pipeline.types import Array

_ENDING = re.compile(r"\.[a-z][a-z0-9]{1,3}")  # of an image file; the known ones are no part of names
_ROUNDS = 4  # largest number of corrections: each is off by its own relative error, so the second is below the noise
_SETTLED_SIGMAS = 0.01  # change of the correction that ends the iteration, standard deviations of an observation
_NOTICEABLE_SIGMAS = 0.2  # standard deviations: a larger possible eccentricity that is not corrected is reported


def add_scanner_bends(
    project: Project, network: Network, adjusted: Callable[[Network], Adjustment]
) -> tuple[Network, tuple[str, ...]]:
    """Add scanner terms to the network, as the project demands.

    Parameters
    ----------
    adjusted : function that adjusts a network, for the tests that select terms.

    Returns
    -------
    The network, and remarks on terms that are not estimable.

    Raises
    ------
    InputError
        A requested term is part of the film deformation model, or no image has one.
    """
    settings = project.adjust
    if settings.scanner == "none":
        return network, ()
    films = {image.transformation for image in network.images if image.scanner}
    if not films:
        given = f'"{settings.scanner}"' if isinstance(settings.scanner, str) else list(settings.scanner)
        raise InputError(
            f"{project.path}: [adjust] scanner is {given}, but no image has a film transformation, and a digital "
            'camera no scanner. Write scanner = "none".'
        )
    sigma_mm = settings.scanner_sigma_um / 1000.0
    if settings.scanner == "auto":
        return choose_bends(network, adjusted, sigma_mm)
    smooth, carriage = smooth_terms(films), carriage_terms(films)
    possible = (*smooth, *carriage)
    terms = smooth if settings.scanner == "bend" else settings.scanner
    for term in terms:
        if term not in possible:
            raise InputError(
                f"{project.path}: [adjust] scanner names {term!r}, which the {' or '.join(sorted(films))} "
                f"transformation of the films takes; it leaves {', '.join(possible) or 'no term'}."
            )
    return bent_network(network, terms, sigma_mm), ()


def adjust_marks(project: Project, marks: Sequence[ComparatorPoint]) -> Adjustment:
    """Adjust measured marks. Warnings and notes are part of the result.

    Raises InputError or AdjustmentError where no adjustment is possible.
    """
    options = adjustment_options(project.adjust)
    adjusted = partial(adjust, options=options)
    misnamed, notes = _misspelt_names(project, marks), _notes(project, marks)
    if project.disk_radius > 0.0:
        target_field.check_spacing(project, target_field.target_field(project))
    network, left_out = build_network(project, marks)
    network, bend_remarks = add_scanner_bends(project, network, adjusted)
    pitch_um = project.pitch_um or project.list_pitch_um
    is_digital = all(image.transformation == "none" for image in network.images)
    pixel_mm = float(np.mean(pitch_um)) / 1000.0 if is_digital and pitch_um else None
    network = replace(network, cameras=tuple(replace(each, pixel_mm=pixel_mm) for each in network.cameras))
    if project.adjust.unmodelled == "estimate":
        first = adjust_unmodelled(network, options, pixel_mm)
    else:
        first = adjusted(network)
    adjustment, uncorrected = first, tuple[str, ...]()
    if project.disk_radius > 0.0:
        adjustment, uncorrected = _correct_eccentricity(project, first, options)
    alike = _alike_names(project, marks)
    remarks = (*adjustment.remarks, *left_out, *bend_remarks, *misnamed, *alike, *uncorrected)
    return replace(adjustment, unmodelled_mm=first.unmodelled_mm, remarks=remarks, unused=(*adjustment.unused, *notes))


def adjustment_options(settings: AdjustSettings) -> Options:
    """Options of the adjustment from the settings of the same names."""
    names = {field.name for field in fields(Options)}
    return Options(**{name: value for name, value in vars(settings).items() if name in names})


def _correct_eccentricity(
    project: Project, adjustment: Adjustment, options: Options
) -> tuple[Adjustment, tuple[str, ...]]:
    """Iterate adjustment and correction of disks; also return a remark on eccentricities that are not corrected."""
    normals = project.given_points.normals if project.given_points else {}
    measured_mm = adjustment.network.observations.xy_mm
    applied = uncorrected = np.zeros_like(measured_mm)
    sigmas_mm = np.ones_like(measured_mm)
    for _ in range(_ROUNDS):
        if not adjustment.converged:
            break
        observations = adjustment.network.observations  # of each round, which may leave out images and points
        sigmas_mm = np.sqrt(np.diagonal(observations.covariance_mm2, axis1=1, axis2=2))
        wanted, uncorrected = _eccentricities(adjustment, normals, project.disk_radius)
        if np.max(np.abs(wanted - applied) / sigmas_mm, initial=0.0) < _SETTLED_SIGMAS:
            break
        shifted = replace(adjustment.network, observations=replace(observations, xy_mm=measured_mm - wanted))
        corrected = adjust(shifted, options=options)
        kept = _matching_rows(observations, corrected.network.observations)
        measured_mm, applied = measured_mm[kept], wanted[kept]
        adjustment = replace(corrected, left_out={**adjustment.left_out, **corrected.left_out})
    worst = float(np.max(np.abs(uncorrected) / sigmas_mm, initial=0.0))
    if worst <= _NOTICEABLE_SIGMAS:
        return adjustment, ()
    remark = (
        f"The disks' eccentricity is not corrected, for their normals are not known; it can reach {worst:.1f} sigma "
        f"({1000.0 * float(np.abs(uncorrected).max()):.2f} µm). Add the columns nX, nY, nZ to the points, or use "
        "smaller disks."
    )
    return adjustment, (remark,)


def _matching_rows(observations: Observations, some: Observations) -> list[int]:
    """Rows of some of the observations."""
    rows = {
        mark: row
        for row, mark in enumerate(zip(observations.image, observations.point, observations.kind, strict=True))
    }
    return [rows[mark] for mark in zip(some.image, some.point, some.kind, strict=True)]


def _eccentricities(adjustment: Adjustment, given: Mapping[str, Array], radius: float) -> tuple[Array, Array]:
    """(n, 2) mm, eccentricities to be subtracted, and largest possible ones of disks with unknown normals."""
    network = adjustment.network
    observations = network.observations
    ids = [point.id for point in network.points]
    coordinates = adjusted_places(adjustment, ids)
    row_of = {id: row for row, id in enumerate(ids)}
    plane = target_field.plane_normal(coordinates)
    known_part, unknown_part = np.zeros_like(observations.xy_mm), np.zeros_like(observations.xy_mm)
    rows_of = defaultdict[str, list[int]](list)
    for row, (name, kind) in enumerate(zip(observations.image, observations.kind, strict=True)):
        if kind == "target":
            rows_of[name].append(row)
    for name, rows in rows_of.items():
        at = [row_of[observations.point[i]] for i in rows]
        model, places = adjusted_image(adjustment, name), coordinates[at]
        normals, known = target_field.disk_normals([ids[k] for k in at], places, given, plane, model.station)
        known_part[rows] = np.where(known[:, None], target_field.eccentricity_mm(model, places, normals, radius), 0.0)
        sight = (model.station - places) / np.linalg.norm(model.station - places, axis=1, keepdims=True)
        # at 45° to it, where the eccentricity is largest
        slanted = (sight + target_field.across(sight)[0]) / np.sqrt(2.0)
        unknown_part[rows] = np.where(known[:, None], 0.0, target_field.eccentricity_mm(model, places, slanted, radius))
    return known_part, unknown_part


def _misspelt_names(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[str, ...]:
    """Warning of a probably misspelt name: some images have no line in images.csv, and some lines no image."""
    if project.given_images is None:
        return ()
    images, given = {mark.image for mark in marks}, set(project.given_images.exterior)
    without_line, without_marks = listed(sorted(images - given)), listed(sorted(given - images))
    if not without_line or not without_marks:
        return ()
    return (
        f"The file of images says nothing of {without_line}, and names {without_marks}, of which there are no marks. "
        "Look for a misspelt name.",
    )


def _alike_names(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[str, ...]:
    """Warning of images of one camera that are probably one: their names differ by case and ending only. Images that
    images.csv or the scans list both are two."""
    given, first, pairs = project.given_images, dict[str, str](), list[str]()
    listed_names = (given.exterior if given else {}, project.scans)
    names = sorted({mark.image for mark in marks})
    stems = {name.casefold() for name in names}
    for name in names:
        stem, ending = os.path.splitext(name.casefold())
        key = stem if _ENDING.fullmatch(ending) and stem in stems else name.casefold()
        other = first.setdefault(key, name)
        if other == name or project.image_camera(other) != project.image_camera(name):
            continue
        if not any(name in known and other in known for known in listed_names):
            pairs.append(f"{other} and {name}")
    if not pairs:
        return ()
    return (
        f"{listed(pairs)} differ only by case and ending, and count as two images: give one image one name in "
        "comparator.csv. If they are two, list both in images.csv.",
    )


def _notes(project: Project, marks: Sequence[ComparatorPoint]) -> tuple[str, ...]:
    """Notes on an assumed pixel pitch, and on given points that no image shows."""
    observed = {mark.point for mark in marks if mark.status.is_observation and mark.kind not in ON_FILM}
    lost = [id for id in project.object_points if id not in observed] if project.given_points is not None else []
    notes, path = [], project.comparator
    if project.pitch_um is None and not project.scans and path.exists() and has_pixels_alone(path):
        notes.append(
            f"Nothing says how large a pixel is: {ASSUMED_PITCH_UM:g} µm are assumed. Of all in mm and µm only ratios "
            "count; set pitch_um in project.toml to have them."
        )
    if lost:  # an effect of large patterns, but also of a wrong point number
        notes.append(
            f"Given but measured in no image: {'point' if len(lost) == 1 else f'{len(lost)} points,'} {listed(lost)}. "
            f"If an image shows {'it' if len(lost) == 1 else 'one'}, look for a wrong point number or coordinate."
        )
    return tuple(notes)


def run_choose(project: Project, reporter: Reporter) -> tuple[Choice, dict[str, object]]:
    """Compare models on the observations of the project's own adjustment, with disks corrected for eccentricity; write
    and return the result.

    Raises InputError or AdjustmentError where the project cannot be adjusted.
    """
    with unpublished(project) as new:
        with reporter.stage("comparing") as count:
            marks = read_comparator(project.comparator, project.list_pitch_um)
            sizes = {camera.name: camera.frame_mm for camera in project.cameras.values() if camera.frame_mm}
            half_mm = {name: (width / 2.0, height / 2.0) for name, (width, height) in sizes.items()}
            own = adjust_marks(project, marks)
            # All images name their scanners, whether scanner terms are estimated or not.
            images = tuple(
                image if image.transformation == "none" else replace(image, scanner=project.image_scanner(image.name))
                for image in own.network.images
            )
            choice = choose(
                replace(own, network=replace(own.network, images=images)),
                adjustment_options(project.adjust),
                half_mm,
                lambda name, _: count(name, 0, 1),
            )
        content = choice_content(choice, adjusted_from(project, marks))
        write_record(content, new.place(project.choice_path))
        new.publish()
    return choice, content


def print_choice(choice: Choice, console: Console, path: Path) -> None:
    """Print a table of the candidates, the verdict and the reasons."""
    columns = ("model", "unknowns", "sigma0", "AICc", "left out, µm")
    table = uncut_table(columns, "Candidates")
    for each in choice.candidates:
        predicted = each.cross_validation
        numbers = (
            str(each.unknowns),
            f"{each.sigma0:.3f}",
            f"{each.aicc:.1f}",
            "none" if predicted is None else f"{predicted.rms_um:.2f}",
        )
        shown = ("no solution",) if each.problem else numbers
        table.add_row(Text(each.model.name), *shown, style="bold green" if each is choice.chosen else "")
    console.print(table)
    console.print(Text(choice.verdict, style="bold"))
    for reason in choice.reasons:
        console.print(Text(f"- {reason}"))
    console.print(f"choice: {path}", soft_wrap=True, markup=False, highlight=False)
