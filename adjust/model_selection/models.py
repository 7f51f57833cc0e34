"""Models for selection: film transformation, estimated distortion parameters and scanner terms."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import is_left
from adjust.functional_model.transformation import marks_needed
from adjust.model_selection.scanner_choice import network_with_terms
from adjust.problem.network import Network, Transformation
from adjust.problem.observations import Calibration
from adjust.problem.parameter import Parameter

# Simpler transformations that each transformation contains, simplest first.
TRANSFORMATIONS: Mapping[Transformation, tuple[Transformation, ...]] = {
    "congruent": (),
    "similarity": ("congruent",),
    "affine": ("congruent", "similarity"),
    "conformal(2)": ("congruent", "similarity"),
    "projective": ("congruent", "similarity", "affine"),
    "bilinear": ("congruent", "similarity", "affine"),
    "polynomial(2)": ("congruent", "similarity", "affine", "conformal(2)", "bilinear"),
}

Bends = tuple[tuple[str, tuple[str, ...]], ...]  # (name, terms) of every scanner with terms

SETS = {"ebner": ("b1", "b2"), "legendre(3)": ("a10", "a01")}  # their parameters of affinity and shear


@dataclass(frozen=True)
class Model:
    """Model of a network.

    Attributes
    ----------
    transformation : of all images that have one.
    family, parameters : distortion family and estimated parameters of every camera.
    bends : scanner terms.
    """

    transformation: Transformation
    family: str = "none"
    parameters: tuple[str, ...] = ()
    bends: Bends = ()

    @property
    def name(self) -> str:
        """Description: "affine, torlegard k3 k5"; the parameters of a set are not listed."""
        lens = "no distortion" if self.family == "none" else self.family
        shown = () if self.family in SETS else self.parameters
        film = () if self.transformation == "none" else (f"{self.transformation},",)
        bends = (f", bend of scanner {scanner}: {' '.join(terms)}" for scanner, terms in self.bends)
        return " ".join((*film, lens, *shown)) + "".join(bends)

    def contains(self, other: "Model") -> bool:
        """Whether the other model is a special case of this one with some parameters 0."""
        films = (self.transformation, *TRANSFORMATIONS.get(self.transformation, ()))
        same = other.family in (self.family, "none") and set(other.parameters) <= set(self.parameters)
        bends = dict(self.bends)
        same = same and all(set(terms) <= set(bends.get(scanner, ())) for scanner, terms in other.bends)
        return other != self and other.transformation in films and same

    def build_network(
        self, network: Network, values: Mapping[Parameter, float], half_mm: Mapping[str, tuple[float, float]]
    ) -> Network:
        """Build the network with this model, its parameters free. values: initial values."""
        cameras = []
        for camera in network.cameras:
            given = camera.distortion
            start = {name: values.get(Parameter.interior(camera.name, name), 0.0) for name in self.parameters}
            distortion = replace(
                given,
                family=self.family,
                parameters={name: Prior(value, np.inf) for name, value in start.items()},
                half_mm=given.half_mm if all(given.half_mm) else half_mm.get(camera.name, given.half_mm),
            )
            cameras.append(replace(camera, distortion=distortion))
        images = tuple(
            image if image.transformation == "none" else replace(image, transformation=self.transformation)
            for image in network.images
        )
        calibrations = tuple(_calibration_without_distortion(each, network) for each in network.calibrations)
        changed = replace(network, cameras=tuple(cameras), images=images, calibrations=calibrations)
        return network_with_terms(changed, dict(self.bends))


def _calibration_without_distortion(calibration: Calibration, network: Network) -> Calibration:
    """Drop the distortion from an earlier calibration, since it differs between candidates."""
    cameras = network.cameras
    distortion = {Parameter.interior(camera.name, name) for camera in cameras for name in camera.distortion.parameters}
    kept = [i for i, parameter in enumerate(calibration.parameters) if parameter not in distortion]
    return Calibration(
        tuple(calibration.parameters[i] for i in kept),
        calibration.values[kept],
        calibration.covariance[np.ix_(kept, kept)],
    )


def given_model(network: Network) -> Model:
    """Model of a network: distortion of the first camera, film transformation of the images, scanner terms."""
    films = [image.transformation for image in network.images if image.transformation != "none"]
    distortion = network.cameras[0].distortion
    estimated = [name for name, prior in distortion.parameters.items() if prior.sigma > 0.0]
    names = tuple(name for name in parameter_names(distortion.family) if name in estimated)
    bends = tuple((scanner.name, tuple(scanner.terms)) for scanner in network.scanners if scanner.terms)
    return Model(films[0] if films else "none", distortion.family if names else "none", names, bends)


def remaining_bends(film: Transformation, bends: Bends) -> Bends:
    """Scanner terms that a film transformation does not absorb."""
    left = ((scanner, tuple(term for term in terms if is_left(film, term))) for scanner, terms in bends)
    return tuple((scanner, terms) for scanner, terms in left if terms)


def transformations(network: Network) -> tuple[Transformation, ...]:
    """Film transformations for which every image has enough fiducial marks; "none" for images without films."""
    filmed = {image.name for image in network.images if image.transformation != "none"}
    if not filmed:
        return ("none",)
    observations = network.observations
    rows = zip(observations.image, observations.kind, strict=True)
    shown = [image for image, kind in rows if kind == "fiducial" and image in filmed]
    fewest = min(shown.count(image) for image in filmed)
    return tuple(kind for kind in TRANSFORMATIONS if marks_needed(kind) <= fewest)


def lenses(network: Network, transformation: Transformation, with_sets: bool) -> tuple[Model, ...]:
    """Candidate lens models: no distortion, the ladder of the camera's family (else Torlegård's), the sets.

    Each rung is also tried with b1 where no film transformation absorbs the scale difference of x and y. The network's
    own model is added if missing. Without object points, a lens cannot be estimated: the only candidate is no
    distortion.
    """
    if len(network.idle_cameras) == len(network.cameras):
        return (Model(transformation),)
    own_family = network.cameras[0].distortion.family
    ladder = own_family if family(own_family).ladder else "torlegard"
    rungs = [tuple(names.split()) for names in family(ladder).ladder]
    has_affinity = "b1" in parameter_names(ladder) and not any("b1" in rung for rung in rungs)  # b1 may be another term
    models = [Model(transformation)]
    for rung in rungs:
        models.append(Model(transformation, ladder, rung))
        if transformation == "none" and has_affinity:
            models.append(Model(transformation, ladder, (*rung, "b1")))
    if with_sets:
        for name, affinity in SETS.items():
            films = (transformation, *TRANSFORMATIONS.get(transformation, ()))
            taken = affinity if "affine" in films else ()  # absorbed by the film transformation
            models.append(Model(transformation, name, tuple(p for p in parameter_names(name) if p not in taken)))
    own = replace(given_model(network), transformation=transformation, bends=())
    return tuple(models if own in models else [*models, own])
