"""A camera file from the numbers of a data sheet, for `skysim camera new`.

`QUESTIONS` are the numbers to ask. `fill` makes the values of the file from the answers, which are texts that a user
types; a number that the data sheet does not state is assumed. The file is a preset (`camera.preset`). Each value has a
comment: [S1] if the data sheet states it, otherwise `assumed` with the reason.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from skysim.core.errors import InputError, printable

# Parsers of the answers, from a typed text to a value of the file. Each raises InputError with the allowed values.


def pixels(text: str) -> tuple[int, int]:
    """Width and height of the detector."""
    match = re.fullmatch(r"(\d{1,6})\s*(?:px)?\s*[x×*,]\s*(\d{1,6})\s*(?:px)?", text.strip())
    if not match:
        raise InputError("", "", "width x height, such as 1936x1216")
    return int(match[1]), int(match[2])


def quantity_text(si_unit: str, what: str, example: str) -> Callable[[str], str]:
    """A parser that checks a quantity with its unit and returns its text."""

    def parse(text: str) -> str:
        from skysim.core.units import quantity

        try:
            quantity(si_unit, what, example)(text)
        except ValueError:
            raise InputError("", "", f"a {what} with its unit, such as {example}") from None
        return " ".join(text.split())

    return parse


def plain(value: float) -> float:
    """The number, without a decimal point if it is whole."""
    return int(value) if value.is_integer() and abs(value) < 1e15 else value


def number(units: str, example: str) -> Callable[[str], float]:
    """A parser of a number with or without its unit; `units` is a pattern of the unit."""

    def parse(text: str) -> float:
        match = re.fullmatch(
            rf"([-+.\de]*?\d\.?)\s*(?:{units})?", text.strip(), re.IGNORECASE
        )
        try:
            value = float(match[1] if match else "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError("", "", f"a number such as {example}")
        return plain(value)

    return parse


def share(text: str) -> float:
    """A fraction, from a fraction or a percentage with its sign."""
    digits, percent, _ = text.partition("%")
    value = number("", '0.65, or "65 %"')(digits)
    return rounded(value / 100, 12) if percent else value


def bits(text: str) -> int:
    """Number of bits of a pixel."""
    value = number("bits?", "12")(text)
    if value not in range(1, 17):
        raise InputError("", "", "1 to 16")
    return int(value)


def f_number(text: str) -> float:
    """F-number, from a number with or without `f/`."""
    return number("", "1.4")(re.sub(r"^\s*f\s*/?\s*", "", text, flags=re.IGNORECASE))


def gain(text: str) -> float:
    """Electrons per digital number; EMVA 1288 states the inverse, in DN/e-."""
    inverse = re.fullmatch(r"(.*?)\s*(?:DN|ADU)\s*/\s*e-?", text.strip(), re.IGNORECASE)
    parse = number(r"e-?\s*/\s*(?:DN|ADU)", '2.64, "2.64 e-/DN" or "0.379 DN/e-"')
    value = parse(inverse[1] if inverse else text)
    return rounded(1 / value, 6) if inverse and value else value


def shutter(text: str) -> str:
    """Kind of the shutter."""
    kinds = ("global", "rolling", "frame_transfer", "interline")
    kind = text.strip().lower().replace(" ", "_").replace("-", "_").removesuffix("_shutter")
    if kind not in kinds:
        raise InputError("", "", ", ".join(kinds))
    return kind


def rounded(value: float, digits: int = 4) -> float:
    """The value rounded to this number of significant digits."""
    return plain(float(f"{value:.{digits}g}"))


# The numbers of a data sheet.

Answers = Mapping[str, str]  # typed texts, by the name of the question
Values = Mapping[str, Any]  # parsed answers, by the name of the question

WELL_E_UM2 = 900.0  # full well per square micrometer of the IMX264, the least of the cameras in data/cameras
TRANSFER = "1 us"  # transfer time of a row of a charge-coupled device


# A value that the data sheet does not state, and the reason for it.
Assumption = tuple[Any, str]


class Question(NamedTuple):
    """One number of a data sheet.

    Attributes
    ----------
    keys
        Keys of the section `camera` that the answer sets
    ask
        Text of the question
    where
        Place in a data sheet that states the number
    parse
        Function from the typed text to the value of the file, several for several keys; raises InputError
    assume
        Function from the values known so far to the assumption; None leaves the key out
    consequence
        Consequence of not knowing it; empty if it must be given
    skipped
        Function from the values known so far to the reason for not asking; empty if it is asked
    """

    keys: tuple[str, ...]
    ask: str
    where: str
    parse: Callable[[str], Any]
    assume: Callable[[Values], Assumption | None] = lambda values: None
    consequence: str = ""
    skipped: Callable[[Values], str] = lambda values: ""


def assumed(value: Any, why: str) -> Callable[[Values], Assumption]:
    """An assumption that does not depend on the other values."""
    return lambda values: (value, why)


def without_lens(values: Values) -> str:
    """The reason for not asking for properties of a lens that is not given."""
    return "" if "focal_length" in values else "without focal_length"


def not_by_rows(values: Values) -> str:
    """The reason for not asking for the row time of a global shutter."""
    return "with a global shutter" if values.get("shutter", "global") == "global" else ""


def row_time(values: Values) -> Assumption:
    """Assumed time from row to row of a shutter that is not global."""
    if values["shutter"] != "rolling":
        return TRANSFER, "a fast transfer"
    return f"{rounded(1e6 / 30 / values['pixels'][1])} us", "30 frames a second"


def full_well(values: Values) -> Assumption:
    """Assumed full well: the converter's range in electrons if the gain is known, otherwise from the pixel's area."""
    if "gain" in values:
        well_e = values["gain"] * range_dn(values)
        return rounded(well_e), "where the converter's range ends"
    from skysim.core.units import in_si

    well_e = WELL_E_UM2 * (1e6 * in_si(values["pitch"], "m")) ** 2
    why = f"{WELL_E_UM2:g} e- a square micrometer, as in the IMX264"
    return rounded(well_e), why


def gain_of_well(values: Values) -> Assumption:
    """Assumed gain, which maps the full well to the end of the range; rounded up to four digits."""
    exact = max(values["full_well"], 1e-3) / range_dn(values)
    step = 10.0 ** (math.floor(math.log10(exact)) - 3)
    return rounded(step * math.ceil(exact / step)), "the range ends at the full well"


def range_dn(values: Values) -> float:
    """Digital numbers from the black level to the end of the converter's range."""
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
        lambda values: (2 ** max(values["bits"] - 7, 0), "1/128 of the range"),
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

