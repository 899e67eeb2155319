"""Command `skysim survey`: plan the survey of a dome, simulate it, or make it from images."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from typer import Option

from skysim.apps.cli.options import (
    Json,
    Out,
    Overrides,
    SceneArg,
    Seed,
    given_options,
    load,
    output_folder,
)
from skysim.apps.cli.terminal import print_json
from skysim.core.errors import InputError

FRAMES = 150
NEXT = 12
CHECKS = 40


FrameCount = Annotated[
    int | None,
    Option(
        min=2,
        help=f"Number of attitudes, with one frame at each; of images with --watch. Default: {FRAMES}.",
    ),
]
Next = Annotated[
    int | None,
    Option("--next", min=1, help=f"Number of attitudes to propose next; default: {NEXT}."),
]
Checks = Annotated[
    int | None,
    Option(
        min=1,
        help=f"Further attitudes at which the tracker is tested before and after; default: {CHECKS}.",
    ),
]


def survey(
    scene: SceneArg,
    frames: FrameCount = None,
    plan: bool = False,
    images: Path | None = None,
    camera: Path | None = None,
    watch: bool = False,
    repeat: Annotated[int | None, Option(min=2)] = None,
    attitudes: Literal["plan", "random"] | None = None,
    next_: Next = None,
    frames_to: Path | None = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    tilt: float = 25.0,
    imu_sigma: str = "0.5 deg",
    led_sigma: str = "2 mm",
    lever_sigma: str = "5 mm",
    focal_error: str = "1%",
    distortion: bool = False,
    checks: Checks = None,
    json: Json = False,
) -> None:
    """Survey a dome from frames at many attitudes: LED positions, lever arm and lens, to a file for `tracker.map`.

    It says which attitudes to hold, what they will reach, which LEDs are measured, and which are dark, displaced or
    exchanged.

    Parameters
    ----------
    plan
        Print the attitudes to hold and the predicted errors; simulate nothing.
    images
        Survey from the images of a folder, with the IMU's attitudes in its attitudes.csv if any.
    camera
        Camera of the images: a scene (file or name), camera file or OpenCV calibration.
    watch
        With --images: follow the folder while the images are taken, and print which LEDs are measured and which
        attitudes to hold next; after the last one, or Ctrl-C, survey.
    repeat
        Simulate so many surveys, and compare their errors with the prediction.
    attitudes
        Attitudes: by the plan (default), or random.
    frames_to
        Write the simulated frames and attitudes to a folder, for --images.
    tilt
        Maximum tilt of the attitudes, degrees.
    imu_sigma
        Standard error of the IMU's attitude about each axis.
    led_sigma
        Standard error of an LED's assumed position along each axis.
    lever_sigma
        Standard error of the camera's assumed position.
    focal_error
        Standard error of the assumed focal length.
    distortion
        Also fit the distortion k1, k2, p1, p2.
    """
    from skysim.apps.cli.commands import survey_modes
    from skysim.experiments.dome_survey.survey_frames import survey_uncertainty

    limited = given_options(
        frames=frames, attitudes=attitudes, next=next_, frames_to=frames_to, checks=checks
    )
    check_mode(plan, images, camera, watch, repeat, limited)
    loaded = load(scene, set_, seed)
    if seed is not None:
        # The list, the lever and the focal length before a survey are drawn by the command, not by the scene.
        loaded = loaded.with_values("tracker.survey", seed=seed)
    request = survey_modes.Request(
        loaded,
        survey_uncertainty(imu_sigma, led_sigma, lever_sigma, focal_error, distortion),
        output_folder(out, loaded.name),
        tilt,
        attitudes or "plan",
        frames or FRAMES,
        next_ or NEXT,
        json,
    )
    if images is not None and camera is not None:
        statistics = survey_modes.from_images(request, images, camera, watch)
    elif plan:
        statistics = survey_modes.plan_only(request)
    elif repeat:
        statistics = survey_modes.repeated(request, repeat)
    else:
        statistics = survey_modes.simulated(request, checks or CHECKS, frames_to)
    if json:
        print_json(statistics)


# Options that have no effect, by mode.
UNUSED = {
    "images": ("frames", "attitudes", "frames_to", "checks"),
    "watch": ("attitudes", "frames_to", "checks"),
    "plan": ("next", "frames_to", "checks"),
    "repeat": ("next", "frames_to", "checks"),
    "simulate": (),
}


def check_mode(
    plan: bool,
    images: Path | None,
    camera: Path | None,
    watch: bool,
    repeat: int | None,
    limited: Collection[str],
) -> None:
    """Raise InputError for options that exclude one another or have no effect.

    Parameters
    ----------
    limited
        Those of `UNUSED` that are given
    """
    modes = [
        name for name, on in (("images", images), ("plan", plan), ("repeat", repeat)) if on
    ]
    if len(modes) > 1:
        raise InputError(f"--{modes[1]}", f"has no effect with --{modes[0]}", "one of them")
    if images is not None and camera is None:
        raise InputError(
            "--images",
            "no camera",
            "with --camera FILE, a scene, camera file or OpenCV calibration",
        )
    if camera is not None and images is None:
        raise InputError(
            "--camera", "has no effect without --images", "the scene's camera is used"
        )
    if watch and images is None:
        raise InputError("--watch", "has no effect without --images", "with --images FOLDER")
    mode = "watch" if watch else modes[0] if modes else "simulate"
    for name in UNUSED[mode]:
        if name in limited:
            option = name.replace("_", "-")
            raise InputError(f"--{option}", f"has no effect with --{mode}", "none")
