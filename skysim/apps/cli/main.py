"""The command line: what commands there are, and how whatever goes wrong ends in one line."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

from estimator.core.errors import ImageError
from skysim import __version__
from skysim.apps.cli.commands.files import camera, catalog_app, export, scenes_app
from skysim.apps.cli.commands.lab import lab
from skysim.apps.cli.commands.reproduce import reproduce
from skysim.apps.cli.commands.run import compare, render, run, trackers
from skysim.apps.cli.commands.solve import solve, survey
from skysim.apps.cli.commands.stream import stream
from skysim.apps.cli.commands.study import app as studies
from skysim.apps.cli.commands.validate import validate
from skysim.apps.cli.options import located
from skysim.apps.cli.terminal import complain
from skysim.core import errors
from skysim.core.errors import InputError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
for command in (
    run,
    render,
    stream,
    compare,
    trackers,
    solve,
    survey,
    camera,
    reproduce,
    lab,
    validate,
    export,
):
    app.command()(command)
app.add_typer(scenes_app, name="scenes")
app.add_typer(catalog_app, name="catalog")
app.add_typer(studies, name="study")


def version(asked: bool) -> None:
    """Print what a report of a defect should name."""
    if asked:
        import platform
        from importlib.metadata import version as of

        print(
            f"skysim {__version__}, MuJoCo {of('mujoco')}, numpy {of('numpy')}, Python {platform.python_version()}"
        )
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Print versions.")
    ] = False,
) -> None:
    """A star tracker's laboratory in software: fly, light, photograph, solve, score."""


def main() -> None:
    """Run the command; whatever the user got wrong ends as one line and exit code 2."""
    errors.attended = True
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # whoever ends us, nothing stays half-written
    try:
        code = app(standalone_mode=False)
    except (InputError, ImageError) as error:
        code = complain(located(str(error)))
    except OSError as error:
        code = complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (MemoryError, OverflowError) as error:
        code = complain(f"a value of the scene is too large for this machine: {' '.join(str(error).split())}")
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    except Exception as error:
        # Usage errors: typer's own since it carries its parser within, click's before that.
        if not hasattr(error, "format_message"):
            raise
        code = complain(" ".join(error.format_message().split()) or "give a command; see skysim --help")
    if code == 130:  # typer's own answer to Ctrl-C
        complain("stopped")
    sys.exit(code if isinstance(code, int) else 0)
