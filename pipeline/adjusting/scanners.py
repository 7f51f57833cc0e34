"""Which scanners bend their scans, and by which terms, as [adjust] asks for it."""

from collections.abc import Callable
from dataclasses import replace

from adjust.functional_model.scanner import carriage_terms, smooth_terms
from adjust.model_selection.scanner_choice import bent_network, choose_bends
from adjust.problem.network import Network
from adjust.solution.result import Adjustment
from pipeline.errors import InputError
from pipeline.files.adjust_table import AdjustSettings
from pipeline.files.project_file import Project

UM_PER_MM = 1000.0


def with_scanners(
    project: Project, network: Network, adjusted: Callable[[Network], Adjustment]
) -> tuple[Network, tuple[str, ...]]:
    """The network with its scanners' bends, and what is to be said of terms that cannot be told.

    adjusted: how a network is adjusted, for tests to choose by. Raises InputError where a term is asked for that the
    film transformations take.
    """
    settings = project.adjust
    if settings.scanner == "none":
        return network, ()
    films = {image.transformation for image in network.images if image.scanner}
    if not films:
        raise InputError(
            f"{project.path}: [adjust] scanner is {_spelt(settings)}, but no image has a film transformation, and a "
            'digital camera no scanner. Write scanner = "none".'
        )
    sigma_mm = settings.scanner_sigma_um / UM_PER_MM
    if settings.scanner == "auto":
        choice = choose_bends(network, adjusted, sigma_mm)
        return choice.network, choice.remarks
    if settings.scanner == "bend":
        return bent_network(network, None, sigma_mm), ()
    possible = (*smooth_terms(films), *carriage_terms(films))
    for term in settings.scanner:
        if term not in possible:
            raise InputError(
                f"{project.path}: [adjust] scanner names {term!r}, which the {' or '.join(sorted(films))} "
                f"transformation of the films takes; it leaves {', '.join(possible) or 'no term'}."
            )
    return bent_network(network, settings.scanner, sigma_mm), ()


def with_scanner_names(project: Project, network: Network) -> Network:
    """The network whose images say which scanner they come from, whether its bend is to be estimated or not."""
    images = tuple(
        image if image.transformation == "none" else replace(image, scanner=project.scanner_of(image.name))
        for image in network.images
    )
    return replace(network, images=images)


def _spelt(settings: AdjustSettings) -> str:
    return f'"{settings.scanner}"' if isinstance(settings.scanner, str) else str(list(settings.scanner))
