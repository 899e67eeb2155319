"""Values with units, read from YAML; the base class of every section of a file.

Two rules name every key. A key whose value has a unit has none in its name (`focal_length: "35 mm"`). A key whose value
is a bare number ends in its unit (`tilt_stop_deg: 30`). In Python the former has an SI suffix
(`camera.focal_length_m`), so every name shows its unit.

Sizes of errors as in data sheets: the standard deviation of a Gaussian, or a tolerance.

A key of a scene that is the size of an error takes a quantity, which is the standard deviation of a Gaussian, or a
section with a tolerance, which no error exceeds:

    led_sigma: "0.2 mm"
    led_sigma: {tolerance: "±0.5 mm"}
    led_sigma: {tolerance: "±0.5 mm", distribution: truncated_normal, sigma: "0.2 mm"}

In Python the value is the equivalent standard deviation, a float, for covariances. A tolerance is a `Tolerance`, a
float that also has its distribution. `scaled_errors` draws from either.
"""

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from skysim.core.constants import INCH_M
from skysim.core.errors import InputError, errors_under, refusing
from skysim.core.types import Floats, frozen
from skysim.core.yaml_reader import suggestion

MAX_CHARACTERS = 80  # of a quantity
QUANTITY_PATTERN = (
    r"^\s*[-+.]?\d.*[a-zA-Z]"  # pattern of a quantity in the JSON schema, for editors
)

# Suffixes of fields that `quantity` parses, which the YAML keys do not have. `dark_e_s` and `rate_deg_s` are bare
# numbers and keep their suffixes.
SI_SUFFIX = re.compile(
    r"(?<!_deg)(?<!_rad)(?<!_e)(?<!^e)(?<!_cm2)(?<!_um)_(m_s|m|s|n|kg|kg_m|kg_m2|cd|w_sr|nm|ns|nm_rad|nms|nms2)$"
)

# The SI unit of each suffix, in the form that the loader accepts.
SI_UNITS = {
    "m": "m",
    "m_s": "m/s",
    "s": "s",
    "n": "N",
    "kg": "kg",
    "kg_m": "kg m",
    "kg_m2": "kg m2",
    "cd": "cd",
    "w_sr": "W/sr",
    "nm": "N m",
    "ns": "N s",
    "nm_rad": "N m/rad",
    "nms": "N m s",
    "nms2": "N m s2",
}


def si_unit(name: str) -> str:
    """The SI unit of a model field, from the suffix of its name; empty for a bare number."""
    match = SI_SUFFIX.search(name)
    return SI_UNITS.get(match[1], "") if match else ""


def quantity(
    si_unit: str, what: str, examples: str, most: float = math.inf
) -> Callable[[Any], float]:
    """A validator that converts a quantity such as "48 in" to a float in `si_unit`. It raises InputError.

    0 needs no unit, as it is the same in all. `most` is the greatest size that physics allows, in SI.
    """

    def parse(value: Any) -> float:
        """The quantity in SI units."""
        if value in (0, "0") and not isinstance(value, bool):
            return 0.0
        if not isinstance(value, str):
            raise InputError("", f"{value!r} has no unit", f"a {what} such as {examples}")
        try:
            number = in_si(value, si_unit)
        except InputError as error:
            raise InputError(
                "", f"{value!r} is not a {what}", f"a {what} such as {examples}"
            ) from error
        if abs(number) > most:
            raise InputError("", repr(value), f"a {what} up to {most:g} {si_unit}")
        return number

    return parse


def with_unit(si_unit: str, what: str, examples: str, most: float = 1e6) -> BeforeValidator:
    """`quantity` as the validator of a key; the JSON schema declares the value as a string."""
    schema = Field(description=f"a {what} such as {examples}", pattern=QUANTITY_PATTERN)
    return BeforeValidator(
        quantity(si_unit, what, examples, most), json_schema_input_type=Annotated[str, schema]
    )


