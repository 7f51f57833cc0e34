"""Quarter turns of board images: the turn that fits the lens of the other images."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from pipeline.adjusting.adjust_stage import adjustment_options
from pipeline.adjusting.network import build_network
from pipeline.calibration.pictures import QUARTERS_DEG, CameraPictures
from pipeline.files.images_file import GivenImages
from pipeline.files.project_file import Project
from pipeline.results.comparator_file import ComparatorPoint

PLAIN = 20.0  # twice the log-likelihood ratio; odds of e to the 10
FEWEST_PICTURES = 3  # images with known turns needed to determine the lens


def find_turns(project: Project, marks: Sequence[ComparatorPoint], camera: CameraPictures) -> CameraPictures:
    """Determine the quarter turn of each image; `unsure_turns`: those that fit equally with both turns.

    The principal point and the decentring distortion, which turn with the image, distinguish the turns. Each image is
    resected with the lens of those with known turns; where these are too few, all are adjusted with either turn. Raises
    AdjustmentError or InputError where the images with known turns have no solution.

    Parameters
    ----------
    marks : of the camera's images
    """
    open_turns = [name for name in camera.images if camera.turned_deg.get(name, 0) is None]
    known = {name: turn for name, turn in camera.turned_deg.items() if turn is not None}
    shown = {mark.image for mark in marks}
    sought = [name for name in open_turns if name in shown]
    if not sought:
        return replace(camera, turned_deg=known | dict.fromkeys(open_turns, QUARTERS_DEG[0]))
    fixed = sorted(shown - set(sought))
    adjusted = partial(adjust, options=adjustment_options(project))

    def turned_network(images: Collection[str], turns: Mapping[str, int]) -> Network:
        given = project.given_images or GivenImages({}, {})
        turned = replace(project, given_images=replace(given, turned_deg=turns))
        return build_network(turned, [mark for mark in marks if mark.image in images])[0]

    groups = [[name] for name in sought]
    lens: Adjustment | None = None
    if len(fixed) >= FEWEST_PICTURES:
        lens = adjusted(turned_network(fixed, known))
    else:
        groups = [sought]  # all with the same turn
    turns, unsure = dict[str, int](), list[str]()
    for group in groups:
        fits = dict[int, Adjustment]()
        for turn in QUARTERS_DEG:
            images = group if lens else [*fixed, *group]
            network = turned_network(images, known | dict.fromkeys(group, turn))
            if lens is not None:
                network = replace(network, cameras=(_held_camera(network.cameras[0], lens),))
            with suppress(AdjustmentError):
                fits[turn] = adjusted(network)
        best = min(fits, key=lambda turn: fits[turn].vpv, default=QUARTERS_DEG[0])
        turns |= dict.fromkeys(group, best)
        if not _is_plain(fits, best):
            unsure += group
    sure = [turns[name] for name in sought if name not in unsure]
    usual = max(QUARTERS_DEG, key=sure.count) if sure else QUARTERS_DEG[0]
    turns |= dict.fromkeys([*unsure, *(name for name in open_turns if name not in shown)], usual)
    return replace(camera, turned_deg=known | turns, unsure_turns=tuple(unsure))


def _is_plain(fits: Mapping[int, Adjustment], best: int) -> bool:
    """Whether one turn fits significantly better than the other."""
    if len(fits) < len(QUARTERS_DEG):
        return bool(fits)
    variance = max(fits[best].vpv / max(fits[best].redundancy, 1), 1.0)
    return all((fit.vpv - fits[best].vpv) / variance > PLAIN for turn, fit in fits.items() if turn != best)


def _held_camera(camera: Camera, fitted: Adjustment) -> Camera:
    """The camera with its adjusted parameters held fixed."""

    def prior(name: str) -> Prior:
        return Prior(fitted.value(Parameter.interior(camera.name, name)), 0.0)

    distortion = replace(camera.distortion, parameters={name: prior(name) for name in camera.distortion.parameters})
    return replace(
        camera, principal_distance_mm=prior("c"), x0_mm=prior("x0"), y0_mm=prior("y0"), distortion=distortion
    )
