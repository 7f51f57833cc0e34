"""The model chooser against simulated data of known models."""

from dataclasses import replace

import networks as nets
import numpy as np
import pytest

from adjust import Distortion, Options, Prior, adjust, approximate
from adjust.model_selection import model_choice
from adjust.model_selection.scanner_choice import network_with_terms
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Network, Transformation
from adjust.quality.critical_values import WeightFunction

LENSES: dict[str, tuple[str, dict[str, float]]] = {
    "none": ("torlegard", {}),
    "k3": ("torlegard", {"k3": 1.5e-7}),
    "k3 k5": ("torlegard", {"k3": 2e-7, "k5": -2e-11}),
    "k3 p1 p2": ("torlegard", {"k3": 1.5e-7, "p1": 8e-7, "p2": -6e-7}),
    "k3 k5 p1 p2": ("torlegard", {"k3": 2e-7, "k5": -2e-11, "p1": 1.2e-6, "p2": -1e-6}),
    "ebner": ("ebner", {"b3": 0.02, "b4": -0.02, "b7": 0.05, "b8": -0.03, "b10": 0.03, "b11": 0.03}),
}


def make_network(seed: int, lens: str, film: Transformation, points: int = 40) -> Network:
    """Four convergent frames of a field with relief, whose lens and film are known; adjusted without any distortion."""
    rng = np.random.default_rng(seed)
    family, parameters = LENSES[lens]
    truth = nets.Truth(family=family, distortion=parameters)
    kind: Transformation = "none" if film == "none" else "congruent"
    network, _ = nets.simulated(rng, truth, kind, points=nets.field_points(rng, points, relief=300.0))
    return deformed(nets.set_images(nets.set_camera(network, distortion=Distortion()), transformation=film), film)


def deformed(network: Network, film: Transformation) -> Network:
    """Every scan deformed in its own way, by 30 um at 100 mm: in scale, by an affinity and a shear, or by a tilt."""
    xy = network.observations.xy_mm.copy()
    for number, image in enumerate(network.images):
        rows = [row for row, name in enumerate(network.observations.image) if name == image.name]
        sign = 1.0 if number % 2 else -1.0
        matrix = np.eye(2)
        if film in ("similarity", "affine", "projective"):
            matrix = matrix * (1.0 + 3e-4 * sign * (1 + number) / 2)
        if film in ("affine", "projective"):
            matrix = matrix @ np.array([[1.0 + 3e-4 * sign, 2e-4], [0.0, 1.0]])
        xy[rows] = xy[rows] @ matrix.T
        if film == "projective":
            xy[rows] /= 1.0 + xy[rows] @ np.array([[3e-6 * sign], [-2e-6 * number]])
    return nets.set_observations(network, xy_mm=xy)


def chosen(network: Network) -> model_choice.Choice:
    own = adjust(network, approximate(network))
    return model_choice.choose(own, half_mm={"K": (nets.HALF_MM, nets.HALF_MM)})


def test_the_true_lens_is_chosen_and_the_simpler_ones_are_reported_to_be_too_simple() -> None:
    choice = chosen(make_network(2, "k3 k5", "none", points=16))
    assert choice.chosen is not None
    assert choice.chosen.model == model_choice.Model("none", "torlegard", ("k3", "k5"))
    assert choice.verdict.startswith("Selected: torlegard k3 k5.")
    too_simple = {reason.split(" is too simple: ")[0] for reason in choice.reasons if "too simple" in reason}
    assert too_simple == {"no distortion", "torlegard k3"}
    assert {each.model.name for each in choice.candidates} >= {"ebner", "legendre(3)"}


def test_scanner_terms_are_one_model_in_any_order() -> None:
    """Two equal models would be tested against each other with no degree of freedom."""
    network = nets.bent_films([0.0, 90.0, 180.0, 270.0], {}, {})
    models = [
        model_choice.given_model(network_with_terms(network, {"S": terms}))
        for terms in (("b30", "a20"), ("a20", "b30"))
    ]
    assert models[0] == models[1]
    assert models[0].bends == (("S", ("a20", "b30")),)
    assert not models[0].contains(models[1])


