"""The numbers of a data sheet: how they are asked, where they are stated, and what is assumed if they are not."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from skysim.scene.data_sheet.answers import (
    bits,
    f_number,
    gain,
    number,
    pixels,
    quantity_text,
    rounded,
    share,
    shutter,
)

Values = Mapping[str, Any]  # parsed answers, by the name of the question

WELL_E_UM2 = 900.0  # full well of a square micrometer: the least of the cameras in data/cameras, that of the IMX264
TRANSFER = "1 us"  # time of a row of a charge-coupled device


class Assumed(NamedTuple):
    """A value that the data sheet does not state, and the reason for it."""

    value: Any
    why: str


class Question(NamedTuple):
    """One number of a data sheet.

    keys        : of the section `camera` that the answer gives
    where       : where a data sheet states it
    parse       : from the typed text to the value of the file, several for several keys; raises InputError
    assume      : from the values known so far to the assumption; None if the key is then left out
    consequence : of not knowing it; empty if it must be given
    skipped     : why it is not asked, by the values known so far; empty if it is
    """

    keys: tuple[str, ...]
    ask: str
    where: str
    parse: Callable[[str], Any]
    assume: Callable[[Values], Assumed | None] = lambda values: None
    consequence: str = ""
    skipped: Callable[[Values], str] = lambda values: ""


def assumed(value: Any, why: str) -> Callable[[Values], Assumed]:
    return lambda values: Assumed(value, why)


def without_lens(values: Values) -> str:
    return "" if "focal_length" in values else "without focal_length"


def not_by_rows(values: Values) -> str:
    return "with a global shutter" if values.get("shutter", "global") == "global" else ""


def row_time(values: Values) -> Assumed:
    """Time from row to row of a shutter that is not global."""
    if values["shutter"] != "rolling":
        return Assumed(TRANSFER, "a fast transfer")
    return Assumed(f"{rounded(1e6 / 30 / values['pixels'][1])} us", "30 frames a second")


def full_well(values: Values) -> Assumed:
    """Electrons, from the range of the converter if the gain is known, otherwise from the area of a pixel."""
    if "gain" in values:
        return Assumed(
            rounded(values["gain"] * range_dn(values)), "where the converter's range ends"
        )
    from skysim.core.units import in_si

    area_um2 = (1e6 * in_si(values["pitch"], "m")) ** 2
    return Assumed(
        rounded(WELL_E_UM2 * area_um2), f"{WELL_E_UM2:g} e- a square micrometer, as in the IMX264"
    )


def gain_of_well(values: Values) -> Assumed:
    """Electrons a digital number that map the full well to the end of the range, rounded up."""
    exact = max(values["full_well"], 1e-3) / range_dn(values)
    step = 10.0 ** (math.floor(math.log10(exact)) - 3)
    return Assumed(rounded(step * math.ceil(exact / step)), "the range ends at the full well")


def range_dn(values: Values) -> float:
    """Digital numbers from the black level to the end of the converter."""
    return max(2 ** values["bits"] - 1 - values["black_level"], 1)


QUESTIONS: dict[str, Question] = {
    "pixels": Question(
        ("width_px", "height_px"),
        "Pixels, width x height",
        "resolution or effective pixels, on the first page",
        pixels,
    ),
    "pitch": Question(
        ("pixel",),
        'Pixel pitch, such as "5.86 um"',
        "pixel size or unit cell size, on the first page",
        quantity_text("m", "length", '"5.86 um"'),
    ),
    "focal_length": Question(
        ("focal_length",),
        'Focal length of the lens, such as "25 mm"',
        "engraved on the lens",
        quantity_text("m", "length", '"25 mm"'),
        consequence="the file has no lens: a scene must give camera.focal_length and camera.f_number",
    ),
    "f_number": Question(
        ("f_number",),
        "F-number at which the lens is used",
        "the aperture ring; the data sheet of the lens states the smallest",
        f_number,
        consequence="a scene must give camera.f_number",
        skipped=without_lens,
    ),
    "transmission": Question(
        ("transmission",),
        "Transmission of the lens, a fraction or %",
        "data sheet of the lens, or (f-number / T-number)²; seldom stated",
        share,
        assumed(0.9, "a coated lens"),
        "the brightness of every light is uncertain by a tenth",
        without_lens,
    ),
    "blur": Question(
        ("psf.sigma_px",),
        "Blur of the lens, standard deviation in pixels",
        "spot diagram or MTF of the lens; seldom stated",
        number("px", "0.7"),
        assumed(0.7, "a sharp lens"),
        "image size and centroid noise are uncertain: measure a point source",
        without_lens,
    ),
    "shutter": Question(
        ("shutter.kind",),
        "Shutter: global, rolling, frame_transfer or interline",
        "shutter type; a CCD is frame_transfer or interline",
        shutter,
        assumed("global", "as machine-vision cameras have"),
        "a rolling shutter would shear the frames of a turning vehicle",
    ),
    "row_time": Question(
        ("shutter.row_time",),
        'Time from one row to the next, such as "15 us"',
        "line time or horizontal period; or 1 / (frame rate x rows)",
        quantity_text("s", "time", '"15 us"'),
        row_time,
        "how much a turning vehicle shears or streaks the frames is uncertain",
        not_by_rows,
    ),
    "quantum_efficiency": Question(
        ("detector.quantum_efficiency.peak",),
        "Peak quantum efficiency, a fraction or %",
        "EMVA 1288 or spectral response, at the highest point",
        share,
        assumed(0.6, "a monochrome CMOS sensor"),
        "the electrons of every light are uncertain by a third",
    ),
    "bits": Question(
        ("detector.bits",),
        "Bits of a pixel in the frames",
        "A/D converter, or pixel format (Mono12: 12)",
        bits,
        assumed(12, "the usual converter"),
        "rounding, and the brightest digital number, are uncertain",
    ),
    "black_level": Question(
        ("detector.offset_dn",),
        "Black level, digital numbers",
        "offset or black level; or the mean of a dark frame",
        number("DN|ADU", "32"),
        lambda values: Assumed(2 ** max(values["bits"] - 7, 0), "1/128 of the range"),
        "digital numbers do not compare with those of a real frame",
    ),
    "full_well": Question(
        ("detector.full_well_e",),
        "Full well, electrons",
        "EMVA 1288: saturation capacity",
        number("e-?|electrons", "10700"),
        full_well,
        "it is unknown which lights saturate: the peak of `skysim check` is a guess",
    ),
    "gain": Question(
        ("detector.gain_e_dn",),
        "Gain, electrons a digital number",
        'EMVA 1288: 1/K; or its inverse with the unit, "0.379 DN/e-"',
        gain,
        gain_of_well,
        "digital numbers do not compare with those of a real frame",
    ),
    "read_noise": Question(
        ("detector.read_noise_e",),
        "Read noise, electrons rms",
        "EMVA 1288: temporal dark noise",
        number("e-?|electrons", "3"),
        assumed(3, "a CMOS sensor of today"),
        "the faintest light that is detected is uncertain",
    ),
    "dark_current": Question(
        ("detector.dark_e_s",),
        "Dark current, electrons a pixel and second",
        "EMVA 1288: dark current",
        number(r"e-?\s*/\s*(?:px\s*/\s*)?s", "5"),
        assumed(5, "a CMOS sensor at room temperature"),
        "it matters for exposures of a second and more",
    ),
    "prnu": Question(
        ("detector.prnu",),
        "Photo-response non-uniformity, a fraction or %",
        "EMVA 1288: PRNU",
        share,
        assumed(0.01, "1 %, the usual size"),
        "centroid noise of bright lights is uncertain",
    ),
}
REQUIRED = tuple(name for name, question in QUESTIONS.items() if question.consequence == "")
