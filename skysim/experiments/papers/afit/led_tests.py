"""AFIT's LEDs on the test stand: lobe, pulses, thresholds (Padro 2012, section 3.4, Figs 30-46)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.constants import INCH_M
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.afit.test2 import INTENSITY_CD, NOISE_E, ON_FRACTION
from skysim.experiments.papers.afit.test_stand import (
    E_PER_GRAY,
    WHITE,
    build_test_stand,
    gray_levels,
    measure_lights,
    render_at_attitude,
)
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    confidence_interval,
    with_cause,
)
from skysim.experiments.papers.published import published_values
from skysim.experiments.tracker_comparison import with_config
from skysim.results.metrics import Summary, exact, proportion
from skysim.results.plots import INK
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import MoffatPsfConfig
from skysim.scene.sections.layouts import ListedConfig
from skysim.scene.sections.leds import CosineLobeConfig, DirectConfig
from skysim.scene.sections.light import FlatSurfaceConfig
from skysim.simulation.lab import Lab

GrayImage = NDArray[np.uint8]
LEDS = 9
BOARD_DISTANCE_IN = 36.0
DOME_IN = 33.0
CAMERA_IN = 15.0
PITCH_MM = 8.0
# Red, blue and green by three resistors of 1, 5 and 10 kohm; the dimmest is green, the brightest red (Fig. 36).
BOARD = (1.0, 0.2, 0.1, 0.7, 0.14, 0.07, 0.4, 0.08, 0.04)
DIMMEST_LED = 8
BOARD_INTENSITY_CD = 0.05
BOARD_EXPOSURE_S = 20e-3
WIDE_PSF = MoffatPsfConfig(kind="moffat", fwhm_px=2.5, beta=2.0)
# half intensity at 15 deg
NARROW_LOBE = CosineLobeConfig(exponent=20.0)
MISALIGNMENT_DEG = 10.0
# Roll and pitch of the positions of Figs 38 and 40.
VIEW_ANGLES_DEG = ((0.0, 0.0), (1.5, 2.0), (1.5, -2.0), (-1.5, -2.0))
WHITE_CD = LEDS / 2 * INTENSITY_CD  # light as in Test 2, in a ninth of the cycle
WHITE_EXPOSURE_S = 0.1
SLOT_S = 1e-3
PULSES_US = (1000.0, 500.0, 400.0, 200.0, 1.0)
# from an LED's middle; its own radius is 10 px
MIN_AREA_PX = 50
GLARE_RADIUS_PX = 18
DARK_RADIUS_PX = 60
SATURATION_FRACTION = 0.72
CAUSE_SATURATION = "pixels full at 0.72 of the converter's range"
INTERMEDIATE_NOISE_GRAY = 2.5  # between the camera's own and Test 2's; no source states it
CAUSE_NOISE = f"noise of {NOISE_E / E_PER_GRAY:.1f} gray levels, as in Test 2"
CAUSE_LONG_PULSE = f"1 us lasting {1e6 * ON_FRACTION * SLOT_S:.0f} us, as in Test 2"


class LensSettings(NamedTuple):
    """Lens settings of one of Fig. 36's images, and read noise if it differs from the camera's own."""

    f_number: float = 8.0
    focus_in: float = BOARD_DISTANCE_IN
    noise_e: float | None = None


DEFAULT_LENS = LensSettings()


def board_scene(
    levels: Sequence[float], distance_in: float, lens: LensSettings, **led_values: Any
) -> Scene:
    """Scene with a board of nine holes, the first len(levels) with LEDs, above the camera of a level vehicle."""
    height_in = CAMERA_IN + distance_in
    across_mm = PITCH_MM * np.array([1.0, 0.0, -1.0])
    positions = [
        [f"{x} mm", f"{y} mm", f"{height_in} in"] for x in across_mm for y in across_mm
    ]
    leds = {"levels": list(levels), "positions": positions[: len(levels)]}
    listed = ListedConfig.model_validate({"kind": "listed", "cap_deg": 27} | leds)
    scene = load("afit_test1_ideal")
    panel = FlatSurfaceConfig.model_validate({"kind": "flat", "apex": f"{height_in} in"})
    scene = with_config(scene, "light", surface=panel, layout=listed, occlusion=False)
    scene = with_config(scene, "light.led", scatter=0.0, **led_values)
    scene = with_config(
        scene, "camera", f_number=lens.f_number, focus_m=lens.focus_in * INCH_M
    )
    if lens.noise_e is not None:
        scene = with_config(scene, "camera.detector", read_noise_e=lens.noise_e)
    return scene


def color_board(lens: LensSettings = DEFAULT_LENS, **led_values: Any) -> Lab:
    """Test stand with the first board: three colors by three resistors, always on."""
    drive = DirectConfig(kind="direct")
    scene = board_scene(
        BOARD,
        BOARD_DISTANCE_IN,
        lens,
        drive=drive,
        intensity_cd=BOARD_INTENSITY_CD,
        **led_values,
    )
    scene = with_config(scene, "camera", psf=WIDE_PSF)
    return build_test_stand(with_config(scene, "exposure", time_s=BOARD_EXPOSURE_S))


def white_board(pulses_us: Sequence[float], saturation_fraction: float = 1.0) -> Lab:
    """The last board under the dome: white LEDs lit one after another, each for its pulse within its slot.

    Parameters
    ----------
    saturation_fraction
        A pixel saturates at this fraction of the converter's range
    """
    levels = [pulse * 1e-6 / SLOT_S for pulse in pulses_us]
    scene = board_scene(levels, DOME_IN, LensSettings(8.0, DOME_IN), intensity_cd=WHITE_CD)
    scene = with_config(
        scene,
        "camera.detector",
        full_well_e=saturation_fraction * scene.camera.detector.full_well_e,
    )
    return build_test_stand(with_config(scene, "exposure", time_s=WHITE_EXPOSURE_S))


def with_exposure(lab: Lab, time_s: float) -> Lab:
    """The lab with another exposure time."""
    return lab.with_scene(with_config(lab.scene, "exposure", time_s=time_s))


def take_image(
    lab: Lab, rng: np.random.Generator, roll_pitch_deg: tuple[float, float] = (0.0, 0.0)
) -> tuple[GrayImage, Floats]:
    """An image in gray levels, and the (N, 2) true pixels of its LEDs in the order of their numbers."""
    frame, truth = render_at_attitude(
        lab, Rotation.from_euler("xy", roll_pitch_deg, degrees=True), rng
    )
    return gray_levels(frame, lab), truth.sources.xy_px[np.argsort(truth.sources.id)]


class ThresholdCounts(NamedTuple):
    """Pixels above a threshold: (N,) area of each LED's blob, pixels beside the LEDs, and pixels far from all LEDs."""

    area_px: Floats
    glare_px: int
    dark_px: int