def test_a_model_without_redundancy_is_named_without_bounds_of_sigma0() -> None:
    model = model_choice.Model("affine")
    chosen = model_choice.Candidate(model, redundancy=0, sigma0=1.0)
    assert model_choice.verdict(model, chosen) == "Selected: affine, no distortion, the given model."


@pytest.mark.study
@pytest.mark.parametrize("film", ["none", "congruent", "similarity", "affine", "projective"])
@pytest.mark.parametrize("lens", list(LENSES))
def test_the_true_model_is_chosen_and_no_strong_effect_ever_missed(lens: str, film: Transformation) -> None:
    """All effects here are strong: thirty micrometres and more."""
    runs = 12
    true = model_choice.Model(film, *(("none", ()) if lens == "none" else lens_model(lens, film)))
    right = 0
    for seed in range(runs):
        choice = chosen(make_network(seed, lens, film))
        assert choice.chosen is not None
        found = choice.chosen.model
        assert found == true or found.contains(true) or found.family == "legendre(3)", found.name
        right += found == true
    assert right >= runs - 2


def lens_model(lens: str, film: Transformation) -> tuple[str, tuple[str, ...]]:
    if lens != "ebner":
        return "torlegard", tuple(lens.split())
    return "ebner", tuple(f"b{i}" for i in range(3 if film in ("affine", "projective") else 1, 13))


def candidate(parameters: str, vpv: float, sigmas: float | None, family: str = "torlegard") -> model_choice.Candidate:
    names = tuple(parameters.split())
    predicted = None if sigmas is None else model_choice.CrossValidation(4.0 * sigmas, sigmas, 100)
    unknowns = 60 + len(names)
    model = model_choice.Model("affine", family if names else "none", names)
    return model_choice.Candidate(model, "", 360, unknowns, 360 - unknowns, vpv, 1.0, predicted)


def test_a_richer_model_must_fit_significantly_better() -> None:
    """F(1, 298) has its 1 % point at 6.72."""
    simple = candidate("k3", 300.0, 1.0)
    for gain, better in ((6.5, False), (7.0, True)):
        richer = candidate("k3 k5", 300.0 - gain, 0.99)
        test = model_choice.f_test(simple, richer)
        assert test.f == pytest.approx(gain / ((300.0 - gain) / 298))
        assert (test.p < 0.01) is better
        assert model_choice.simplest_sufficient([richer, simple]) is (richer if better else simple)


BROKEN = model_choice.Candidate(model_choice.Model("affine"), "singular. No cause.")
EBNER = " ".join(f"b{i}" for i in range(3, 13))


@pytest.mark.parametrize(
    ("other", "is_better"),
    [
        (candidate("k3 k5", 280.0, 1.01), False),  # a richer model must predict better, too
        (candidate("k3 k5", 280.0, None), False),
        (candidate(EBNER, 280.0, 0.9, "ebner"), False),  # of models that do not contain each other Akaike decides
        (candidate(EBNER, 250.0, 0.9, "ebner"), True),
        (BROKEN, False),
    ],
)
def test_which_of_two_models_is_the_simplest_sufficient(other: model_choice.Candidate, is_better: bool) -> None:
    simple = candidate("k3", 300.0, 1.0)
    assert model_choice.simplest_sufficient([simple, other]) is (other if is_better else simple)
    assert model_choice.simplest_sufficient([BROKEN]) is None


def test_of_films_with_as_many_unknowns_the_one_with_a_cause_is_taken_unless_another_is_decisively_better() -> None:
    for vpv, is_better in ((299.0, False), (285.0, True)):
        projective, bilinear = (
            replace(candidate("k3", vpv, sigmas), model=model_choice.Model(film, "torlegard", ("k3",)))
            for film, vpv, sigmas in (("projective", 300.0, 1.0), ("bilinear", vpv, 0.99))
        )
        chosen = model_choice.simplest_sufficient([bilinear, projective])
        assert chosen is (bilinear if is_better else projective)
        others = model_choice.reasons([projective, bilinear], chosen)[1:]
        assert [("fits about as well" in text, "Projective is what film" in text) for text in others] == [
            (not is_better, not is_better)
        ]


