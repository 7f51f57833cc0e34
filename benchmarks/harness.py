"""Harness of the benchmarks: options, seeds, stored rows, processes, peak memory, tables and JSON.

A benchmark is a module of this package with a function `case`, which computes the values of one row from its options.
It may define

- `cells(...)`: the rows of the table, as keyword arguments of `case`. Its parameters are command-line options.
  An option of `case` on the command line selects the rows with its value, or makes one row if there is none.
- `COLUMNS`: columns printed for each row as soon as it is computed, as format specifications by key.
- `report(rows)`: lines printed after all rows.
- `SEED`: default seed.
- `OWN_PROCESS = True`: each row is computed in its own process, with one thread. Its CPU time (user and system), s, and
  its peak memory are added to the row.

`seed` is passed to `case` if it has such a parameter.
"""

import argparse
import inspect
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Row = Mapping[str, Any]
ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"  # real scans, not part of the project
HELPERS = tuple(str(ROOT / "tests" / name) for name in ("", "measure", "adjust", "pipeline", "synthetic_images"))
START = "from pipeline.main import main; main()"  # the program, run in its own process
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}


def run(module: ModuleType, arguments: Sequence[str]) -> None:
    """Compute and print the rows of a benchmark.

    Parameters
    ----------
    module : ModuleType
        The benchmark, as described above.
    arguments : Sequence[str]
        Its command line.
    """
    options = _parser(module).parse_args(arguments)
    cells = _chosen(module, vars(options))[: options.cells]
    columns = getattr(module, "COLUMNS", {})
    if columns and not options.json:
        print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns), flush=True)
    rows = []
    for row in _computed(module, cells, options):
        rows.append(row)
        if columns and not options.json:
            print(line(columns, row), flush=True)
    if options.json:
        print(json.dumps(rows[0] if len(rows) == 1 else rows, default=_plain))
    elif hasattr(module, "report"):
        print(*module.report(rows), sep="\n")


def line(columns: Mapping[str, str], row: Row) -> str:
    """Row of a table; missing values are left empty."""
    values = ("" if row.get(name) is None else format(row[name], spec) for name, spec in columns.items())
    return "| " + " | ".join(values) + " |"


def table(columns: Mapping[str, str], rows: Iterable[Row]) -> Iterator[str]:
    """Yield the lines of a table, for `report`."""
    yield "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns)
    yield from (line(columns, row) for row in rows)


# Options


def _parser(module: ModuleType) -> argparse.ArgumentParser:
    name = module.__name__.rpartition(".")[2]
    parser = argparse.ArgumentParser(
        f"python -m benchmarks {name}", description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, help="only the first so many rows")
    parser.add_argument("--seed", type=int, default=getattr(module, "SEED", 1))
    parser.add_argument("--keep", type=Path, help="file of rows: those in it are not computed again")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one line of JSON in place of tables")
    for option, parameter in _own_options(module).items():
        given: dict[str, Any] = {"default": None}
        kind = parameter.annotation
        if isinstance(kind, types.UnionType):  # optional
            kind = next(one for one in typing.get_args(kind) if one is not types.NoneType)
        if kind is bool:
            given["action"] = "store_true"
        elif typing.get_origin(kind) is tuple:
            given |= {"nargs": "*", "type": typing.get_args(kind)[0]}
        else:
            given["type"] = kind
        parser.add_argument(f"--{option.replace('_', '-')}", **given)
    return parser


def _own_options(module: ModuleType) -> dict[str, inspect.Parameter]:
    parameters: dict[str, inspect.Parameter] = {}
    for function in (module.case, getattr(module, "cells", None)):
        if function is not None:
            parameters |= inspect.signature(function, eval_str=True).parameters
    return {name: parameter for name, parameter in parameters.items() if name != "seed"}


def _chosen(module: ModuleType, options: Mapping[str, Any]) -> list[Row]:
    """Rows selected by the options, as keyword arguments of `case`."""
    parameters = inspect.signature(module.case).parameters

    def given(function: Callable[..., Any]) -> dict[str, Any]:
        names = inspect.signature(function).parameters
        return {name: options[name] for name in names if name != "seed" and options.get(name) not in (None, False)}

    make = getattr(module, "cells", None)
    cells = [{}] if make is None else [dict(cell) for cell in make(**given(make))]
    wanted = {name: value for name, value in given(module.case).items() if make is None or name not in given(make)}
    same = [cell for cell in cells if all(cell.get(name, value) == value for name, value in wanted.items())]
    chosen = [cell | wanted for cell in same] or [wanted]
    return [cell | ({"seed": options["seed"]} if "seed" in parameters else {}) for cell in chosen]


