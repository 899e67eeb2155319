"""Sizes of errors as in data sheets: the standard deviation of a Gaussian, or a tolerance.

A key of a scene that is the size of an error takes a quantity, which is the standard deviation of a Gaussian, or a
section with a tolerance, which no error exceeds:

    led_sigma: "0.2 mm"
    led_sigma: {tolerance: "±0.5 mm"}
    led_sigma: {tolerance: "±0.5 mm", distribution: truncated_normal, sigma: "0.2 mm"}

In Python the value is the equivalent standard deviation, a float, for covariances. A tolerance is a `Tolerance`, a
float that also has its distribution. `scaled_errors` draws from either.
"""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from skysim.core.errors import InputError
from skysim.core.types import Floats, frozen
from skysim.core.units import (
    ConfigModel,
    Duration,
    Length,
    NotNegative,
    Positive,
    PositiveLength,
    Time,
)

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
