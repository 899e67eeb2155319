"""A camera file from the numbers of a data sheet: what to ask, and what is assumed where the sheet is silent.

Answers are texts as a user types them. The file is a preset (`camera.preset`); each value has a comment: [S1] if the
data sheet states it, otherwise `assumed` with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import yaml

from skysim.core.errors import InputError, printable
from skysim.scene.data_sheet.questions import QUESTIONS, REQUIRED, Values

CURVES = {
    "interline": "interline",
    "frame_transfer": "thick_ccd",
}  # shapes of the quantum efficiency by shutter
PLACEHOLDERS = {
    "pixels": "1000x1000",
    "pitch": "5 um",
}  # to check an answer before these two are given
PLACEHOLDER_LENS = {"focal_length": "1 m", "f_number": 1.0}  # to validate a camera without a lens
SI = {
    "pixel": " m",
    "focal_length": " m",
    "shutter.row_time": " s",
}  # units of the limits in messages
COMMENT_COLUMN = 34


class Line(NamedTuple):
    """One value of the file with its comment."""

    key: str
    value: Any
    comment: str


class Missing(NamedTuple):
    """A number that is not stated: what is assumed (empty: the key is left out), and the consequence."""

    name: str
    assumed: str
    consequence: str


class Sheet(NamedTuple):
    """The values of a camera file, and what the data sheet does not state."""

    lines: list[Line]
    missing: list[Missing]


def fill(answers: Mapping[str, str]) -> Sheet:
    """The camera of some answers, with assumptions for the rest. Raises InputError; its key is `answers.NAME`."""
    values = {name: parsed(name, text) for name, text in answers.items()}
    missing = []
    comments = dict.fromkeys(values, "[S1]")
    for name, question in QUESTIONS.items():
        skipped = question.skipped(values)
        if skipped and name in values:
            raise InputError(f"answers.{name}", f"has no effect {skipped}")
        if skipped or name in values:
            continue
        if name in REQUIRED:
            raise InputError(f"answers.{name}", f"missing; {question.ask}: {question.where}")
        guess = question.assume(values)
        if guess is not None:
            values[name] = guess.value
            comments[name] = f"assumed: {guess.why}"
        text = f"{guess.value} ({guess.why})" if guess else ""
        missing.append(Missing(name, text, question.consequence))
    sheet = Sheet(list(lines_of(values, comments)), missing)
    check(sheet, answers)
    return sheet


def outstanding(answers: Mapping[str, str]) -> dict[str, Missing]:
    """What some answers leave open, by name; pixels and pitch may still be missing. Raises InputError as `fill`."""
    return {one.name: one for one in fill(PLACEHOLDERS | dict(answers)).missing}


def parsed(name: str, text: str) -> Any:
    """The value of an answer. Raises InputError."""
    try:
        return QUESTIONS[name].parse(text)
    except InputError as error:
        raise InputError(f"answers.{name}", quoted(text), error.allowed) from None


def quoted(text: str) -> str:
    """The begin of an answer, for messages."""
    return repr(printable(text)[:40])


def lines_of(values: Values, comments: Mapping[str, str]) -> Iterator[Line]:
    """The lines of the file in the order of the questions, with what is needed and not asked."""
    for name, question in QUESTIONS.items():
        if name not in values:
            continue
        if name == "blur":
            yield Line("psf.kind", "gaussian", "assumed")
        if name == "quantum_efficiency":
            curve = CURVES.get(values["shutter"], "cmos")
            yield Line("detector.quantum_efficiency.curve", curve, "assumed: the shape")
        several = values[name] if len(question.keys) > 1 else (values[name],)
        yield from (
            Line(key, value, comments[name])
            for key, value in zip(question.keys, several, strict=True)
        )
        if name == "dark_current":
            yield Line("detector.dark_temperature_c", 25, "assumed: room temperature")


def tree_of(lines: list[Line]) -> dict[str, Any]:
    """The section `camera` as nested mappings."""
    tree: dict[str, Any] = {}
    for line in lines:
        *parents, last = line.key.split(".")
        section = tree
        for parent in parents:
            section = section.setdefault(parent, {})
        section[last] = line.value
    return tree


def check(sheet: Sheet, answers: Mapping[str, str]) -> None:
    """Validate the camera. Raises InputError of the first wrong answer."""
    from pydantic import ValidationError

    from skysim.core.io.yaml_reader import fault_of, yaml_keys
    from skysim.scene.sections.camera import CameraConfig

    tree = tree_of(sheet.lines)
    try:
        CameraConfig.model_validate(PLACEHOLDER_LENS | tree)
    except ValidationError as error:
        faults: list[InputError] = []
        for one in error.errors():
            fault = fault_of(one, CameraConfig)
            section = ".".join(map(str, yaml_keys(one["loc"], tree, False)))
            faults.append(fault.under(section) if section else fault)
        raise blame(faults, answers) from None


def blame(faults: list[InputError], answers: Mapping[str, str]) -> InputError:
    """The first fault that is of an answer, as an error of that answer; otherwise the first."""
    for name, text in answers.items():
        for fault in faults:
            if fault.key in QUESTIONS[name].keys:
                if fault.allowed:
                    return InputError(
                        f"answers.{name}", quoted(text), fault.allowed + SI.get(fault.key, "")
                    )
                return InputError(f"answers.{name}", f"{quoted(text)}: {fault.problem}")
    return faults[0].under("camera")


def text(sheet: Sheet, name: str) -> str:
    """The file: YAML with a comment at each value."""
    lines = [
        f"# {printable(name)}. Written by `skysim camera new`.",
        "# [S1] the data sheets of camera and lens. A value marked `assumed` is not stated there.",
        *(
            f"# Not stated: {one.name}; {one.consequence}."
            for one in sheet.missing
            if not one.assumed
        ),
        *yaml_lines(sheet.lines),
    ]
    return "\n".join(lines) + "\n"


def yaml_value(value: Any) -> str:
    """A value in one line of YAML; a text with spaces is quoted."""
    if isinstance(value, str):
        return f'"{value}"' if " " in value else value
    return (
        yaml.safe_dump(value, default_flow_style=True, width=math.inf)
        .removesuffix("\n")
        .removesuffix("\n...")
    )


def yaml_lines(camera: list[Line]) -> list[str]:
    """A section `camera` in YAML, with the comment of each value."""
    lines = ["camera:"]
    open_ = list[str]()
    for line in camera:
        *parents, last = line.key.split(".")
        depth = next(
            (n for n, pair in enumerate(zip(open_, parents, strict=False)) if pair[0] != pair[1]),
            len(open_),
        )
        lines += [
            f"{'  ' * (n + 1)}{parents[n]}:" for n in range(min(depth, len(parents)), len(parents))
        ]
        open_ = parents
        written = f"{'  ' * (len(parents) + 1)}{last}: {yaml_value(line.value)}"
        lines.append(f"{written.ljust(COMMENT_COLUMN)} # {line.comment}")
    return lines
