"""What the photographs alone would tell of a camera, where nothing is given of its fiducials and interior orientation.

Then the camera frame itself can shift, turn and grow (Torlegård's singular cases), and what remains is how the
fiducials lie among themselves, and the rest of the camera in their frame.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.parameter import Parameter
from adjust.solution.adjustment import Options
from adjust.solution.planning import plan
from pipeline.design.expected import INTERIOR, Expected
from pipeline.design.setup import planned_network

ROUNDING = 1e-9  # part of the largest motion that is none


def alone(expected: Expected) -> Mapping[Parameter, float]:
    """Standard deviations of the camera's quantities, with F5 to F9 dropped.

    mm, and the parameters' own units; inf: not determined. With N how everything moves in the null directions, and N_f
    its rows of the fiducials: those of d - N N_f^+ d_f (Baarda's S-transformation to inner constraints over the marks).
    """
    network = expected.network
    camera = network.cameras[0]
    without = replace(network, cameras=(_without_priors(camera),))
    options = Options(expected.setup.settings.datum)
    free = plan(without, planned_network(expected.setup)[1], options, expected.plan.sigma0)
    interior = [Parameter.interior(camera.name, name) for name in (*INTERIOR, *expected.family_parameters)]
    marks = [Parameter.fiducial(camera.name, id, axis) for id in camera.fiducials for axis in "xy"]
    moved = free.null[[free.adjustment.index(each) for each in (*interior, *marks)]]
    functions = np.eye(len(interior) + len(marks))
    functions[:, len(interior) :] -= moved @ np.linalg.pinv(moved[len(interior) :], rcond=ROUNDING)
    return dict(zip((*interior, *marks), free.sigmas((*interior, *marks), functions).tolist(), strict=True))


def _without_priors(camera: Camera) -> Camera:
    """What is not fixed is free."""
    fiducials = {id: Fiducial(_freed(mark.x_mm), _freed(mark.y_mm)) for id, mark in camera.fiducials.items()}
    c, x0, y0 = (_freed_if_given(prior) for prior in (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm))
    return replace(camera, principal_distance_mm=c, x0_mm=x0, y0_mm=y0, fiducials=fiducials)


def _freed_if_given(prior: Prior | None) -> Prior | None:
    return None if prior is None else _freed(prior)


def _freed(prior: Prior) -> Prior:
    return prior if prior.sigma == 0.0 else Prior(prior.value, np.inf)
