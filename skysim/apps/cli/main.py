"""Entry point of the command line: registers the commands and turns user errors into one line on stderr."""

import gc
import os
import sys
from typing import Annotated

import typer

from estimator.core.errors import ImageError
from skysim.apps.cli.commands import (
    measure,
    resources,
    run,
    serve,
    solve,
    study,
    validate,
)
from skysim.apps.cli.examples import add_help
from skysim.apps.cli.options import as_typed
from skysim.apps.cli.terminal import print_error
from skysim.core import __version__, errors
from skysim.core.guarded import GL_OFF

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
# Commands by the job that they do, as `skysim --help` lists them.
JOBS = {
    "Simulate": (resources.new, run.run, run.render, serve.live, serve.gui),
    "Plan": (
        validate.check,
        validate.validate,
        validate.datasheet,
        validate.availability,
    ),
    "Measure": (
        solve.solve,
        solve.survey,
        measure.characterize,
        measure.calibrate,
        measure.balance,
    ),
    "Exchange": (
        resources.export,
        study.dataset,
        run.compare,
        run.trackers,
        resources.reproduce,
    ),
}
for job, commands in JOBS.items():
    for command in commands:
        app.command(rich_help_panel=job)(command)
app.add_typer(resources.scenes_app, name="scenes", rich_help_panel="Simulate")
app.add_typer(study.app, name="study", rich_help_panel="Plan")
app.add_typer(measure.camera_app, name="camera", rich_help_panel="Measure")
app.add_typer(resources.catalog_app, name="catalog", rich_help_panel="Exchange")
add_help(app)


def version(requested: bool) -> None:
    """Print the versions that a bug report should contain."""
    if requested:
        import platform
        from importlib.metadata import version as version_of

        libraries = f"MuJoCo {version_of('mujoco')}, numpy {version_of('numpy')}"
        print(f"skysim {__version__}, {libraries}, Python {platform.python_version()}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=version,
            is_eager=True,
            help="Print the versions to state in a bug report.",
        ),
    ] = False,
) -> None:
    """Simulate a star-tracker laboratory: motion, light sources, camera, attitude determination, scoring."""


def main() -> None:
    """Run the command. A user error prints one line and exits with code 2; Ctrl-C and SIGTERM exit with 130."""
    errors.running_as_command = True
    # Pictures of the lab are drawn by a process of their own.
    os.environ.setdefault("MUJOCO_GL", GL_OFF)
    # Importing creates some hundred thousand objects; their collection takes 5 % of the time of a short command.
    gc.set_threshold(400_000)
    # Clean up after SIGTERM as after Ctrl-C.
    errors.handle_signals()
    try:
        code = app(standalone_mode=False)
    except errors.InputError as error:
        code = print_error(str(as_typed(error)))
    except ImageError as error:
        code = print_error(str(error))
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        code = print_error(f"{place}{errors.reason(error)}")
    except (MemoryError, OverflowError) as error:
        code = print_error(
            f"a value of the scene is too large for this machine: {errors.reason(error)}"
        )
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    except Exception as error:
        # Usage errors: recent typer bundles its parser and raises its own class, older versions raise click's.
        if not hasattr(error, "format_message"):
            raise
        text = " ".join(error.format_message().split()) or "give a command; see skysim --help"
        # Of an unknown command such as `skysim study list`: the group lists its items without a command.
        context = getattr(error, "ctx", None)
        group = getattr(context, "command", None)
        lists = getattr(group, "invoke_without_command", False)
        if context and lists and text.startswith("No such command"):
            names = ", ".join(getattr(group, "commands", {}))
            text += f" Allowed: {names}; `{context.command_path}` alone lists."
        code = print_error(text)
    if code == 130:  # typer's own answer to Ctrl-C
        print_error("stopped")
    gc.freeze()  # collecting them when Python ends takes a quarter
    sys.exit(code if isinstance(code, int) else 0)
