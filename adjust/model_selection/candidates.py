"""Models for selection, and comparison of adjusted ones: nested ones by the F-test, any two by Akaike's criterion.

    F = ((v'Pv_s - v'Pv_r) / (u_r - u_s)) / (v'Pv_r / r_r)  ~  F(u_r - u_s, r_r)
    AIC = v'Pv + 2 u                                            for known variances
    AICc = n ln(v'Pv / n) + 2 K + 2 K (K + 1) / (n - K - 1)     K = u + 1, variance factor estimated

n counts the observations with the priors, u the unknowns. Sources: K. R. Koch, Parameter estimation and hypothesis
testing in linear models, 1999, chapter 4.2; K. P. Burnham and D. R. Anderson, Model selection and multimodel inference,
2002, chapter 2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.special import chdtri

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import is_left
from adjust.functional_model.transformation import marks_needed
from adjust.model_selection.scanner_choice import network_with_terms
from adjust.problem.network import Network, Transformation
from adjust.problem.observations import Calibration
from adjust.problem.parameter import Parameter
from adjust.quality.significance import LEVEL, f_probability

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
DECISIVE = 10.0  # difference of AICc above which the worse model has essentially no support (Burnham and Anderson)


@dataclass(frozen=True)
class Model:
    """Model of a network."""

    transformation: Transformation  # of all images that have one
    # family, parameters: distortion family and estimated parameters of every camera
    family: str = "none"
    parameters: tuple[str, ...] = ()
    bends: Bends = ()  # scanner terms

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

    def build_network(self, network: Network, half_mm: Mapping[str, tuple[float, float]]) -> Network:
        """Build the network with this model, its parameters free."""
        cameras = []
        for camera in network.cameras:
            given = camera.distortion
            distortion = replace(
                given,
                family=self.family,
                parameters={name: Prior(0.0, np.inf) for name in self.parameters},
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
    filmed = [i for i, image in enumerate(network.images) if image.transformation != "none"]
    if not filmed:
        return ("none",)
    marks = network.image_numbers[network.observations.has_kind("fiducial")]
    fewest = np.bincount(marks, minlength=len(network.images))[filmed].min()
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


@dataclass(frozen=True)
class CrossValidation:
    """Prediction errors of the rays (image points) of left-out points."""

    rms_um: float  # rms per axis, in the comparator
    # the same in standard deviations of the observations; 1 for a perfect model, apart from the errors of the
    # prediction itself
    sigmas: float
    rays: int  # number of predicted rays


@dataclass(frozen=True)
class Candidate:
    """Adjusted model."""

    model: Model  # the model
    problem: str = ""  # why it has no solution; empty where it has one
    # observations, unknowns, redundancy: counts
    observations: int = 0
    unknowns: int = 0
    redundancy: int = 0
    # vpv, sigma0: of the adjustment
    vpv: float = 0.0
    sigma0: float = 0.0
    cross_validation: CrossValidation | None = None  # prediction errors
    # pairs of highly correlated interior parameters, with their correlation
    correlated: tuple[tuple[str, str, float], ...] = ()
    warnings: tuple[str, ...] = ()  # of the adjustment

    @property
    def aic(self) -> float:
        return self.vpv + 2.0 * self.unknowns

    @property
    def aicc(self) -> float:
        """AICc; inf with too few observations."""
        k, n = self.unknowns + 1, self.observations
        if n - k - 1 <= 0:
            return np.inf
        return float(n * np.log(max(self.vpv, np.finfo(float).tiny) / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1))


@dataclass(frozen=True)
class Nested:
    """F-test of a model against a richer one that contains it."""

    simpler: Model
    richer: Model
    f: float
    degrees: tuple[int, int]
    p: float


def simplest_sufficient(candidates: Sequence[Candidate]) -> Candidate | None:
    """Select the simplest candidate that no richer one improves significantly; None without a solution."""
    chosen = None
    solved = [each for each in candidates if not each.problem]
    for candidate in sorted(solved, key=lambda each: (each.unknowns, each.vpv)):
        if chosen is None or _is_better(candidate, chosen):
            chosen = candidate
    return chosen


def _is_better(richer: Candidate, simpler: Candidate) -> bool:
    """Whether a model is significantly better than one with no more unknowns, and also predicts better."""
    a, b = richer.cross_validation, simpler.cross_validation
    if a is not None and b is not None and a.sigmas >= b.sigmas:
        return False
    if a is None and b is not None:
        return False
    if richer.model.contains(simpler.model):
        return f_test(simpler, richer).p < LEVEL
    return simpler.aicc - richer.aicc > DECISIVE


def f_test(simpler: Candidate, richer: Candidate) -> Nested:
    """Test two nested models by the F-test."""
    more, redundancy = richer.unknowns - simpler.unknowns, richer.redundancy
    variance = richer.vpv / redundancy if redundancy > 0 else 1.0
    f = max(simpler.vpv - richer.vpv, 0.0) / more / variance
    return Nested(simpler.model, richer.model, f, (more, redundancy), f_probability(f, more, redundancy))


def nested_tests(candidates: Sequence[Candidate]) -> tuple[Nested, ...]:
    """Test all neighbouring pairs: one contains the other, with no candidate between them."""
    solved = [each for each in candidates if not each.problem]
    return tuple(
        f_test(simpler, richer)
        for richer, simpler in product(solved, repeat=2)
        if richer.model.contains(simpler.model)
        and richer.unknowns > simpler.unknowns
        and not any(richer.model.contains(each.model) and each.model.contains(simpler.model) for each in solved)
    )


def verdict(given: Model, chosen: Candidate | None) -> str:
    if chosen is None:
        return "No model has a solution."
    text = f"The data ask for {chosen.model.name}."
    if chosen.model == given:
        text += " That is the model as it is given."
    low, high = (float(np.sqrt(chdtri(chosen.redundancy, above) / chosen.redundancy)) for above in (0.995, 0.005))
    if chosen.redundancy > 0 and not low <= chosen.sigma0 <= high:
        text += (
            f" Its sigma0 of {chosen.sigma0:.2f} is not what the given standard deviations allow, {low:.2f} to "
            f"{high:.2f}: they are not right, or no candidate is."
        )
    return text


def reasons(candidates: Sequence[Candidate], chosen: Candidate | None) -> tuple[str, ...]:
    """Explain the rejection of every candidate that differs from the chosen one in one respect only.

    Respects are distortion, transformation and scanner terms.
    """
    if chosen is None:
        return tuple(f"{each.model.name}: {each.problem}" for each in candidates)

    def respects(model: Model) -> tuple[object, ...]:
        return (model.family, model.parameters), model.transformation, model.bends

    own = respects(chosen.model)
    differences = (sum(a != b for a, b in zip(respects(each.model), own, strict=True)) for each in candidates)
    return tuple(_reason(each, chosen) for each, count in zip(candidates, differences, strict=True) if count == 1)


def _reason(other: Candidate, chosen: Candidate) -> str:
    name = other.model.name
    if other.problem:
        return f"{name} cannot be had: {other.problem}"
    predicts = _prediction(other, chosen)
    if chosen.model.contains(other.model):
        test = f_test(other, chosen)
        return f"{name} is too simple: {_f_words(test)}; {predicts}."
    if other.model.contains(chosen.model) and other.unknowns > chosen.unknowns:
        test = f_test(chosen, other)
        needless = "adds nothing that is significant" if test.p >= LEVEL else "fits significantly better"
        return f"{name} {needless}: {_f_words(test)}; {predicts}."
    better = "higher" if other.aicc >= chosen.aicc else "lower"
    size = "richer" if other.unknowns > chosen.unknowns else "no richer"
    return f"{name}, {size}, has an AICc {abs(other.aicc - chosen.aicc):.1f} {better}; {predicts}."


def _f_words(test: Nested) -> str:
    chance = f"p = {test.p:.3f}" if test.p >= 0.001 else "p < 0.001"
    return f"F({test.degrees[0]}, {test.degrees[1]}) = {test.f:.3g}, {chance}"


def _prediction(other: Candidate, chosen: Candidate) -> str:
    a, b = other.cross_validation, chosen.cross_validation
    if a is None or b is None:
        return "it was not cross-validated" if a is None else "the chosen one was not cross-validated"
    return f"it predicts points left out to {a.rms_um:.2f} µm, the chosen one to {b.rms_um:.2f} µm"