# Factors of common units, equal to those of astropy to the bit, because astropy takes 0.2 s to import.
COMMON_UNITS = {
    "m": {
        "cm": 0.01,
        "mm": 1e-3,
        "um": 1e-6,
        "nm": 1e-9,
        "in": math.nextafter(INCH_M, 1),
        "ft": 0.3048,
    },
    "s": {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "kg": {"g": 1e-3},
    "cd": {"mcd": 1e-3, "ucd": 1e-6},
}
COMMON_QUANTITY = re.compile(r"([-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?) ?([a-zA-Z][a-zA-Z2 ]*)")


def in_si(value: str, si_unit: str | None = None) -> float:
    """The value of a quantity such as "48 in" in `si_unit`, or in SI base units. Raises InputError."""
    match = COMMON_QUANTITY.fullmatch(value) if len(value) <= MAX_CHARACTERS else None
    if match and si_unit:
        if match[2] == si_unit:
            return float(match[1])
        if factor := COMMON_UNITS.get(si_unit, {}).get(match[2]):
            return float(match[1]) * factor
    from astropy import units

    # astropy spells it `inch`; scenes write `in`.
    inch = units.def_unit("in", units.imperial.inch)
    if len(value) > MAX_CHARACTERS:
        raise InputError("", f"{len(value)} characters", f"up to {MAX_CHARACTERS}")
    # UnitsError is a ValueError; "3 m(1/0)" and "3 m(9e9)" raise others.
    kinds = (TypeError, ValueError, ArithmeticError)
    with units.add_enabled_units([inch, units.imperial]), refusing(kinds, ""):
        number = units.Quantity(value)
        return float(number.to_value(si_unit) if si_unit else number.si.value)


def within(least: float, most: float) -> Any:
    """The bounds of a number that may be equal to either."""
    return Field(ge=least, le=most)


def above(limit: float, most: float) -> Any:
    """The bounds of a number that is greater than the first and may be equal to the second."""
    return Field(gt=limit, le=most)


# Of any type: a value above zero, and one of zero or more; lists of one or more, two or more, three.
Item = TypeVar("Item")
AboveZero = Annotated[Item, Field(gt=0)]
ZeroOrMore = Annotated[Item, Field(ge=0)]
NotEmpty = Annotated[tuple[Item, ...], Field(min_length=1)]
Several = Annotated[tuple[Item, ...], Field(min_length=2)]
Three = tuple[Item, Item, Item]
ZEROS = (0.0, 0.0, 0.0)
# Every number has a least and a greatest value. Those of quantities are beyond any laboratory that could be built: a
# hall of 10 km, a vehicle of 1000 t, a run of a century. A section narrows them where it knows better.
Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[Number, with_unit("m", "length", '"35 mm" or "48 in"', 1e4)]
Distance = Annotated[Number, with_unit("m", "length", '"35 mm" or "48 in"', 1e12)]
Time = Annotated[Number, with_unit("s", "time", '"40 ms" or "1000 us"', 3e9)]
Mass = Annotated[Number, with_unit("kg", "mass", '"80 kg"')]
Inertia = Annotated[Number, with_unit("kg m2", "moment of inertia", '"6.0 kg m2"', 1e9)]
Intensity = Annotated[Number, with_unit("cd", "luminous intensity", '"7.7 mcd"')]
RadiantIntensity = Annotated[Number, with_unit("W sr-1", "radiant intensity", '"3 mW/sr"')]
Torque = Annotated[Number, with_unit("N m", "torque", '"0.5 N m"')]
Force = Annotated[Number, with_unit("N", "force", '"0.5 N"')]
Speed = Annotated[Number, with_unit("m s-1", "speed", '"10 mm/s"')]
LinearImpulse = Annotated[Number, with_unit("N s", "impulse", '"5 mN s"')]
Momentum = Annotated[Number, with_unit("N m s", "angular momentum", '"2 N m s"')]
Damping = Annotated[Number, with_unit("N m s", "torque per rate", '"1e-4 N m s"')]
QuadraticDrag = Annotated[
    Number, with_unit("N m s2", "torque per squared rate", '"0.01 N m s2"')
]
Stiffness = Annotated[Number, with_unit("N m rad-1", "torque per angle", '"1e-3 N m / rad"')]
Imbalance = Annotated[Number, with_unit("kg m", "mass times offset", '"1 g cm"')]
PositiveLength = AboveZero[Length]
Position = Three[Length]
Duration = AboveZero[Time]
Delay = ZeroOrMore[Time]
TimeLimit = Annotated[Time, within(1e-3, 3600)]
# An angle or a rate.
Spin = Annotated[Number, within(-360, 360)]
Spins = Three[Spin]
RightAscension = Annotated[Number, Field(ge=0, lt=360)]
Declination = Annotated[Number, within(-90, 90)]
AxisAngle = Annotated[Number, within(0, 180)]
Magnitude = Annotated[Number, within(-30, 30)]
Temperature = Annotated[Number, within(-150, 150)]
Seed = Annotated[int, within(0, 1e18)]
Whole = Annotated[int, within(0, 1_000_000_000)]
PositiveInt = Annotated[Whole, Field(ge=1)]
Fraction = Annotated[Number, within(0, 1)]
PositiveFraction = Annotated[Number, above(0, 1)]
InnerFraction = Annotated[Number, Field(gt=0, lt=1)]
WITHIN_BILLION = within(-1e9, 1e9)
# Of any unit: all parts (ppm), most of a turn in arcseconds, a clock of a THz in MHz.
Positive = Annotated[Number, above(0, 1e6)]
NotNegative = Annotated[Number, within(0, 1e6)]
Signed = Annotated[Number, WITHIN_BILLION]
Fractions = Several[Fraction]
# Options of a program of the user, which knows their meaning.
Options = dict[str, bool | Annotated[int, WITHIN_BILLION] | Signed | str]
# Chooses the class of a section by its key `kind`.
BY_KIND = Field(discriminator="kind")


# SI unit, name, example, least and greatest value of a quantity.
QuantityRange = tuple[str, str, str, float, float]


def significant(values: Any, digits: int) -> Any:
    """The components of a vector; 0 for those below the last of so many digits of the largest one."""
    values = np.asarray(values, dtype=float)
    largest = np.abs(values).max(initial=0.0)
    unit = 10.0 ** (np.floor(np.log10(largest or 1.0)) + 1 - digits)
    return np.where(np.abs(values) < unit / 2, 0.0, values)


def quantities_within(
    section: str, ranges: Mapping[str, QuantityRange], texts: Sequence[str]
) -> list[float]:
    """Quantities in SI units. Raises InputError for an invalid or out-of-range value.

    Parameters
    ----------
    section
        Section of the keys in errors
    ranges
        Ranges by the name of the quantity
    texts
        One text for each quantity, in the same order
    """
    values = []
    for text, (name, (unit, what, example, low, high)) in zip(
        texts, ranges.items(), strict=True
    ):
        key = f"{section}.{name}"
        with errors_under(key):
            value = quantity(unit, what, example)(text)
        if not low <= value <= high:
            raise InputError(key, text, f"{low:g} to {high:g}{unit and f' {unit}'}")
        values.append(value)
    return values


def make_strict(schema: Any) -> None:
    """Let a schema take neither text nor true for a number, nor a number for true or false, nor an empty text."""
    if isinstance(schema, dict):
        if schema.get("type") in ("bool", "float", "int"):
            schema["strict"] = True
        if schema.get("type") == "str":
            schema.setdefault("min_length", 1)
        schema = [*schema.values()]
    for part in schema if isinstance(schema, list) else ():
        make_strict(part)


class ConfigModel(BaseModel):
    """Base of every section: frozen, strict, unknown keys are errors, YAML keys lack the SI suffix.

    `null` removes a key that a base has, so that its default holds, unless it is a value of the key itself.
    """

    model_config = ConfigDict(
        defer_build=True,  # of a section only when it is used alone
        extra="forbid",
        frozen=True,
        validate_by_alias=True,
        validate_by_name=False,
        alias_generator=lambda name: SI_SUFFIX.sub("", name),
    )

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        schema = handler(source)
        make_strict(handler.resolve_ref_schema(schema))
        return schema

    @model_validator(mode="before")
    @classmethod
    def without_removed(cls, tree: Any) -> Any:
        """The section without keys of the value null, where null is not allowed and the key has a default.

        Raises InputError for an unknown key, before a misspelled one is missed.
        """
        if not isinstance(tree, Mapping):
            return tree
        fields = {str(field.alias): field for field in cls.model_fields.values()}
        for key in tree:
            if isinstance(key, str) and key not in fields:
                names = ", ".join(name for name in fields if name.isidentifier())
                raise InputError(key, f"unknown key{suggestion(key, [*fields])}", names)
        return {
            key: value
            for key, value in tree.items()
            if value is not None or key not in fields or keeps_null(fields[key])
        }

    def model_post_init(self, _context: Any) -> None:
        """Call the method `check` of each class, the base first: whether the keys, which are valid, suit each other."""
        for kind in reversed(type(self).__mro__):
            if check := vars(kind).get("check"):
                check(self)

    def with_values(self, section: str = "", /, **values: Any) -> Self:
        """A copy with other values, of a section if it is named, which may be nested as `light.led`; not validated."""
        head, _, rest = section.partition(".")
        if head:
            values = {head: getattr(self, head).with_values(rest, **values)}
        return self.model_copy(update=values)


def keeps_null(field: FieldInfo) -> bool:
    """Whether null is a value of a field, or the field is required."""
    return (
        field.is_required()
        or field.annotation is Any
        or type(None) in get_args(field.annotation)
    )


def check_table(
    first: Sequence[float], values: Sequence[float], name: str, first_name: str
) -> None:
    """Raise InputError unless two columns have equal length and the first one ascends strictly."""
    if len(first) != len(values):
        raise InputError(
            "", f"{first_name} has {len(first)} numbers, {name} has {len(values)}"
        )
    if any(b <= a for a, b in itertools.pairwise(first)):
        raise InputError("", f"{first_name} is not strictly ascending")


class TableConfig(ConfigModel):
    """Base of a section whose last two keys are the columns of a table: of equal length, the first ascending."""

    def check(self) -> None:
        *_, first, second = type(self).model_fields
        check_table(getattr(self, first), getattr(self, second), second, first)


# Tolerance over sigma of a truncated normal distribution whose sigma is not given: 99.73 % (GUM 4.3.9, note 2).
SIGMAS_OF_TOLERANCE = 3.0


class Tolerance(float):
    """The standard deviation of an error that is within +-half_width, with its distribution.

        uniform:          half_width / sqrt(3)
        truncated normal: parent_sigma sqrt(1 - 2 k phi(k) / erf(k / sqrt 2)),    k = half_width / parent_sigma

    phi is the standard normal density. Uniform: GUM 4.3.7, JCGM 100:2008. Truncated normal: Johnson, Kotz &
    Balakrishnan 1994, Continuous Univariate Distributions 1, ch. 13.10.1.

    Attributes
    ----------
    half_width
        The tolerance, above 0
    parent_sigma
        Standard deviation of the normal distribution before it is truncated at the tolerance; None for a uniform error
    """

    half_width: float
    parent_sigma: float | None

    def __new__(cls, half_width: float, parent_sigma: float | None = None) -> Self:
        if parent_sigma is None:
            sigma = half_width / math.sqrt(3)
        else:
            k = half_width / parent_sigma
            density = math.exp(-(k**2) / 2) / math.sqrt(2 * math.pi)
            sigma = parent_sigma * math.sqrt(1 - 2 * k * density / math.erf(k / math.sqrt(2)))
        self = super().__new__(cls, sigma)
        self.half_width = half_width
        self.parent_sigma = parent_sigma
        return self

    def __reduce__(self) -> tuple[type["Tolerance"], tuple[float, float | None]]:
        return Tolerance, (self.half_width, self.parent_sigma)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tolerance) and self.__reduce__() == other.__reduce__()

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(self.__reduce__())

    def from_normal(self, normal: Floats) -> Floats:
        """Errors with this distribution from standard normal numbers, at equal probability (Gaussian copula)."""
        from scipy.special import ndtr, ndtri

        probability = ndtr(normal)
        if self.parent_sigma is None:
            return self.half_width * (2 * probability - 1)
        lowest = ndtr(-self.half_width / self.parent_sigma)
        return self.parent_sigma * ndtri(lowest + probability * (1 - 2 * lowest))