# The camera file.

# Curve of the quantum efficiency by shutter.
CURVES = {"interline": "interline", "frame_transfer": "thick_ccd"}
# The two answers that are required, with values with which another is checked before they are given.
PLACEHOLDERS = {"pixels": "1000x1000", "pitch": "5 um"}
PLACEHOLDER_LENS = {
    "focal_length": "1 m",
    "f_number": 1.0,
}  # to validate a camera without a lens
# Units of the limits in messages.
SI = {"pixel": " m", "focal_length": " m", "shutter.row_time": " s"}
COMMENT_COLUMN = 34


class SheetLine(NamedTuple):
    """One value of the file with its comment."""

    key: str
    value: Any
    comment: str


class Missing(NamedTuple):
    """A number that is not stated: the assumption (empty if the key is left out), and the consequence."""

    name: str
    assumed: str
    consequence: str


class Sheet(NamedTuple):
    """The values of a camera file, and the numbers that the data sheet does not state."""

    lines: list[SheetLine]
    missing: list[Missing]


def fill(answers: Answers) -> Sheet:
    """The camera of some answers, with assumptions for the rest. Raises InputError with a key `answers.NAME`."""
    # Questions are in an order in which each assumption only needs earlier values.
    values = {}
    for name, text in answers.items():
        try:
            values[name] = QUESTIONS[name].parse(text)
        except InputError as error:
            raise InputError(f"answers.{name}", quoted(text), error.allowed) from None
    missing = []
    comments = dict.fromkeys(values, "[S1]")
    for name, question in QUESTIONS.items():
        skipped = question.skipped(values)
        if skipped and name in values:
            raise InputError(f"answers.{name}", f"has no effect {skipped}")
        if skipped or name in values:
            continue
        if name in PLACEHOLDERS:
            raise InputError(f"answers.{name}", f"missing; {question.ask}: {question.where}")
        text = ""
        if guess := question.assume(values):
            values[name], why = guess
            comments[name] = f"assumed: {why}"
            text = f"{values[name]} ({why})"
        missing.append(Missing(name, text, question.consequence))
    sheet = Sheet(list(lines_of(values, comments)), missing)
    check(sheet, answers)
    return sheet


