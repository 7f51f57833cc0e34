"""What tests of the pipeline share: three frames of the demonstration, rendered and run once for all, and work without
processes."""

import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from importlib import resources
from pathlib import Path

import cv2
import made_up_calibration
import pytest
from browser import started_browser
from in_process import Here, pools
from playwright.sync_api import Browser
from projects import FEWER_TARGETS, FRAMES, Printed, Refusal, command

from pipeline.cli import DONE, WRONG_INPUT, run
from pipeline.rendered.scene_file import render_project
from pipeline.report import ReportData
from pipeline.workers import worker_pool


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One run of the demonstration serves all: its tests stay with one worker."""
    for item in items:
        if "rendered_demo" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.xdist_group("demonstration"))


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_opencv() -> Iterator[None]:
    """As in the processes that measure scans: its threads wait by spinning, and pytest has the cores at work."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture(autouse=True, scope="session")
def single_process() -> Iterator[None]:
    """Small scans are measured sooner than a new process has loaded its modules. The demonstration starts them."""
    with pools(lambda *_: nullcontext(Here())):
        yield


@pytest.fixture(scope="session")
def rendered_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of the demonstration's first frames, not yet run. Tests copy it before they change anything."""
    scenes = tmp_path_factory.mktemp("scenes")
    for name in ("demo.toml", "metric_camera.toml"):
        text = resources.files("synthetic_images").joinpath("scenes", name).read_text()
        for many, few in FEWER_TARGETS.items():
            text = text.replace(many, few)
        head, *images = text.split("[[image]]")
        (scenes / name).write_text("[[image]]".join([head, *images[:FRAMES]]))
    folder = tmp_path_factory.mktemp("demo")
    render_project(scenes / "demo.toml", folder)
    with (folder / "project.toml").open("a") as project:
        project.write('[measure]\ntone = "linear"\n')
    return folder


@pytest.fixture(scope="session")
def finished(rendered_demo: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The demonstration's project after `reseau run`, and the exit code of that."""
    folder = tmp_path_factory.mktemp("finished") / "demo"
    shutil.copytree(rendered_demo, folder)
    with pools(worker_pool):
        return folder, run(["run", str(folder / "project.toml"), "--workers", "1"])


@pytest.fixture
def project(finished: tuple[Path, int], tmp_path: Path) -> Path:
    """A finished project of its own for a test, to spoil."""
    folder = tmp_path / "project"
    shutil.copytree(finished[0], folder)
    return folder


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Refusal:
    """The message with which a command refuses its input, in one line."""

    def message(*arguments: object) -> str:
        capsys.readouterr()
        assert command(*arguments) == WRONG_INPUT
        return " ".join(capsys.readouterr().err.split())

    return message


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    """What a command prints that ends with a code."""

    def output(*arguments: object, code: int = DONE) -> str:
        capsys.readouterr()
        assert command(*arguments) == code
        return capsys.readouterr().out

    return output


@pytest.fixture
def printed_line(printed: Printed) -> Printed:
    """The same in one line."""
    return lambda *arguments, code=DONE: " ".join(printed(*arguments, code=code).split())


@pytest.fixture
def measured_data() -> ReportData:
    return made_up_calibration.measured_report()


@pytest.fixture
def adjusted_data() -> ReportData:
    return made_up_calibration.adjusted_report()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started_browser() as one:
        yield one