def count_above(image: GrayImage, xy_px: Floats, threshold: float) -> ThresholdCounts:
    """Count pixels above a fraction of full scale. Blobs are 8-connected; an LED's blob is the one at its center."""
    above = image > threshold * WHITE
    x0, y0 = np.maximum(np.floor(xy_px.min(axis=0)).astype(int) - DARK_RADIUS_PX, 0)
    x1, y1 = np.ceil(xy_px.max(axis=0)).astype(int) + DARK_RADIUS_PX
    # Label only the neighborhood of the LEDs: noise elsewhere would give many blobs.
    label, _ = scipy.ndimage.label(above[y0:y1, x0:x1], np.ones((3, 3)))
    areas = np.bincount(label.ravel())
    areas[0] = 0
    x, y = np.rint(xy_px).astype(int).T
    # Of each lit pixel from the nearest LED.
    distance_px, _ = cKDTree(xy_px).query(np.argwhere(above)[:, ::-1])
    dark_px = int(np.sum(distance_px > DARK_RADIUS_PX))
    glare_px = int(np.sum(distance_px > GLARE_RADIUS_PX)) - dark_px
    return ThresholdCounts(areas[label[y - y0, x - x0]].astype(float), glare_px, dark_px)


def led_tests(options: ExperimentOptions) -> ExperimentResult:
    """All numbers of section 3.4 that can be simulated."""
    images = options.trials(12, 2)
    rng = [random_stream(options.seed, stage) for stage in range(5)]
    # Light of an LED tilted by 60 deg from the camera relative to one that faces it, in electrons (Fig. 44).
    lobe_60 = led_electrons(60.0, rng[0]) / led_electrons(0.0, rng[0])
    results: Results = {"lobe_60": exact(lobe_60)}
    results |= duty_cycles(rng[1])
    options.watch(1, 4)
    results |= thresholds(images, rng[2])
    options.watch(2, 4)
    results |= apertures(images, rng[3]) | viewing_angles(images, rng[3])
    options.watch(3, 4)
    pulses, magnitude = brightness(images, rng[4])
    rng_drawn = random_stream(options.seed, 5)
    aperture_images = [
        take_image(color_board(lens), rng_drawn)[0] for lens in APERTURES.values()
    ]
    noise_images = [
        take_image(color_board(LensSettings(noise_e=one)), rng_drawn)[0]
        for one in (None, NOISE_E)
    ]
    drawings = (
        FigureDrawing(
            "Fig. 36: our board, focused and wide, less focused and narrow, balanced.",
            lambda fig: draw_apertures(fig, aperture_images),
            (7.4, 2.8),
        ),
        FigureDrawing(
            "Figs 37 and 40: pixels above four thresholds, with the camera's own noise (top) and with that of Test 2.",
            lambda fig: draw_thresholds(fig, noise_images),
            (7.4, 4.0),
        ),
        FigureDrawing(
            "Pulses of five LEDs against their measured magnitude, beside Table 7's.",
            lambda fig: draw_pulses(fig, magnitude),
        ),
    )
    return ExperimentResult(results | pulses, drawings)


