"""AFIT's LEDs on the test stand: lobe, pulses, thresholds (Padro 2012, section 3.4, Figs 30-46)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats
from skysim.core.units import INCH_M
from skysim.experiments.papers.afit.bench import FULL, GREY_E, changed, furnished, grey, measured, shot
from skysim.experiments.papers.afit.test2 import INTENSITY_CD, NOISE_E, ON_SHARE
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import mean_of
from skysim.experiments.papers.published import experiments
from skysim.results import metrics
from skysim.results.metrics import Summary, exact
from skysim.results.plots import INK
from skysim.scene.camera import MoffatPsfConfig
from skysim.scene.leds import CosineLobeConfig, DirectConfig, ListedConfig
from skysim.scene.light import FlatSurfaceConfig
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.simulation.testbed import Testbed

Grey = NDArray[np.uint8]
LEDS, STAND_IN, DOME_IN, CAMERA_IN, PITCH_MM = 9, 36.0, 33.0, 15.0, 8.0
# Red, blue and green by three resistors of 1, 5 and 10 kohm; the dimmest is green, the brightest red (Fig. 36).
BOARD = (1.0, 0.2, 0.1, 0.7, 0.14, 0.07, 0.4, 0.08, 0.04)
DIMMEST, STAND_CD, STAND_S = 8, 0.05, 20e-3
WINGS = MoffatPsfConfig(kind="moffat", fwhm_px=2.5, beta=2.0)
NARROW, ASKEW_DEG = CosineLobeConfig(exponent=20.0), 10.0  # half intensity at 15 deg
SEEN_DEG = (
    (0.0, 0.0),
    (1.5, 2.0),
    (1.5, -2.0),
    (-1.5, -2.0),
)  # roll and pitch of the positions of Figs 38 and 40
WHITE_CD, WHITE_S, SLOT_S = LEDS / 2 * INTENSITY_CD, 0.1, 1e-3  # light as in Test 2, in a ninth of the cycle
PULSES_US = (1000.0, 500.0, 400.0, 200.0, 1.0)
LEAST_PX, BESIDE_PX, DARK_PX = 50, 18, 60  # from an LED's middle; its own radius is 10 px
WELL, WELL_TOLD = 0.72, "pixels full at 0.72 of the converter's range"
BETWEEN = 2.5  # gray levels of noise, between the camera's own and Test 2's; no source states it
NOISY = f"noise of {NOISE_E / GREY_E:.1f} grey levels, as in Test 2"
LASTING = f"1 us lasting {1e6 * ON_SHARE * SLOT_S:.0f} us, as in Test 2"


class Settings(NamedTuple):
    """Lens settings of one of Fig. 36's images, and read noise if it differs from the camera's own."""

    f_number: float = 8.0
    focus_in: float = STAND_IN
    noise_e: float | None = None


AS_IT_IS = Settings()


def bench(
    levels: Sequence[float], distance_in: float = STAND_IN, settings: Settings = AS_IT_IS, **led: Any
) -> Scene:
    """Scene with a board of nine holes, the first len(levels) with LEDs, above the camera of a level vehicle."""
    height_in, across_mm = CAMERA_IN + distance_in, PITCH_MM * np.array([1.0, 0.0, -1.0])
    holes = [[f"{x} mm", f"{y} mm", f"{height_in} in"] for x in across_mm for y in across_mm]
    listed = ListedConfig.model_validate(
        {"kind": "listed", "cap_deg": 27, "levels": list(levels), "positions": holes[: len(levels)]}
    )
    scene = load("afit_test1")
    flat = FlatSurfaceConfig.model_validate({"kind": "flat", "apex": f"{height_in} in"})
    scene = changed(scene, "light", surface=flat, layout=listed, occlusion=False)
    scene = changed(scene, "light.led", scatter=0.0, **led)
    lens = {"f_number": settings.f_number, "focus_m": settings.focus_in * INCH_M}
    scene = changed(scene, "camera", **lens)
    if settings.noise_e is not None:
        scene = changed(scene, "camera.detector", read_noise_e=settings.noise_e)
    return scene


def stand(settings: Settings = AS_IT_IS, **led: Any) -> Testbed:
    """Test stand with the first board: three colors by three resistors, always on."""
    scene = bench(BOARD, STAND_IN, settings, drive=DirectConfig(kind="direct"), intensity_cd=STAND_CD, **led)
    return furnished(changed(changed(scene, "camera", psf=WINGS), "exposure", time_s=STAND_S))


def white(pulses_us: Sequence[float], well: float = 1.0) -> Testbed:
    """The last board under the dome: white LEDs lit one after another, each for its pulse within its slot.

    well : a pixel saturates at this fraction of the converter's range
    """
    levels = [pulse * 1e-6 / SLOT_S for pulse in pulses_us]
    scene = bench(levels, DOME_IN, Settings(8.0, DOME_IN), intensity_cd=WHITE_CD)
    scene = changed(scene, "camera.detector", full_well_e=well * scene.camera.detector.full_well_e)
    return furnished(changed(scene, "exposure", time_s=WHITE_S))


def exposed(lab: Testbed, time_s: float) -> Testbed:
    return replace(lab, scene=changed(lab.scene, "exposure", time_s=time_s))


def picture(
    lab: Testbed, rng: np.random.Generator, seen_deg: tuple[float, float] = (0.0, 0.0)
) -> tuple[Grey, Floats]:
    """An image in gray levels, and the (N, 2) true pixels of its LEDs in the order of their numbers."""
    frame, truth = shot(lab, Rotation.from_euler("xy", seen_deg, degrees=True), rng)
    return grey(frame, lab), truth.seen.xy_px[np.argsort(truth.seen.id)]


class Passed(NamedTuple):
    """Pixels above a threshold: (N,) area of each LED's blob, pixels beside the LEDs, and pixels far from all LEDs."""

    area_px: Floats
    beside_px: int
    dark_px: int