@pytest.mark.parametrize("film", ["projective", "bilinear"])
def test_an_adjustment_with_too_simple_a_film_advises_the_one_that_made_it(film: Transformation) -> None:
    network = nets.set_images(make_network(2, "none", "affine", points=16), transformation="affine")
    xy = network.observations.xy_mm.copy()
    sign = np.where(network.image_numbers % 2, 1.0, -1.0)[:, None]
    bent = 3e-6 * sign * xy[:, :1] * (xy if film == "projective" else xy[:, 1:])
    explanations = adjust(nets.set_observations(network, xy_mm=xy + bent), approximate(network)).explanations
    assert f'transformation = "{film}"' in explanations[0].remedy


def test_reasons_name_the_deciding_criterion() -> None:
    chosen = candidate("k3", 300.0, 1.0)
    others = {
        "is too simple: what it lacks is significant, F(1, 299) = ": candidate("", 320.0, 1.1),
        "is not needed: what it adds is not significant, F(1, 298) = 0.997, p = 0.319": candidate("k3 k5", 299.0, 0.9),
        "predicts points left out no better than the selected one (1.01 and 1": candidate("k3 k5", 280.0, 1.01),
        "but cannot be tested on points left out.": candidate("k3 k5", 280.0, None),
        "with 9 more unknowns, fits worse for its unknowns: its AICc is ": candidate(EBNER, 299.0, 0.9, "ebner"),
        "has no solution: singular. No cause.": replace(BROKEN, model=model_choice.Model("affine", "brown", ("k1",))),
    }
    for words, other in others.items():
        rule, reason = model_choice.reasons([chosen, other], chosen)
        assert rule == model_choice.RULE
        assert words in reason, reason


def test_akaikes_criteria_in_closed_form() -> None:
    """Of 100 observations, 4 unknowns and v'Pv 90: AIC 98, AICc 100 ln 0.9 + 10 + 60 / 94."""
    each = model_choice.Candidate(model_choice.Model("none"), "", 100, 4, 96, 90.0)
    assert each.aic == 98.0
    assert each.aicc == pytest.approx(100 * np.log(0.9) + 10 + 2 * 5 * 6 / 94)


def test_the_ladder_is_of_the_cameras_own_family_and_the_networks_own_model_is_on_it() -> None:
    network = make_network(1, "none", "affine", points=10)
    brown = Distortion("brown", {name: Prior(0.0, np.inf) for name in ("k1", "b1")})
    own = nets.set_camera(network, distortion=brown)
    names = [model.name for model in model_choice.lenses(own, "congruent", with_sets=True)]
    assert names[:3] == ["congruent, no distortion", "congruent, brown k1", "congruent, brown k1 k2"]
    assert names[-3:] == ["congruent, ebner", "congruent, legendre(3)", "congruent, brown k1 b1"]
    with_affinity, without = (model_choice.lenses(own, film, with_sets=True)[-3] for film in ("congruent", "bilinear"))
    assert set(with_affinity.parameters) - set(without.parameters) == {"b1", "b2"}


@pytest.mark.parametrize("family", ["brown", "opencv"])
def test_digital_cameras_may_have_unequal_scales_in_x_and_y(family: str) -> None:
    network = make_network(1, "none", "affine", points=10)
    lens = Distortion(family, {"k1": Prior(0.0, np.inf)})
    digital = nets.set_camera(network, distortion=lens)
    names = [each.name for each in model_choice.lenses(digital, "none", with_sets=False)]
    assert names[:3] == ["no distortion", f"{family} k1", f"{family} k1 b1"]