def scaled_errors(sigma: float, normal: Floats) -> Floats:
    """Errors of this size from standard normal numbers: sigma times them, or distributed like the tolerance.

    A tolerance instead of a sigma does not change the random streams.
    """
    return sigma.from_normal(normal) if isinstance(sigma, Tolerance) else sigma * normal


class ToleranceConfig(ConfigModel):
    """Base of the section of a tolerance; `tolerance` and `sigma` are quantities of the kind of the key.

    Attributes
    ----------
    tolerance
        Greatest error in both directions, with or without the sign: "±0.5 mm"
    distribution
        Uniform (the usual meaning in a data sheet, and the default), or a normal distribution truncated at the
        tolerance; normal has no tolerance
    sigma
        Standard deviation of the normal distribution before it is truncated; a third of the tolerance if left out
    """

    distribution: Literal["uniform", "truncated_normal", "normal"] | None = None

    def numbers(self) -> tuple[float | None, float | None]:
        """Tolerance and sigma in SI units; None for one that is left out."""
        half_width, sigma = (
            getattr(self, name) for name in list(type(self).model_fields)[1:]
        )
        return half_width, sigma

    def check(self) -> None:
        """Check that tolerance and sigma fit the distribution."""
        half_width, sigma = self.numbers()
        if half_width is None:
            if sigma is None or self.distribution not in (None, "normal"):
                raise InputError(
                    "",
                    f"{self.distribution or 'an error'} requires a tolerance",
                    "tolerance, or sigma",
                )
            return
        if self.distribution == "normal":
            raise InputError(
                "tolerance", "a normal distribution has none", "uniform, truncated_normal"
            )
        if sigma is not None and self.distribution != "truncated_normal":
            raise InputError(
                "sigma", "a uniform distribution has none", "distribution: truncated_normal"
            )
        if sigma is not None and not 0.01 <= half_width / sigma <= 100:
            raise InputError("sigma", "", "a hundredth to a hundred times the tolerance")

    def error(self) -> float:
        """The size of the error: a plain standard deviation, or a `Tolerance`."""
        half_width, sigma = self.numbers()
        if half_width is None:
            return float(sigma or 0.0)
        if self.distribution != "truncated_normal":
            return Tolerance(half_width)
        return Tolerance(half_width, sigma or half_width / SIGMAS_OF_TOLERANCE)