def passed(image: Grey, xy_px: Floats, share: float) -> Passed:
    """Count pixels above a fraction of full scale. Blobs are 8-connected; an LED's blob is the one at its center."""
    above = image > share * FULL
    x0, y0 = np.maximum(np.floor(xy_px.min(axis=0)).astype(int) - DARK_PX, 0)
    x1, y1 = np.ceil(xy_px.max(axis=0)).astype(int) + DARK_PX
    # Label only the neighborhood of the LEDs: noise elsewhere would give many blobs.
    label, _ = scipy.ndimage.label(above[y0:y1, x0:x1], np.ones((3, 3)))
    areas = np.bincount(label.ravel())
    areas[0] = 0
    x, y = np.rint(xy_px).astype(int).T
    lit_px = np.argwhere(above)[:, ::-1]
    apart_px = np.full(len(lit_px), np.inf)
    for place in xy_px:
        apart_px = np.minimum(apart_px, np.hypot(*(lit_px - place).T))
    dark = apart_px > DARK_PX
    return Passed(
        areas[label[y - y0, x - x0]].astype(float),
        int(np.sum(apart_px > BESIDE_PX) - dark.sum()),
        int(dark.sum()),
    )


def leds(ask: Ask) -> Found:
    """All numbers of section 3.4 that can be simulated."""
    images = ask.trials(12, 2)
    rng = [np.random.default_rng([ask.seed, stage]) for stage in range(5)]
    answers = lobe(rng[0]) | duty(rng[1])
    ask.watch(1, 4)
    answers |= thresholds(images, rng[2])
    ask.watch(2, 4)
    answers |= apertures(images, rng[3]) | viewing(images, rng[3])
    ask.watch(3, 4)
    pulses, magnitude = brightness(images, rng[4])
    return Found(answers | pulses, drawings(magnitude, np.random.default_rng([ask.seed, 5])))


def lobe(rng: np.random.Generator) -> dict[str, Answer]:
    """Relative light of an LED that is turned 60 deg from the camera, in electrons of the frame (Fig. 44)."""
    return {"lobe_60": Answer(exact(turned(60.0, rng) / turned(0.0, rng)))}