# Rows


def _computed(module: ModuleType, cells: Sequence[Row], options: argparse.Namespace) -> Iterator[Row]:
    kept = _read_rows(options.keep)
    keys = [json.dumps(cell, sort_keys=True, default=_plain) for cell in cells]
    missing = [(key, cell) for key, cell in zip(keys, cells, strict=True) if key not in kept]
    new = _rows(module, [cell for _, cell in missing], options.processes)
    for key, cell in zip(keys, cells, strict=True):
        if key not in kept:
            kept[key] = {**cell, **next(new)}
            if options.keep:
                with options.keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([key, kept[key]], default=_plain) + "\n")
        yield kept[key]


def _read_rows(path: Path | None) -> dict[str, Row]:
    lines = path.read_text(encoding="utf-8").splitlines() if path and path.exists() else []
    return dict(json.loads(text) for text in lines)


def _rows(module: ModuleType, cells: Sequence[Row], processes: int) -> Iterator[Row]:
    own_process = getattr(module, "OWN_PROCESS", False)
    if not own_process and processes == 1:
        yield from (module.case(**cell) for cell in cells)
        return
    os.environ.update(ONE_THREAD)
    spawn = multiprocessing.get_context("spawn")  # so that the memory of this process does not count
    per_child = 1 if own_process else None
    with ProcessPoolExecutor(processes, spawn, initializer=_import_helpers, max_tasks_per_child=per_child) as pool:
        yield from pool.map(_timed_row if own_process else _row, [module.__name__] * len(cells), cells)


def _import_helpers() -> None:
    sys.path += [path for path in HELPERS if path not in sys.path]


def _row(module: str, cell: Row) -> Row:
    return dict(import_module(module).case(**cell))


def _timed_row(module: str, cell: Row) -> Row:
    case = import_module(module).case
    start_s, before_s = time.perf_counter(), time.process_time()
    row = case(**cell)
    used = {"seconds": time.perf_counter() - start_s, "cpu_seconds": time.process_time() - before_s}
    return {**used, "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, **row}


def _plain(value: object) -> object:
    """Convert values that JSON does not support."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


# What cases need


@dataclass(frozen=True)
class Command:
    """Finished command: exit code, output, and its time and peak memory, including its child processes."""

    code: int
    out: str
    errors: str
    seconds: float
    cpu_seconds: float
    mib: float

    @property
    def figures(self) -> Row:
        return {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, "mib": self.mib}


def reseau(*arguments: object, before: str = "", environment: Mapping[str, str] | None = None) -> Command:
    """Run one command of the program in its own process.

    Parameters
    ----------
    *arguments : object
        The command and its arguments.
    before : str
        Python statements that the process runs first.
    environment : Mapping[str, str], optional
        Variables in addition to those of this process.

    Raises
    ------
    RuntimeError
        If the exit code is neither 0 nor 1.
    """
    program = f"import sys; sys.path[:0] = {[str(ROOT), *HELPERS]}; {before}\n{START}"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        start_s = time.perf_counter()
        process = subprocess.Popen(command, stdout=out, stderr=errors, env={**os.environ, **(environment or {})})
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - start_s
        texts = []
        for file in (out, errors):
            file.seek(0)
            texts.append(file.read().decode())
    if process.returncode not in (0, 1):
        raise RuntimeError(
            f"reseau {' '.join(map(str, arguments))} ended with {process.returncode}:\n{texts[1][-3000:]}"
        )
    cpu_s = used.ru_utime + used.ru_stime
    return Command(process.returncode, texts[0], texts[1], seconds, cpu_s, used.ru_maxrss / 1024)


@contextmanager
def replaced(where: Any, name: str, value: object) -> Iterator[None]:
    """Replace the value of an attribute within the block, for an ablation."""
    before = getattr(where, name)
    setattr(where, name, value)
    try:
        yield
    finally:
        setattr(where, name, before)


def rms(values: ArrayLike) -> float:
    """Root mean square of the finite values; NaN if there are none."""
    finite = np.asarray(values, float).ravel()
    finite = finite[np.isfinite(finite)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")
