"""Exterior orientations without known points: a model from the images alone, brought to what coordinates are known."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.sight import Sight
from adjust.initial_values.absolute_orientation import Similarity, absolute_orientation, levelled
from adjust.initial_values.block import Block, extend
from adjust.initial_values.pose import Pose, image_distances
from adjust.initial_values.relative_orientation import relative_poses

FEWEST_SHARED = 8  # common points from which the relative orientation of two images has some redundancy
PAIRS = 3


def orient_free_model(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> dict[str, Pose]:
    """Poses of all images that one model reaches; empty where there is none, or where its datum is lacking.

    known: coordinates (3,) by point, nan where unknown. A pair of images is oriented relatively, all others are
    resected from its points, and so on; of several pairs, and several solutions of each, the model that holds most
    images, and among these the smallest residuals, is taken and oriented absolutely; by heights alone where nothing
    else is known. With no coordinate known at all the model keeps the axes of its first image and a base of 1.
    """
    models = [model for first, second in _pairs(sights) for model in _models(sights, first, second)]
    if not models:
        return {}
    best = min(models, key=lambda model: (-len(model.poses), typical_residual(model)))
    if all(np.isnan(xyz).all() for xyz in known.values()):
        return best.poses
    names = sorted(best.points)
    model, stations = (np.array(each) for each in ([best.points[name] for name in names], _stations(best)))
    xyz = np.array([known[name] for name in names])
    with_height = ~np.isnan(xyz[:, 2])
    if np.isnan(xyz[:, :2]).all() and with_height.sum() > FEWEST_SHARED:
        similarity = levelled(model[with_height], xyz[with_height, 2], stations)
    else:
        similarity = absolute_orientation(model, xyz, stations)
    return (
        {} if similarity is None else {image: _transformed_pose(pose, similarity) for image, pose in best.poses.items()}
    )


def _pairs(sights: Mapping[str, Sight]) -> list[tuple[str, str]]:
    """The pairs with most points in common."""
    shared = {
        pair: len(set(sights[pair[0]].points) & set(sights[pair[1]].points)) for pair in combinations(sorted(sights), 2)
    }
    enough = [pair for pair, count in shared.items() if count >= FEWEST_SHARED]
    return sorted(enough, key=lambda pair: (-shared[pair], pair))[:PAIRS]


def _models(sights: Mapping[str, Sight], first: str, second: str) -> list[Block]:
    """One for each relative orientation of a pair, with all images that can be joined."""
    common = sorted(set(sights[first].points) & set(sights[second].points))
    rays = [_rays(sights[image], common) for image in (first, second)]
    nothing = {name: np.full(3, np.nan) for sight in sights.values() for name in sight.points}
    models = []
    for pose in relative_poses(rays[0], rays[1], np.random.default_rng(0)):
        model = Block(sights, nothing, nothing, {first: Pose(np.eye(3), np.zeros(3)), second: pose})
        extend(model)
        models.append(model)
    return models


def _rays(sight: Sight, points: list[str]) -> Array:
    rows = {name: row for row, name in enumerate(sight.points)}
    return sight.rays[[rows[name] for name in points]]


def _stations(model: Block) -> list[Array]:
    return [model.poses[image].center for image in sorted(model.poses)]


def typical_residual(model: Block) -> float:
    """Median distance in mm of projected from observed points; a point that was not intersected counts as gross."""
    distances = []
    for image, pose in model.poses.items():
        sight = model.sights[image]
        held = [i for i, name in enumerate(sight.points) if name in model.points]
        xyz = np.array([model.points[sight.points[i]] for i in held]).reshape(-1, 3)
        distances.append(image_distances(pose, xyz, sight.xy_mm[held], sight.principal_distance_mm))
        distances.append(np.full(len(sight.points) - len(held), np.inf))
    return float(np.median(np.concatenate(distances)))


def _transformed_pose(pose: Pose, similarity: Similarity) -> Pose:
    return Pose(pose.rotation @ similarity.rotation.T, similarity.apply(pose.center[None])[0])