def turned(angle_deg: float, rng: np.random.Generator) -> float:
    """Electrons of the board's central LED, turned away from the camera by angle_deg."""
    lab = white([1000.0] * 9)
    normal = Rotation.from_euler("y", angle_deg, degrees=True).apply([0.0, 0.0, -1.0])
    alone = lab.sources.take(np.array([4]))
    lab = exposed(replace(lab, sources=replace(alone, normal=normal[None])), 9 * SLOT_S)
    return float(shot(lab, Rotation.identity(), rng)[1].seen.electrons[0])


def duty(rng: np.random.Generator) -> dict[str, Answer]:
    """Eq. 37: light of each of nine multiplexed LEDs relative to one that is always on."""
    part = [1000.0, 500.0, 400.0, 200.0, 1.0, 1000.0, 1000.0, 1000.0, 1000.0]
    lab = exposed(white(part), 4 * 9 * SLOT_S)
    steady = exposed(replace(lab, sources=replace(lab.sources, on_s=lab.sources.period_s)), 4 * 9 * SLOT_S)
    pulsed_e, steady_e = (
        one.seen.electrons[np.argsort(one.seen.id)]
        for one in (shot(each, Rotation.identity(), rng)[1] for each in (lab, steady))
    )
    share = pulsed_e / steady_e
    return {f"duty_{int(part[n])}": Answer(exact(100 * share[n])) for n in range(5)}


def thresholds(images: int, rng: np.random.Generator) -> dict[str, Answer]:
    """Fig. 37: pixels of the first board above thresholds of 2, 10 and 25 %."""
    calm, wild = (
        [seen_at(*picture(lab, rng)) for _ in range(images)]
        for lab in (stand(), stand(Settings(noise_e=NOISE_E)))
    )

    def both(figure: Callable[[Seen], Any]) -> Answer:
        ours, cause = (mean_of([float(figure(one)) for one in found]) for found in (calm, wild))
        return Answer(ours, cause=Cause(NOISY, cause))

    between = Settings(noise_e=BETWEEN * GREY_E)
    dark = seen_at(*picture(stand(between), rng)).at_2.dark_px
    return {
        "glare_2": both(lambda seen: seen.at_2.beside_px),
        "noise_2": both(lambda seen: seen.at_2.dark_px)._replace(note=f"{dark} with {BETWEEN} grey levels"),
        "left_10": both(lambda seen: 100 * (outside(seen.at_10) / max(outside(seen.at_2), 1))),
        "found_10": both(lambda seen: np.sum(seen.at_10.area_px >= LEAST_PX)),
        "fragments_4": both(lambda seen: seen.lights_4 - len(BOARD)),
        "dimmest_25": both(lambda seen: seen.at_25.area_px[DIMMEST]),
        "lost_25": both(lambda seen: np.sum(seen.at_25.area_px < LEAST_PX)),
    }


class Seen(NamedTuple):
    """One image at three thresholds, and how many lights the thesis's detector finds in it (at 4 %)."""

    at_2: Passed
    at_10: Passed
    at_25: Passed
    lights_4: int


def seen_at(image: Grey, xy_px: Floats) -> Seen:
    at_2, at_10, at_25 = (passed(image, xy_px, share) for share in (0.02, 0.10, 0.25))
    return Seen(at_2, at_10, at_25, len(measured(image).magnitude))


def outside(one: Passed) -> int:
    return one.beside_px + one.dark_px


def apertures(images: int, rng: np.random.Generator) -> dict[str, Answer]:
    """Fig. 36: LEDs found with a wide aperture in focus, a narrow one out of focus, and a balanced one."""
    answers: dict[str, Answer] = {}
    for name, settings in APERTURES.items():
        lab = stand(settings)
        shown = [picture(lab, rng) for _ in range(images)]
        found = [float(np.sum(passed(*one, 0.10).area_px >= LEAST_PX)) for one in shown]
        answers[f"found_{name}"] = Answer(mean_of(found))
        if name == "wide":
            answers["full_wide"] = Answer(mean_of([float(np.sum(image == FULL)) for image, _ in shown]))
    return answers