def without_sign(value: Any) -> Any:
    """A tolerance without its sign: "0.5 mm" for "±0.5 mm", and the number 0.1 for "±0.1"."""
    if not isinstance(value, str):
        return value
    text = value.strip().removeprefix("±").removeprefix("+/-").removeprefix("+-").strip()
    try:
        return float(text)
    except ValueError:
        return text


SIGNED = r"^\s*(±|\+/-|\+-)?\s*[.]?\d"
SIGNED_QUANTITY = BeforeValidator(
    without_sign,
    json_schema_input_type=Annotated[
        str, Field(description='a quantity such as "±0.5 mm"', pattern=SIGNED + ".*[a-zA-Z]")
    ],
)
SIGNED_NUMBER = BeforeValidator(
    without_sign,
    json_schema_input_type=Positive
    | Annotated[str, Field(description="±0.1", pattern=SIGNED)],
)


class LengthToleranceConfig(ToleranceConfig):
    """The tolerance of a length: {tolerance: "±0.5 mm"}, uniformly distributed.

    With {tolerance: "±0.5 mm", distribution: truncated_normal, sigma: "0.2 mm"} it is a Gaussian that ends there; sigma
    is a third of the tolerance if left out.
    """

    tolerance_m: Annotated[PositiveLength, SIGNED_QUANTITY] | None = None
    sigma_m: PositiveLength | None = None