def outstanding(answers: Answers) -> dict[str, Missing]:
    """The numbers that are missing in some answers, by name. Raises InputError as `fill`; pixels and pitch may be
    missing.
    """
    return {one.name: one for one in fill(PLACEHOLDERS | dict(answers)).missing}


def quoted(text: str) -> str:
    """The beginning of an answer, for messages."""
    return repr(printable(text)[:40])


def lines_of(values: Values, comments: Mapping[str, str]) -> Iterator[SheetLine]:
    """Yield the values of the file in the order of the questions, with those that are needed and not asked."""
    for name, question in QUESTIONS.items():
        if name not in values:
            continue
        if name == "blur":
            yield SheetLine("psf.kind", "gaussian", "assumed")
        if name == "quantum_efficiency":
            curve = CURVES.get(values["shutter"], "cmos")
            yield SheetLine("detector.quantum_efficiency.curve", curve, "assumed: the shape")
        several = values[name] if len(question.keys) > 1 else (values[name],)
        yield from (
            SheetLine(key, value, comments[name])
            for key, value in zip(question.keys, several, strict=True)
        )
        if name == "dark_current":
            yield SheetLine("detector.dark_temperature_c", 25, "assumed: room temperature")


def check(sheet: Sheet, answers: Answers) -> None:
    """Validate the camera. Raises InputError for the first wrong answer."""
    from pydantic import ValidationError

    from skysim.core.yaml_reader import fault_of, set_key, yaml_keys
    from skysim.scene.sections.camera import CameraConfig

    tree: dict[str, Any] = {}
    for line in sheet.lines:
        set_key(tree, line.key, yaml_value(line.value))
    try:
        CameraConfig.model_validate(PLACEHOLDER_LENS | tree)
    except ValidationError as error:
        faults = []
        for one in error.errors():
            fault = fault_of(one)
            section = ".".join(map(str, yaml_keys(one["loc"], tree, False)))
            faults.append(fault.under(section) if section else fault)
        # The first fault of a key that an answer sets, as an error of the answer; otherwise the first fault.
        for name, text in answers.items():
            for fault in faults:
                if fault.key in QUESTIONS[name].keys:
                    allowed = fault.allowed and fault.allowed + SI.get(fault.key, "")
                    problem = quoted(text) if allowed else f"{quoted(text)}: {fault.problem}"
                    raise InputError(f"answers.{name}", problem, allowed) from None
        raise faults[0].under("camera") from None


def text(sheet: Sheet, name: str) -> str:
    """The text of the file: YAML with a comment at each value."""
    lines = [
        f"# {printable(name)}. Written by `skysim camera new`.",
        "# [S1] the data sheets of camera and lens. A value marked `assumed` is not stated there.",
    ]
    left_out = [one for one in sheet.missing if not one.assumed]
    lines += [f"# Not stated: {one.name}; {one.consequence}." for one in left_out]
    return "\n".join([*lines, *yaml_lines(sheet.lines)]) + "\n"


def yaml_value(value: Any) -> str:
    """A value as one line of YAML; a text with spaces is quoted."""
    if isinstance(value, str):
        return f'"{value}"' if " " in value else value
    from skysim.core.yaml_reader import one_line

    return one_line(value)


def yaml_lines(camera: list[SheetLine]) -> list[str]:
    """The lines of a section `camera` in YAML, with the comment of each value."""
    from skysim.core.yaml_reader import opened_sections

    lines = []
    open_ = list[str]()
    for line in camera:
        *sections, last = f"camera.{line.key}".split(".")
        lines += opened_sections(open_, sections)
        open_ = sections
        written = f"{'  ' * len(sections)}{last}: {yaml_value(line.value)}"
        lines.append(f"{written.ljust(COMMENT_COLUMN)} # {line.comment}")
    return lines
