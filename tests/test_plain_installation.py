"""What a user has who installed no extra: every command works or names the extra that it needs."""

import json
import re
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import plain_environment
import pytest

from pipeline.cli import DONE, GROUPS, LOOK, WRONG_INPUT

pytestmark = pytest.mark.skipif(not plain_environment.PYTHON.exists(), reason=plain_environment.REASON)
MODULES_OF_EXTRAS = {"pipeline.review.server": "anyio"}
READS_WRITING = "rapidocr-onnxruntime"  # installed for the files that it carries, without what it asks for


@pytest.fixture(scope="module")
def found_there() -> dict[str, Any]:
    """What `every_command.py` says in the plain environment."""
    with TemporaryDirectory() as folder:
        result = _run("-P", str(Path(__file__).with_name("every_command.py")), folder)
    assert result.returncode == 0, result.stderr
    return dict(json.loads(result.stdout))


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(plain_environment.PYTHON), *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=plain_environment.plain_variables())


def test_every_command_works_or_names_the_extra_that_it_needs(found_there: dict[str, Any]) -> None:
    calls = found_there["calls"]
    assert {call["arguments"][0] for call in calls} == set().union(*GROUPS.values())
    for call in calls:
        result = f"{call['arguments']}: {call['messages']}"
        if call["extra"]:
            assert call["code"] == WRONG_INPUT, result
            assert f"'reseau[{call['extra']}]'" in call["messages"], result
            assert call["messages"].count("reseau: ") == 1, result
        else:
            assert call["code"] in (DONE, LOOK), result


def test_every_command_ends_with_its_next_steps(found_there: dict[str, Any]) -> None:
    """All but those whose output is a file, or files for another program that are described in full."""
    for call in found_there["calls"]:
        name, *others = call["arguments"]
        if call["extra"] or name in ("template", "export") or {"--json", "--frames", "wild-rc10-153"} & {*others}:
            assert not call["steps"]
        else:
            assert 1 <= len(call["steps"]) <= 3, call
        for command in re.findall(r"reseau (\w+)", " ".join(call["steps"])):
            assert command in set().union(*GROUPS.values())


def test_every_module_can_be_imported(found_there: dict[str, Any]) -> None:
    assert found_there["modules"] == MODULES_OF_EXTRAS


def test_the_lock_file_holds_what_the_project_asks_for() -> None:
    """And what each of its packages asks for, in versions that suit."""
    lines = _run("-m", "pip", "check").stdout.splitlines()
    assert [line for line in lines if not line.startswith(f"{READS_WRITING} ")] == []