def led_electrons(angle_deg: float, rng: np.random.Generator) -> float:
    """Electrons of the board's central LED, tilted away from the camera by angle_deg."""
    lab = white_board([1000.0] * 9)
    direction = Rotation.from_euler("y", angle_deg, degrees=True).apply([0.0, 0.0, -1.0])
    single = lab.camera.sources.take(np.array([4]))
    lab = with_exposure(lab.with_sources(replace(single, normal=direction[None])), 9 * SLOT_S)
    return float(render_at_attitude(lab, Rotation.identity(), rng)[1].sources.electrons[0])


def duty_cycles(rng: np.random.Generator) -> Results:
    """Eq. 37: light of each of nine multiplexed LEDs relative to one that is always on."""
    pulses_us = [1000.0, 500.0, 400.0, 200.0, 1.0, 1000.0, 1000.0, 1000.0, 1000.0]
    lab = with_exposure(white_board(pulses_us), 4 * 9 * SLOT_S)
    always_on = lab.with_sources(
        replace(lab.camera.sources, on_s=lab.camera.sources.period_s)
    )
    electrons = []
    for board in (lab, always_on):
        sources = render_at_attitude(board, Rotation.identity(), rng)[1].sources
        electrons.append(sources.electrons[np.argsort(sources.id)])
    percent = 100 * electrons[0] / electrons[1]
    return {f"duty_{int(pulses_us[n])}": exact(percent[n]) for n in range(5)}


def thresholds(images: int, rng: np.random.Generator) -> Results:
    """Fig. 37: pixels of the first board above thresholds of 2, 10 and 25 %."""
    own_noise, test2_noise = (
        [apply_thresholds(*take_image(lab, rng)) for _ in range(images)]
        for lab in (color_board(), color_board(LensSettings(noise_e=NOISE_E)))
    )

    def both(statistic: Callable[[BoardImage], Any], note: str = "") -> RowResult:
        ours = list(map(statistic, own_noise))
        theirs = list(map(statistic, test2_noise))
        return with_cause(CAUSE_NOISE, confidence_interval, ours, theirs, note=note)

    lens = LensSettings(noise_e=INTERMEDIATE_NOISE_GRAY * E_PER_GRAY)
    dark_px = apply_thresholds(*take_image(color_board(lens), rng)).at_2.dark_px
    return {
        "glare_2": both(lambda image: image.at_2.glare_px),
        "noise_2": both(
            lambda image: image.at_2.dark_px,
            f"{dark_px} with {INTERMEDIATE_NOISE_GRAY} gray levels",
        ),
        "left_10": both(
            lambda image: 100 * (outside_px(image.at_10) / max(outside_px(image.at_2), 1))
        ),
        "found_10": both(lambda image: np.sum(image.at_10.area_px >= MIN_AREA_PX)),
        "fragments_4": both(lambda image: image.lights_4 - len(BOARD)),
        "dimmest_25": both(lambda image: image.at_25.area_px[DIMMEST_LED]),
        "lost_25": both(lambda image: np.sum(image.at_25.area_px < MIN_AREA_PX)),
    }


class BoardImage(NamedTuple):
    """One image at three thresholds, and how many lights the thesis's detector finds in it (at 4 %)."""

    at_2: ThresholdCounts
    at_10: ThresholdCounts
    at_25: ThresholdCounts
    lights_4: int


