"""Command line: parses arguments, returns exit codes, prints one clear message."""

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from adjust.errors import AdjustmentError
from measure.errors import MeasurementError
from pipeline.commands import adjusting, exchanging, measuring
from pipeline.commands.shared import DONE, INTERNAL_ERROR, INTERRUPTED, LOOK, WRONG_INPUT
from pipeline.errors import InputError, what_to_do, what_to_do_about_database
from pipeline.terminal import plain, spell_out_missing_letters
from pipeline.text.files import quote_value

__all__ = ["DONE", "INTERNAL_ERROR", "INTERRUPTED", "LOOK", "WRONG_INPUT", "app", "run"]

LONGEST_LINE = 2000  # characters of a message, which may contain text of any length from a file
GROUPS: dict[str, dict[str, Callable[..., int]]] = {  # by purpose, as listed in the help
    "Measure": {
        "run": measuring.run,
        "measure": measuring.measure,
        "review": measuring.review,
        "report": measuring.report,
    },
    "Calibrate": {
        "calibrate": adjusting.calibrate,
        "adjust": adjusting.adjust,
        "check": adjusting.check,
        "choose": adjusting.choose,
        "compare": adjusting.compare,
    },
    "Archive": {"init": measuring.init, "status": measuring.status, "merge": measuring.merge},
    "Exchange": {
        "export": exchanging.export,
        "import": exchanging.import_,
        "convert": exchanging.convert,
        "resample": exchanging.resample,
        "block": adjusting.block,
    },
    "Plan": {"design": adjusting.design, "render": exchanging.render},
    "Tools": {"demo": measuring.demo, "cameras": measuring.cameras, "template": exchanging.template},
}


class GroupedCommands(TyperGroup):
    """Lists the commands in the help by purpose."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, commands in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(80)) for name in commands])


app = typer.Typer(
    cls=GroupedCommands,
    help="From scanned film photographs to comparator coordinates and a calibrated camera.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for group in GROUPS.values():
    for name, command in group.items():
        app.command(name)(command)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0: done; 1: something needs a look; 2: wrong input; 3: internal error; 130: interrupted (as in shells). arguments:
    default those of the process, without the program's name.
    """
    spell_out_missing_letters()
    try:
        code = app(args=arguments, standalone_mode=False)
        if code == INTERRUPTED:  # typer's code for an interrupt
            message = "interrupted; files that were complete stay as they are, and scans that were measured are kept"
            return _message(message, INTERRUPTED)
        return code if isinstance(code, int) else DONE
    except typer.TyperException as error:
        if isinstance(error, typer.BadParameter):
            error.message = _wrong_value(error)
        message, context = error.format_message(), getattr(error, "ctx", None)
        if message.startswith("Missing") and context is not None and context.parent is not None:
            message += f" `reseau {context.info_name} --help` shows what it takes."
        return _message(message, WRONG_INPUT)
    except (InputError, MeasurementError, AdjustmentError) as error:
        return _message(str(error), WRONG_INPUT)
    except BrokenExecutor:
        return _message(
            "a process was ended from outside, most likely because the memory was full; scans that were measured are "
            "kept. Close other programs, or take fewer --workers, and run it again.",
            WRONG_INPUT,
        )
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _message(f"{place}{error.strerror or error}. {what_to_do(error)}", WRONG_INPUT)
    except Exception as error:
        if next_step := what_to_do_about_database(error):
            return _message(f"the results database cannot be written ({error}). {next_step}", WRONG_INPUT)
        import traceback

        traceback.print_exc()
        return _message("this is a fault of reseau itself; please report it with the lines above", INTERNAL_ERROR)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context, show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Options that go before any command; without one, the help."""
    if show_version:
        from importlib.metadata import version

        import compiled

        loops = "without" if compiled.kernels is None else "with"
        typer.echo(f"reseau {version('reseau')}, {loops} compiled loops")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit


def _wrong_value(error: typer.BadParameter) -> str:
    """What the value of an option or argument must be, in the words of the messages on tables."""
    from pydantic import ValidationError

    if not isinstance(error.__cause__, ValidationError):
        return error.message
    first = error.__cause__.errors(include_url=False)[0]
    kind, limits = first["type"], first.get("ctx", {})
    if kind == "greater_than_equal":
        return f"must be at least {limits['ge']:g}, not {first['input']}."
    if kind == "less_than_equal":
        return f"must be at most {limits['le']:g}, not {first['input']}."
    if kind.startswith(("float", "int")):
        expected = "a number" if kind.startswith("float") else "a whole number"
        return f"must be {expected}, not {quote_value(first['input'])}."
    return first["msg"].removeprefix("Value error, ")


def _message(text: str, code: int) -> int:
    lines = (line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..." for line in plain(text).split("\n"))
    typer.echo("reseau: " + "\n".join(lines), err=True)
    return code
