"""What errors name by key, as a user of the command line typed it: options, and `--set`."""

from __future__ import annotations

from skysim.apps.cli.options import LOADED, TYPED, Loaded
from skysim.core.errors import OVERRIDES, InputError, Where
from skysim.scene.data_sheet.questions import QUESTIONS

OPTIONS = {  # by the key of a function's parameter
    "overrides": "--set",
    "programs": "--program",
    "trackers": "--tracker",
    "engine": "--engine",
    "scheduler": "--scheduler",
    "workers": "--workers",
    "where": "--where",
    "response": "--response",
    "export.formats": "--to",
    "dataset.formats": "--to",
    "dataset.frames": "--frames",
    "dataset.frames_per_shard": "--shard-frames",
    "datasheet.fields": "--fields",
    "datasheet.fmu": "--fmu",
    "survey.tilt_deg": "--tilt",
    "survey.imu_sigma": "--imu-sigma",
    "survey.led_sigma": "--led-sigma",
    "survey.lever_sigma": "--lever-sigma",
    "survey.focal_error": "--focal-error",
    "balance.torque": "--torque",
    "balance.offset_bar": "--offset-bar",
    "balance.inertia_sigma": "--inertia-sigma",
    "balance.offset_sigma": "--offset-sigma",
    "balance.wheel_sigma": "--wheel-sigma",
    "balance.mount_sigma": "--mount-sigma",
    "balance.tacho_sigma": "--tacho-sigma",
    "characterize.darks": "--darks",
    "characterize.flats": "--flats",
    "characterize.night": "--night",
    "solve.fov_deg": "--fov",
    "solve.time_utc": "--time",
    "solve.catalog": "--catalog",
    "solve.detector": "--detector",
    "solve.centroider": "--centroider",
    "solve.identifier": "--identifier",
    "solve.solver": "--solver",
} | {f"answers.{name}": f"--{name.replace('_', '-')}" for name in QUESTIONS}


def as_typed(error: InputError, loaded: Loaded | None = None) -> InputError:
    """The error with the option at fault in place of its key, and the place of a key that was checked after loading.

    loaded : name and overrides of the scene, by default those of the last one
    """
    error = with_place(error, loaded or (LOADED[-1] if LOADED else None))
    if error.where == OVERRIDES:
        typed = TYPED.get(error.key)
        if typed:
            return InputError(typed, error.problem, error.allowed)
        return error.at(Where("--set"))
    return InputError(option_of(error.key), error.problem, error.allowed, error.where)


def with_place(error: InputError, loaded: Loaded | None) -> InputError:
    """The error with file and line, if it is about a key of the loaded scene and has none."""
    if loaded is None:
        return error
    from skysim.scene.loader import located

    return located(error, *loaded)


def option_of(key: str) -> str:
    """The option that gives a parameter, with the name of an item in it: `programs.mine` is `--program mine`."""
    if key in OPTIONS:
        return OPTIONS[key]
    parameter, _, item = key.partition(".")
    return f"{OPTIONS[parameter]} {item}" if item and parameter in OPTIONS else key


def with_location(finding: str, loaded: Loaded | None = None) -> str:
    """A finding, `key: text`, with file and line of the key in a loaded scene, by default the last one."""
    key, _, text = finding.partition(": ")
    return str(as_typed(InputError(key, text), loaded)) if text else finding