def apply_thresholds(image: GrayImage, xy_px: Floats) -> BoardImage:
    """Count pixels above 2, 10 and 25 %, and lights above 4 %."""
    at_2, at_10, at_25 = (
        count_above(image, xy_px, fraction) for fraction in (0.02, 0.10, 0.25)
    )
    return BoardImage(at_2, at_10, at_25, len(measure_lights(image).magnitude))


def outside_px(counts: ThresholdCounts) -> int:
    """Number of pixels that belong to no LED."""
    return counts.glare_px + counts.dark_px


def apertures(images: int, rng: np.random.Generator) -> Results:
    """Fig. 36: LEDs found with a wide aperture in focus, a narrow one out of focus, and a balanced one."""
    results: Results = {}
    for name, lens in APERTURES.items():
        lab = color_board(lens)
        taken = [take_image(lab, rng) for _ in range(images)]
        areas_px = np.array([count_above(*one, 0.10).area_px for one in taken])
        found = np.sum(areas_px >= MIN_AREA_PX, axis=1)
        results[f"found_{name}"] = confidence_interval(found)
        if name == "wide":
            full_px = [np.sum(image == WHITE) for image, _ in taken]
            results["full_wide"] = confidence_interval(full_px)
    return results


APERTURES = {
    "wide": LensSettings(4.0),
    "narrow": LensSettings(16.0, 40.0),
    "balanced": LensSettings(8.0, 38.0),
}


def viewing_angles(images: int, rng: np.random.Generator) -> Results:
    """Figs 38 and 40: how much an LED's area varies between positions, for a directional and a diffuse lobe."""
    narrow = color_board(lobe=NARROW_LOBE)
    misalignment = Rotation.from_euler("y", MISALIGNMENT_DEG, degrees=True)
    sources = narrow.camera.sources
    misaligned = narrow.with_sources(
        replace(sources, normal=misalignment.apply(sources.normal))
    )
    directional = [
        area_variation(lab, 0.10, images, rng)[0][:, DIMMEST_LED]
        for lab in (narrow, misaligned)
    ]
    areas, stray = area_variation(color_board(), 0.04, images, rng)
    test2_percent, intermediate_percent = (
        area_variation(color_board(LensSettings(noise_e=noise_e)), 0.04, 1, rng)[1][0]
        for noise_e in (NOISE_E, INTERMEDIATE_NOISE_GRAY * E_PER_GRAY)
    )
    cause = f"LEDs soldered {MISALIGNMENT_DEG:g} deg askew"
    note = f"{test2_percent:.2f} with {CAUSE_NOISE}; {intermediate_percent:.4f} with {INTERMEDIATE_NOISE_GRAY}"
    return {
        "directional": with_cause(cause, confidence_interval, *directional),
        "diffuse": confidence_interval(areas.min(axis=1)),
        "outside_4": RowResult(confidence_interval(stray), note),
    }