APERTURES = {
    "wide": Settings(4.0),
    "narrow": Settings(16.0, 40.0),
    "balanced": Settings(8.0, 38.0),
}


def viewing(images: int, rng: np.random.Generator) -> dict[str, Answer]:
    """Figs 38 and 40: how much an LED's area varies between positions, for a directional and a diffuse lobe."""
    narrow = stand(lobe=NARROW)
    turn = Rotation.from_euler("y", ASKEW_DEG, degrees=True)
    askew = replace(narrow, sources=replace(narrow.sources, normal=turn.apply(narrow.sources.normal)))
    directional = [steady(lab, 0.10, images, rng)[0][:, DIMMEST] for lab in (narrow, askew)]
    areas, stray = steady(stand(), 0.04, images, rng)
    noisy, between = (
        steady(stand(Settings(noise_e=noise_e)), 0.04, 1, rng)[1][0]
        for noise_e in (NOISE_E, BETWEEN * GREY_E)
    )
    return {
        "directional": Answer(
            mean_of(directional[0]),
            cause=Cause(f"LEDs soldered {ASKEW_DEG:g} deg askew", mean_of(directional[1])),
        ),
        "diffuse": Answer(mean_of(areas.min(axis=1))),
        "outside_4": Answer(mean_of(stray), f"{noisy:.2f} with {NOISY}; {between:.4f} with {BETWEEN}"),
    }


