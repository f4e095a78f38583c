"""The command line: each command parses, calls one function of the library, and prints."""

import errno
import io
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any, TextIO, cast

# One thread is faster for the small arrays of a brain; libraries read this when they are loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import typer
from typer.core import TyperGroup
from typer.main import get_command

from neuroslam import compiled
from neuroslam.cli.batches import (
    experiment_command,
    fleet_command,
    live_command,
    sweep_command,
)
from neuroslam.cli.mapping import (
    demo_command,
    localise_command,
    merge_command,
    resume_command,
    run_command,
)
from neuroslam.cli.options import with_common_options
from neuroslam.cli.output import INTERRUPTED, USER_ERROR, complain, console, say
from neuroslam.cli.results import (
    ask_command,
    evaluate_command,
    export_command,
    inspect_command,
    plan_command,
    plot_command,
    report_command,
    verify_command,
    why_command,
)
from neuroslam.cli.settings import presets_command, tune_command
from neuroslam.errors import NeuroslamError, RenamedKeyWarning, printable, require_utf8
from neuroslam.interrupts import raising_interrupts


class _Commands(TyperGroup):
    """Group of commands whose interruption :func:`main` reports; typer reports none."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - a type that typer keeps to itself
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None


_WIDEST_HELP = 1000
"""Columns; help is as wide as the terminal, and not at most 80 columns."""

app = typer.Typer(
    cls=_Commands,
    help="Brain-inspired SLAM: from a video to a map.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"max_content_width": _WIDEST_HELP},
)


def _print_version(requested: bool) -> None:
    if requested:
        say(f"neuroslam {version('neuroslam')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of no particular command."""


_COMMANDS: dict[str, Callable[..., int]] = {
    "run": run_command,
    "resume": resume_command,
    "localise": localise_command,
    "why": why_command,
    "merge": merge_command,
    "tune": tune_command,
    "sweep": sweep_command,
    "fleet": fleet_command,
    "live": live_command,
    "inspect": inspect_command,
    "ask": ask_command,
    "verify": verify_command,
    "export": export_command,
    "demo": demo_command,
    "evaluate": evaluate_command,
    "plan": plan_command,
    "plot": plot_command,
    "report": report_command,
    "presets": presets_command,
    "experiment": experiment_command,
}
"""In the order in which ``--help`` lists them."""

for _name, _command in _COMMANDS.items():
    # A position such as -1,2 is no option.
    negative = {"ignore_unknown_options": _name == "plan"}
    app.command(_name, context_settings=negative)(
        with_common_options(_command, _name, heavy=_name != "presets")
    )


@cache
def _parser() -> Any:  # noqa: ANN401 - a type that typer keeps to itself
    """Return the parser of all commands, made once in a process: 25 ms."""
    return get_command(app)


@contextmanager
def _quiet_writers() -> Iterator[None]:
    """Print no disk error of a thread: the writer of TensorBoard raises it again in ours."""
    before = threading.excepthook

    def hook(what: threading.ExceptHookArgs) -> None:
        if not isinstance(what.exc_value, OSError):
            before(what)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def _warnings_in_one_line(command: str) -> Iterator[None]:
    """Print each warning about a renamed key once, in one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", RenamedKeyWarning)
        python = warnings.showwarning
        printed: set[str] = set()

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, RenamedKeyWarning):
                python(message, category, filename, lineno, file, line)
            elif str(message) not in printed:
                printed.add(str(message))
                complain(command, f"note: {message}")

        warnings.showwarning = show
        yield


def _mistake(error: BaseException) -> str:
    """Return the line for an error of memory or of a name that the system refuses; else empty."""
    if _out_of_memory(error):
        return "out of memory; free some, or use a smaller source or config"
    if isinstance(error, OSError) and error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
        return f"{str(error.filename)[:100]}: {error.strerror}; choose another name"
    if isinstance(error, OSError) and error.filename is None:  # of no file: standard output
        if error.errno in (errno.ENOSPC, errno.EBADF):
            return f"what it prints cannot be written ({error.strerror})"
        if isinstance(error, FileNotFoundError):
            return "the current folder was removed; change to another"
    if str(error).startswith("Symlink loop"):  # what pathlib makes of ELOOP
        return f"{error}; choose another name"
    return ""


def _out_of_memory(error: BaseException) -> bool:
    """Return whether torch, OpenCV or Python were refused memory."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or any(
        sign in text for sign in ("allocate memory", "not enough memory", "insufficient memory")
    )


@contextmanager
def _replacing_letters() -> Iterator[None]:
    """Print "?" for letters that the terminal does not have."""
    out = sys.stdout
    if not isinstance(out, io.TextIOWrapper) or out.errors != "strict":
        yield
        return
    out.reconfigure(errors="replace")
    try:
        yield
    finally:
        out.reconfigure(errors="strict")


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 is success, 2 an error that the user can fix, 130 an interruption."""
    arguments: list[Any] = sys.argv[1:] if argv is None else argv
    command = arguments[0] if arguments else ""
    try:
        if console.is_terminal:
            compiled.announce = lambda: say("compiling, once on this machine: up to half a minute")
        for argument in map(str, arguments):
            require_utf8(argument, NeuroslamError)
        with (
            _replacing_letters(),
            _quiet_writers(),
            _warnings_in_one_line(command),
            raising_interrupts(),
        ):
            parse = _parser()
            return parse(args=arguments, prog_name="neuroslam", standalone_mode=False) or 0
    except typer.Abort:
        complain(command, "interrupted")
        return INTERRUPTED
    except typer.TyperException as error:
        shown = cast(Any, error)  # what typer raises has these, though its public base has not
        if not str(shown.message).startswith("Usage"):  # help, which has lines
            shown.message = printable(str(shown.message))
        shown.show()
        return USER_ERROR
    except NeuroslamError as error:
        complain(command, str(error))
        return USER_ERROR
    except RecursionError:
        complain(command, "a file or a value is nested too deeply; expected a few levels")
        return USER_ERROR
    except Exception as error:
        mistake = _mistake(error)
        if not mistake:
            raise
        complain(command, mistake)
        return USER_ERROR