def area_variation(
    lab: Lab, threshold: float, images: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """(n, 9) smallest over largest area of each LED over the positions; (n,) percent of pixels outside LEDs."""
    ratio = []
    stray = []
    for _ in range(images):
        taken = [take_image(lab, rng, roll_pitch_deg) for roll_pitch_deg in VIEW_ANGLES_DEG]
        counted = [count_above(image, xy_px, threshold) for image, xy_px in taken]
        area = np.array([counts.area_px for counts in counted])
        largest = np.maximum(area.max(axis=0), 1)
        ratio.append(np.where(area.any(axis=0), area.min(axis=0) / largest, 1.0))
        stray.append(100 * np.mean([outside_px(one) for one in counted]) / taken[0][0].size)
    return np.array(ratio), np.array(stray)


def brightness(images: int, rng: np.random.Generator) -> tuple[Results, Floats]:
    """Figs 43 and 46: magnitude of five LEDs against their pulse, and whether LEDs of 1 us are detected."""
    long_us = 1e6 * ON_FRACTION * SLOT_S
    pulses_us = np.array(PULSES_US[:4])
    lab = white_board(PULSES_US)
    long_pulse = white_board((*PULSES_US[:-1], long_us))
    magnitudes = np.array([led_magnitudes(long_pulse, rng) for _ in range(images)])
    per_us = magnitudes[:, :4] / pulses_us
    saturating = white_board(PULSES_US, SATURATION_FRACTION)
    saturated = np.array([led_magnitudes(saturating, rng)[:4] for _ in range(images)])
    saturating_per_us = saturated / pulses_us
    mean = ", ".join(f"{magnitude:.1f}" for magnitude in magnitudes.mean(axis=0))
    note = f"ours with Test 2's intensity: {mean}; Table 7: {', '.join(map(str, table_7_magnitudes()))}"
    board = (1000.0, 500.0, 1.0) * 3
    detected = [
        [len(measure_lights(take_image(one, rng)[0]).magnitude) for _ in range(images)]
        for one in (
            white_board(board),
            white_board(tuple(max(pulse, long_us) for pulse in board)),
        )
    ]
    short_magnitudes = [led_magnitudes(lab, rng) for _ in range(images)]
    first_to_last = [values[:, 0] / values[:, 3] for values in (per_us, saturating_per_us)]
    return {
        "order": with_cause(
            CAUSE_LONG_PULSE, fraction_in_order, short_magnitudes, magnitudes
        ),
        "linear": RowResult(confidence_interval(per_us[:, 1] / per_us[:, 3]), note),
        "saturating": with_cause(CAUSE_SATURATION, confidence_interval, *first_to_last),
        "found_46": with_cause(CAUSE_LONG_PULSE, confidence_interval, *detected),
    }, magnitudes


def fraction_in_order(images: Sequence[Floats] | Floats) -> Summary:
    """Fraction of images in which all LEDs are detected, with magnitudes in the order of their pulses."""
    magnitude = np.asarray(images)
    in_order = np.all(magnitude > 0, axis=1) & np.all(np.diff(magnitude) < 0, axis=1)
    return proportion(np.sum(in_order), len(in_order))


def table_7_magnitudes() -> list[float]:
    """The magnitudes of Test 3 published for PULSES_US."""
    keys = [f"magnitude_{n}" for n in range(1, len(PULSES_US) + 1)]
    return published_values("afit-table-6-9", *keys).tolist()


def led_magnitudes(lab: Lab, rng: np.random.Generator) -> Floats:
    """(N,) magnitude of each LED; 0 if it is not found."""
    image, xy_px = take_image(lab, rng)
    lights = measure_lights(image)
    distance_px = np.linalg.norm(xy_px[:, None] - lights.xy_px, axis=2)
    return np.where(
        distance_px.min(axis=1) < 10, lights.magnitude[distance_px.argmin(axis=1)], 0.0
    )


def crop_board(image: GrayImage) -> GrayImage:
    """The part of a frame that contains the board."""
    y, x = np.array(image.shape) // 2
    return image[y - 200 : y + 200, x - 200 : x + 200]


def draw_apertures(fig: Any, images: Sequence[GrayImage]) -> None:
    for axes, name, lens, image in zip(
        fig.subplots(1, 3), APERTURES, APERTURES.values(), images, strict=True
    ):
        axes.imshow(crop_board(image), cmap="gray", vmin=0, vmax=WHITE)
        axes.set_title(f"{name}: f/{lens.f_number:g}, {lens.focus_in:g} in")
        axes.set_axis_off()


def draw_thresholds(fig: Any, images: Sequence[GrayImage]) -> None:
    for panels, image, noise in zip(
        fig.subplots(len(images), 4), images, ("own noise", "Test 2's noise"), strict=True
    ):
        panels[0].set_ylabel(noise)
        for axes, threshold in zip(panels, (0.02, 0.04, 0.10, 0.25), strict=True):
            axes.imshow(
                crop_board(image) > threshold * WHITE,
                cmap="Blues",
                vmin=0,
                vmax=1,
                interpolation="nearest",
            )
            axes.set(title=f"{100 * threshold:.0f} %", xticks=[], yticks=[])


def draw_pulses(fig: Any, magnitude: Floats) -> None:
    """Magnitude against pulse, ours scaled so that the 200 us LED has its published magnitude."""
    axes = fig.subplots()
    published = np.array(table_7_magnitudes())
    ours = magnitude * published[3] / magnitude[:, 3].mean()
    style = {"fmt": "s", "color": INK[0], "capsize": 2, "label": f"ours, {CAUSE_LONG_PULSE}"}
    axes.errorbar(PULSES_US, ours.mean(axis=0), ours.std(axis=0), **style)
    axes.plot(PULSES_US, published, "o", color=INK[1], label="published")
    axes.plot([0, 600], [0, 3 * published[3]], "--", color=INK[6], label="proportional")
    axes.set(xlabel="pulse (us)", ylabel="magnitude, 200 us as published")
    axes.legend()