def steady(lab: Testbed, share: float, images: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """(n, 9) smallest over largest area of each LED over the positions; (n,) percent of pixels outside LEDs."""
    ratio, stray = [], []
    for _ in range(images):
        seen = [
            (image, passed(image, xy_px, share))
            for image, xy_px in (picture(lab, rng, at) for at in SEEN_DEG)
        ]
        area = np.array([one.area_px for _, one in seen])
        ratio.append(np.where(area.any(axis=0), area.min(axis=0) / np.maximum(area.max(axis=0), 1), 1.0))
        stray.append(np.mean([100 * outside(one) / image.size for image, one in seen]))
    return np.array(ratio), np.array(stray)


def brightness(images: int, rng: np.random.Generator) -> tuple[dict[str, Answer], Floats]:
    """Figs 43 and 46: magnitude of five LEDs against their pulse, and whether LEDs of 1 us are detected."""
    lab, lasting = white(PULSES_US), white((*PULSES_US[:-1], 1e6 * ON_SHARE * SLOT_S))
    found = np.array([by_number(lasting, rng) for _ in range(images)])
    per_us = found[:, :4] / np.array(PULSES_US[:4])
    filled = white(PULSES_US, WELL)
    per_us_filled = np.array([by_number(filled, rng)[:4] for _ in range(images)]) / np.array(PULSES_US[:4])
    mean = ", ".join(f"{one:.1f}" for one in found.mean(axis=0))
    at_light = f"at Test 2's light ours are {mean}, Table 7's {', '.join(map(str, table_7()))}"
    board = (1000.0, 500.0, 1.0) * 3
    long = tuple(max(pulse, 1e6 * ON_SHARE * SLOT_S) for pulse in board)
    seen, seen_too = (
        mean_of([len(measured(picture(one, rng)[0]).magnitude) for _ in range(images)])
        for one in (white(board), white(long))
    )
    return {
        "order": Answer(
            ordered([by_number(lab, rng) for _ in range(images)]), cause=Cause(LASTING, ordered(found))
        ),
        "linear": Answer(mean_of(per_us[:, 1] / per_us[:, 3]), at_light),
        "saturating": Answer(
            mean_of(per_us[:, 0] / per_us[:, 3]),
            cause=Cause(WELL_TOLD, mean_of(per_us_filled[:, 0] / per_us_filled[:, 3])),
        ),
        "found_46": Answer(seen, cause=Cause(LASTING, seen_too)),
    }, found


def ordered(images: Sequence[Floats] | Floats) -> Summary:
    """Fraction of images in which all LEDs are detected, with magnitudes in the order of their pulses."""
    magnitude = np.asarray(images)
    return metrics.share(
        np.sum(np.all(magnitude > 0, axis=1) & np.all(np.diff(magnitude) < 0, axis=1)), len(magnitude)
    )


def table_7() -> list[float]:
    """The magnitudes of Test 3 published for PULSES_US."""
    rows = experiments()["afit-table-6-9"].rows
    return [rows[f"magnitude_{n}"].published or 0.0 for n in range(1, len(PULSES_US) + 1)]


def by_number(lab: Testbed, rng: np.random.Generator) -> Floats:
    """(N,) magnitude of each LED; 0 if it is not found."""
    image, xy_px = picture(lab, rng)
    lights = measured(image)
    apart_px = np.linalg.norm(xy_px[:, None] - lights.xy_px, axis=2)
    return np.where(apart_px.min(axis=1) < 10, lights.magnitude[apart_px.argmin(axis=1)], 0.0)


def drawings(magnitude: Floats, rng: np.random.Generator) -> tuple[Drawing, ...]:
    shown = [picture(stand(settings), rng)[0] for settings in APERTURES.values()]
    rows = [picture(stand(Settings(noise_e=noise_e)), rng)[0] for noise_e in (None, NOISE_E)]
    return (
        Drawing(
            "Fig. 36: our board, focused and wide, less focused and narrow, balanced.",
            lambda fig: draw_pictures(fig, shown),
            (7.4, 2.8),
        ),
        Drawing(
            "Figs 37 and 40: pixels above four thresholds, with the camera's own noise (top) and with that of Test 2.",
            lambda fig: draw_thresholds(fig, rows),
            (7.4, 4.0),
        ),
        Drawing(
            "Pulses of five LEDs against their measured magnitude, beside Table 7's.",
            lambda fig: draw_pulses(fig, magnitude),
        ),
    )


def middle(image: Grey) -> Grey:
    """The part of a frame that contains the board."""
    y, x = np.array(image.shape) // 2
    return image[y - 200 : y + 200, x - 200 : x + 200]


def draw_pictures(fig: Any, shown: Sequence[Grey]) -> None:
    for axes, name, settings, image in zip(
        fig.subplots(1, 3), APERTURES, APERTURES.values(), shown, strict=True
    ):
        axes.imshow(middle(image), cmap="gray", vmin=0, vmax=FULL)
        axes.set_title(f"{name}: f/{settings.f_number:g}, {settings.focus_in:g} in")
        axes.set_axis_off()


def draw_thresholds(fig: Any, shown: Sequence[Grey]) -> None:
    for line, image, noise in zip(
        fig.subplots(len(shown), 4), shown, ("own noise", "Test 2's noise"), strict=True
    ):
        line[0].set_ylabel(noise)
        for axes, share in zip(line, (0.02, 0.04, 0.10, 0.25), strict=True):
            axes.imshow(middle(image) > share * FULL, cmap="Blues", vmin=0, vmax=1, interpolation="nearest")
            axes.set(title=f"{100 * share:.0f} %", xticks=[], yticks=[])


def draw_pulses(fig: Any, magnitude: Floats) -> None:
    """Magnitude against pulse, ours scaled so that the 200 us LED has its published magnitude."""
    axes, told = fig.subplots(), np.array(table_7())
    ours = magnitude * told[3] / magnitude[:, 3].mean()
    axes.errorbar(
        PULSES_US,
        ours.mean(axis=0),
        ours.std(axis=0),
        fmt="s",
        color=INK[0],
        capsize=2,
        label=f"ours, {LASTING}",
    )
    axes.plot(PULSES_US, told, "o", color=INK[1], label="published")
    axes.plot([0, 600], [0, 3 * told[3]], "--", color=INK[6], label="proportional")
    axes.set(xlabel="pulse (us)", ylabel="magnitude, 200 us as published")
    axes.legend()