@pytest.mark.parametrize("robust", ["huber", "igg3"])
def test_all_candidates_get_the_weights_of_the_networks_own_adjustment(robust: WeightFunction) -> None:
    """Held, these weights lead to the very same result."""
    network = make_network(1, "none", "none", points=12)
    spoiled = nets.add_errors(network, {5: np.full(2, 0.06)})
    start = approximate(spoiled)
    own = adjust(spoiled, start, Options(robust=robust, variance_components=True))
    again = adjust(model_choice.weighted_network(own), start)
    assert own.weights[5] < 0.5
    assert len(again.network.observations) == (48 if robust == "huber" else 47)
    assert again.vpv == pytest.approx(own.vpv, rel=1e-6)
    assert again.value("IO.K.c") == pytest.approx(own.value("IO.K.c"), abs=1e-6)


def test_what_is_singular_is_named_and_does_not_stop_the_choice() -> None:
    """A flat field seen vertically by one attitude, nothing known of the interior: c cannot be told."""
    truth = nets.Truth(distortion={}, attitudes=((0.0, 0.0, 0.1),) * 4)
    rng = np.random.default_rng(5)
    points = nets.field_points(rng, 20, relief=0.0)
    network, start = nets.simulated(rng, truth, "none", points=points)
    c, x0, y0 = (Prior(value, np.inf) for value in (153.0, 0.0, 0.0))
    free = nets.set_camera(network, principal_distance_mm=c, x0_mm=x0, y0_mm=y0, distortion=Distortion())
    choice = model_choice.choose(adjust(free, start))
    assert choice.chosen is None
    assert choice.verdict == "No model has a solution."
    assert all("singular" in each.problem for each in choice.candidates)
    assert "c of camera K; Z0 of several images: The principal distance of camera K" in choice.reasons[0]


def test_exact_images_are_predicted_exactly() -> None:
    """Of twelve known points, and of twelve unknown ones, which every second of their rays must locate."""
    points = nets.field_points(np.random.default_rng(3), 24)
    network, start = nets.simulated(np.random.default_rng(1), None, "none", points, noise=False)
    given = nets.free_points(network, [point.id for point in network.points[12:]])
    left_out = model_choice.folds(given, Options())
    assert sorted(point for fold in left_out for point in fold) == sorted(point.id for point in given.points)
    found = model_choice.cross_validate(adjust(given, start), Options())
    assert found is not None
    assert found.rms_um < 1e-3
    assert found.rays == 24 * 4


def test_few_known_points_stay_in_every_fold() -> None:
    network, _ = nets.simulated(np.random.default_rng(1), points=nets.field_points(np.random.default_rng(3), 20))
    left_out = model_choice.folds(nets.free_points(network, [point.id for point in network.points[5:]]), Options())
    assert not {"0", "1", "2", "3", "4"} & {point for fold in left_out for point in fold}


def test_predictions_are_those_of_adjustments_without_the_points() -> None:
    """Of 40 points in 5 folds the camera and stations add little to the noise of 4 um that the images have."""
    network = make_network(4, "k3", "none")
    fitted = model_choice.Model("none", "torlegard", ("k3",)).build_network(network, {})
    result, observed = adjust(fitted, approximate(fitted)), fitted.observations
    errors_mm = []
    for points in model_choice.folds(fitted, Options()):
        left_out = np.isin(observed.point, list(points))
        others = replace(fitted, observations=observed.only(np.flatnonzero(~left_out)))
        again = adjust(others, result.approximations)
        for row in np.flatnonzero(left_out):
            model, xyz = adjusted_image(again, observed.image[row]), fitted.known_places[observed.point[row]]
            errors_mm.append(model.comparator_from_object(xyz[None])[0][0] - observed.xy_mm[row])
    found = model_choice.cross_validate(result, Options())
    assert found is not None
    assert found.rms_um == pytest.approx(1e3 * float(np.sqrt(np.square(errors_mm).mean())), rel=1e-4)
    assert found.rms_um == pytest.approx(4.0 * found.sigmas)
    assert 0.95 < found.sigmas < 1.2
