"""What the files say of an observation's standard deviation, in the network that is adjusted."""

from pathlib import Path

import numpy as np
import pytest
from networks import simulated
from simulated_project import write_project

from pipeline.adjusting.network import build_network
from pipeline.files.project_file import read_project
from pipeline.results.comparator_file import read_comparator


@pytest.mark.parametrize("film_um", [0.0, 7.0])
def test_film_is_added_to_the_covariance_of_every_mark(film_um: float, tmp_path: Path) -> None:
    network, _ = simulated(np.random.default_rng(1))
    path = write_project(network, tmp_path)
    path.write_text(path.read_text(encoding="utf-8") + f"film_sigma_um = {film_um}\n", encoding="utf-8")
    project = read_project(path)
    built, left_out = build_network(project, read_comparator(project.comparator))
    assert not left_out
    expected = network.observations.covariance_mm2 + np.eye(2) * (film_um / 1000) ** 2
    np.testing.assert_allclose(built.observations.covariance_mm2, expected, rtol=1e-9)