class TimeToleranceConfig(ToleranceConfig):
    """The tolerance of a time: {tolerance: "±1 ms"}, uniformly distributed.

    With {tolerance: "±1 ms", distribution: truncated_normal, sigma: "0.4 ms"} it is a Gaussian that ends there; sigma
    is a third of the tolerance if left out.
    """

    tolerance_s: Annotated[Duration, SIGNED_QUANTITY] | None = None
    sigma_s: Duration | None = None


class NumberToleranceConfig(ToleranceConfig):
    """The tolerance of a bare number, in the unit of its key: {tolerance: 0.1}, uniformly distributed.

    With {tolerance: 0.1, distribution: truncated_normal, sigma: 0.04} it is a Gaussian that ends there; sigma is a
    third of the tolerance if left out.
    """

    tolerance: Annotated[Positive, SIGNED_NUMBER] | None = None
    sigma: Positive | None = None


def error_of(value: Any) -> Any:
    """The size of an error from a quantity or from the section of a tolerance."""
    return value.error() if isinstance(value, ToleranceConfig) else value


def in_file(value: float) -> Any:
    """The value for `model_dump`: a number for a Gaussian, tolerance and sigma for a tolerance."""
    if isinstance(value, Tolerance):
        return {"tolerance": value.half_width, "sigma": value.parent_sigma}
    return value


@frozen
class ErrorSchema:
    """Annotation of a key that is the size of an error: a quantity of some kind, or the section of its tolerance."""

    quantity: Any
    section: type[ToleranceConfig]

    def __get_pydantic_core_schema__(
        self, _source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        tag = (
            self.section.__name__
        )  # an error names the keys of the section only if there is one
        kinds = {
            "quantity": handler.generate_schema(self.quantity),
            tag: handler.generate_schema(self.section),
        }
        chosen = core_schema.tagged_union_schema(
            kinds,
            lambda value: tag if isinstance(value, dict | ToleranceConfig) else "quantity",
        )
        dumped = core_schema.plain_serializer_function_ser_schema(in_file)
        return core_schema.no_info_after_validator_function(
            error_of, chosen, serialization=dumped
        )


LengthError = Annotated[float, ErrorSchema(Length, LengthToleranceConfig), Field(ge=0)]
TimeError = Annotated[float, ErrorSchema(Time, TimeToleranceConfig), Field(ge=0)]
NumberError = Annotated[float, ErrorSchema(NotNegative, NumberToleranceConfig)]
