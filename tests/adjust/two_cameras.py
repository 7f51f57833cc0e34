"""Two film cameras over one field, under any names."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np
from simulated import Truth, field_points, join_observations, simulated

from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Network

Name = Callable[[str], str]


def two_cameras(
    cameras: tuple[str, str], marks: tuple[Name, Name], image: Name, point: Name
) -> tuple[Network, Approximations]:
    """Four images of each; marks: what is made of the first and of the second camera's fiducial ids."""
    rng = np.random.default_rng(17)
    points = field_points(rng, 12)
    both = [
        _named(*simulated(rng, truth, points=points, point_sigma=0.0), name, mark, image, point, number)
        for number, (truth, name, mark) in enumerate(
            zip((Truth(), Truth(c=120.0, x0=-0.2, y0=0.1)), cameras, marks, strict=True)
        )
    ]
    networks, starts = zip(*both, strict=True)
    network = Network(
        tuple(each.cameras[0] for each in networks),
        tuple(chain.from_iterable(each.images for each in networks)),
        networks[0].points,
        join_observations(*(each.observations for each in networks)),
    )
    start = replace(
        starts[0],
        interior={name: value for each in starts for name, value in each.interior.items()},
        exterior={name: value for each in starts for name, value in each.exterior.items()},
        transformation={name: value for each in starts for name, value in each.transformation.items()},
    )
    return network, start


def _named(
    network: Network, start: Approximations, camera: str, mark: Name, image: Name, point: Name, number: int
) -> tuple[Network, Approximations]:
    new = {each.name: image(f"{number}{each.name}") for each in network.images}
    rows = network.observations
    view = (mark(name) if kind == "fiducial" else point(name) for name, kind in zip(rows.point, rows.kind, strict=True))
    return (
        replace(
            network,
            cameras=(_camera(network.cameras[0], camera, mark),),
            images=tuple(replace(each, name=new[each.name], camera=camera) for each in network.images),
            points=tuple(replace(each, id=point(each.id)) for each in network.points),
            observations=replace(rows, image=tuple(new[name] for name in rows.image), point=tuple(view)),
        ),
        replace(
            start,
            interior=dict.fromkeys([camera], start.interior[network.cameras[0].name]),
            exterior={new[name]: value for name, value in start.exterior.items()},
            transformation={new[name]: value for name, value in start.transformation.items()},
            points={point(name): value for name, value in start.points.items()},
        ),
    )


def _camera(camera: Camera, name: str, mark: Name) -> Camera:
    return replace(camera, name=name, fiducials={mark(id): place for id, place in camera.fiducials.items()})
