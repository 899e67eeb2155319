"""Schema of the scene section `camera`: the true hardware of lens, detector and electronics."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
)

from skysim.core.errors import InputError, check_name, unknown_name
from skysim.core.paths import DATA
from skysim.core.types import Floats
from skysim.core.units import (
    BY_KIND,
    AboveZero,
    AxisAngle,
    ConfigModel,
    Duration,
    Fraction,
    Fractions,
    Length,
    NotNegative,
    Number,
    Positive,
    PositiveFraction,
    Seed,
    Several,
    Signed,
    TableConfig,
    Temperature,
    above,
    check_table,
    quantity,
    within,
)
from skysim.core.yaml_reader import MAX_BYTES, ExistingFile, read_limited
from skysim.scene.opencv_calibration import OpencvCalibration

# Type in the JSON schema, which editors show.
FocusText = Annotated[str, Field(description='a length such as "33 in", or infinity')]

Electrons = Annotated[Number, within(0, 1e9)]

Wavelength = Annotated[Length, within(200e-9, 2e-6)]

# Standard deviation of a Gaussian: one that blurs a smooth image more, and one that alone makes it smooth enough.
Blur = Annotated[Number, within(0, 20)]
SampledBlur = Annotated[Number, within(0.2, 20)]

DiskRadius = Annotated[Number, above(0, 200)]
Side = Annotated[int, within(16, 20000)]
TransferLoss = Annotated[Number, within(0, 1e-2)]

Radial = Annotated[Number, within(-1e6, 1e6)]

Tangential = Annotated[Number, within(-0.1, 0.1)]  # a larger value would fold the image
Column = Several[Annotated[Number, within(-100, 100)]] | None
Distortion = tuple[Radial, Radial, Tangential, Tangential, Radial]


def radial(distortion: tuple[float, ...], r2: Floats) -> Floats:
    """Radial distortion factor 1 + k1 r^2 + k2 r^4 + k3 r^6 from k1, k2, p1, p2, k3 (OpenCV's order)."""
    k1, k2, _, _, k3 = distortion
    return 1 + r2 * (k1 + r2 * (k2 + r2 * k3))


def focus_distance(value: Any) -> float:
    """A length in m; infinity for the word infinity."""
    if value == "infinity":
        return math.inf
    return quantity("m", "length", '"33 in", or infinity', 1e12)(value)


class PsfConfig(ConfigModel):
    """Base of all point-spread functions: a Gaussian blur that grows toward the corner of the field.

    Attributes
    ----------
    corner_sigma_px
        Standard deviation at the farthest corner of the detector, proportional to the field radius and added in
        quadrature (field curvature and coma, to first order)
    coma_px
        Seidel's coma at that corner, proportional to the field radius: rays through the pupil's rim end up to twice as
        far outward from the center of the light
    """

    corner_sigma_px: Blur = 0.0
    coma_px: Annotated[Number, within(-20, 20)] = 0.0


class GaussianPsfConfig(PsfConfig):
    """A Gaussian of standard deviation sigma_px."""

    kind: Literal["gaussian"] = "gaussian"
    sigma_px: SampledBlur = 0.7


class MoffatPsfConfig(PsfConfig):
    """A Moffat profile: a core with power-law wings (Moffat 1969)."""

    kind: Literal["moffat"]
    fwhm_px: Annotated[Number, within(0.5, 50)]
    beta: Annotated[Number, within(1.5, 20)] = 3.0


class AiryPsfConfig(PsfConfig):
    """Diffraction at the lens's working f-number, convolved with a Gaussian blur of sigma_px."""

    kind: Literal["airy"]
    wavelength_m: Wavelength = 550e-9
    sigma_px: Blur = 0.0


class DiskPsfConfig(PsfConfig):
    """A uniform disk, the geometric image of a defocused lens, convolved with a Gaussian blur of sigma_px."""

    kind: Literal["disk"]
    radius_px: DiskRadius
    sigma_px: SampledBlur = 0.7


class MeasuredPsfConfig(PsfConfig):
    """A measured image of a point: a square table of numbers, `oversampling` samples per pixel along each axis."""

    kind: Literal["measured"]
    file: str
    oversampling: Annotated[int, within(1, 32)] = 1


Psf = Annotated[
    GaussianPsfConfig | MoffatPsfConfig | AiryPsfConfig | DiskPsfConfig | MeasuredPsfConfig,
    BY_KIND,
]


class TwoStopsConfig(ConfigModel):
    """Mechanical vignetting by two equal round stops in a row, with zero transmission at cutoff_deg."""

    kind: Literal["two_stops"]
    cutoff_deg: Annotated[Number, Field(gt=0, lt=90)]


class VignettingTableConfig(TableConfig):
    """Measured transmission against field angle, 1 on the axis."""

    kind: Literal["table"]
    angle_deg: Several[AxisAngle]
    transmission: Fractions


class ChromaticConfig(ConfigModel):
    """Chromatic aberration by wavelength, linear between the wavelengths and constant beyond them.

    Attributes
    ----------
    wavelength
        Ascending wavelengths of the columns
    focus
        Axial color: image distance minus that of the lens's focal length, for a light at infinity
    corner_px
        Lateral color: shift away from the principal point at the farthest corner of the detector, proportional to the
        distance from the principal point
    """

    wavelength_m: Several[Wavelength]
    focus_m: Several[Annotated[Length, within(-1e-3, 1e-3)]] | None = None
    corner_px: Column = None

    def check(self) -> None:
        columns = {"focus": self.focus_m, "corner_px": self.corner_px}
        for name, column in columns.items():
            if column is not None:
                check_table(self.wavelength_m, column, name, "wavelength")
        if not any(column and any(column) for column in columns.values()):
            raise InputError(
                "", "nothing depends on the wavelength", "focus or corner_px other than 0"
            )


class LensTableConfig(ConfigModel):
    """Errors of the lens against the field angle, from a lens program: linear between the rows, constant beyond them.

    Attributes
    ----------
    field_deg
        Ascending field angles
    coma_um
        Seidel's sagittal coma on the detector, instead of psf.coma_px; positive if the flare points outward
    sigma_um
        Standard deviation of a blur (astigmatism, field curvature), instead of psf.corner_sigma_px
    lateral
        Lateral color over that of chromatic.corner_px
    """

    field_deg: Several[Annotated[Number, within(0, 89)]]
    coma_um: Column = None
    sigma_um: Column = None
    lateral: Column = None

    def check(self) -> None:
        for name, column in self:
            if column:
                check_table(self.field_deg, column, name, "field_deg")


def read_columns(value: Any) -> Any:
    """The columns of a lens's table by name: of a CSV or ECSV file, or `value` itself if it is no name of a file."""
    if not isinstance(value, str):
        return value
    try:
        content = read_limited(Path(value), MAX_BYTES, "utf-8-sig").replace(",", " ")
        # Neither comments nor empty lines.
        names, *rows = [line.split() for line in content.splitlines() if line[:1] not in "#"]
        for name in names:
            check_name("", "column", name, LensTableConfig.model_fields)
        columns = np.array(rows, float).T.tolist()
        return dict(zip(names, columns, strict=True))
    except ValueError as error:
        raise InputError(
            "", f"{value}: {error}", "a line of names, then rows of numbers"
        ) from None


class GhostConfig(ConfigModel):
    """A ghost of every light: light that a pair of the lens's surfaces reflects back to the detector.

    Attributes
    ----------
    magnification
        Distance of the ghost from the principal point over that of the image, on the other side of it; negative on the
        same side
    share
        Light of the ghost over that of the image: the product of the two reflectances
    radius_px
        Radius of the disk over which it is spread, out of focus
    """

    magnification: Annotated[Number, within(-20, 20)]
    share: AboveZero[Fraction]
    radius_px: DiskRadius

    def check(self) -> None:
        if abs(self.magnification) < 0.05:
            raise InputError(
                "magnification",
                f"{self.magnification:g} images half of space on the chip",
                "from 0.05 or to -0.05",
            )


class GlareConfig(ConfigModel):
    """Veiling glare: light scattered over the detector, proportional to (1 + (r / core_px)^2)^(-exponent / 2).

    Attributes
    ----------
    share
        Scattered fraction of all light
    exponent
        Exponent of the power law at distances r far above core_px
    core_px
        Distance r at which the power law begins
    """

    share: Annotated[Fraction, Field(gt=0, lt=1)]
    exponent: Annotated[Number, above(2, 10)]
    core_px: Annotated[Number, within(2, 1000)]


class BaffleConfig(TableConfig):
    """Point source transmittance (PST) of baffle and lens for the light of bodies outside the field.

    Attributes
    ----------
    angle_deg, pst
        Irradiance on the detector over irradiance before the lens, by the angle from the boresight. Its logarithm is
        linear between the rows and constant beyond them. A curve of `transmission` is a further factor
    """

    angle_deg: Several[AxisAngle]
    pst: Fractions


class GlobalShutterConfig(ConfigModel):
    """All rows are exposed at the same time."""

    kind: Literal["global"] = "global"


class RollingShutterConfig(ConfigModel):
    """Each row opens and closes row_time after the one above it."""

    kind: Literal["rolling"]
    row_time_s: Duration


class FrameTransferConfig(ConfigModel):
    """Exposed charge is shifted into a covered store, row_time per row, so a pixel collects along its column."""

    kind: Literal["frame_transfer"]
    row_time_s: Duration


class InterlineConfig(ConfigModel):
    """The covered register is not opaque: it collects the fraction `leak` of the light of each row that it passes."""

    kind: Literal["interline"]
    row_time_s: Duration
    leak: Fraction = 1e-4


Shutter = Annotated[
    GlobalShutterConfig | RollingShutterConfig | FrameTransferConfig | InterlineConfig,
    BY_KIND,
]


class ParticlesConfig(ConfigModel):
    """Ionizing particles that leave straight tracks: cosmic rays, trapped protons.

    Attributes
    ----------
    per_cm2_s
        Crossings per square centimeter of the detector and second, from all sides: half of the omnidirectional flux
    depth_m
        Thickness of the sensitive layer
    electrons_um
        Most probable charge per micrometer of track (about 80 for a fast singly charged particle)
    diffusion_px
        Standard deviation of the charge cloud
    """

    per_cm2_s: Annotated[Number, within(0, 1e12)]
    depth_m: Annotated[Length, above(0, 1e-3)] = 10e-6
    electrons_um: Positive = 80.0
    diffusion_px: Annotated[Number, within(0, 5)] = 0.3


Curve = Annotated[str, AfterValidator(lambda name: curve_file(name) and name)]


class EfficiencyConfig(ConfigModel):
    """A curve of quantum efficiency, scaled to the peak that a data sheet states.

    Attributes
    ----------
    curve
        Name in data/qe, or a file
    peak
        Electrons per photon at the highest point of the curve
    """

    curve: Curve
    peak: PositiveFraction


class ColorEfficiencyConfig(ConfigModel):
    """The quantum efficiency behind each filter of a Bayer mosaic: the name of a curve in data/qe, or a file."""

    red: Curve
    green: Curve
    blue: Curve


def efficiency_tag(value: Any) -> str:
    """Tag of the kind of quantum efficiency; an error then names the keys of the section only if there is one."""
    if isinstance(value, dict | ConfigModel):
        return "ColorEfficiencyConfig" if "red" in dict(value) else "EfficiencyConfig"
    return "name" if isinstance(value, str) else "number"


Efficiency = Annotated[
    Annotated[Annotated[float, above(0, 1)], Tag("number")]
    | Annotated[Curve, Tag("name")]
    | Annotated[EfficiencyConfig, Tag("EfficiencyConfig")]
    | Annotated[ColorEfficiencyConfig, Tag("ColorEfficiencyConfig")],
    Discriminator(efficiency_tag),
]


def transmission_tag(value: Any) -> str:
    """Tag of the kind of transmission: a text that ends in .csv is a curve, any other value a number."""
    return "curve" if isinstance(value, str) and value.endswith(".csv") else "number"


Transmission = Annotated[
    Annotated[PositiveFraction, Tag("number")] | Annotated[ExistingFile, Tag("curve")],
    Discriminator(transmission_tag),
]


MOST_SHIFT_PX = 0.5  # of a boundary: beyond it charge would be negative


class DetectorConfig(ConfigModel):
    """The detector and its electronics, in the order of the signal path. A parameter can switch off each effect.

    Attributes
    ----------
    quantum_efficiency
        One number for 400-1000 nm, the name of a curve in data/qe (or a file), or a curve with its peak:
        {curve: cmos, peak: 0.6}; with `bayer` three curves: {red: bayer_red, green: bayer_green, blue: bayer_blue}
    bayer
        Filters of the first pixels of the first two rows of a color camera; monochrome if left out
    hardware_seed
        Seed of the fixed pattern: PRNU, DSNU, hot pixels, column offsets
    prnu
        Standard deviation of the pixels' relative sensitivity
    dark_e_s
        Mean dark current at dark_temperature_c; it doubles every dark_doubling_c
    temperature_c
        Temperature of the detector; dark_temperature_c if left out
    dsnu
        Standard deviation of the pixels' relative dark current
    hot_pixels
        Fraction of hot pixels, whose dark current is exponentially distributed with the mean hot_e_s
    particles
        Ionizing particles of several kinds
    blooming
        `column`: charge beyond a full well flows along its column; `none`: it is lost
    anti_blooming
        Fraction of the charge beyond a full well that is drained
    cti_parallel, cti_serial
        Fraction of the charge that each transfer leaves behind
    read_noise_e, reset_noise_e
        Standard deviations of Gaussian noise, drawn for every pixel and frame
    column_offset_e
        Standard deviation of the fixed offsets of the columns
    nonlinearity
        Fraction of the signal that is missing at full well: e (1 - nonlinearity e / full_well)
    intrapixel
        Amplitude p of the response 1 + p cos 2 pi u along each axis of a pixel, whose center is at u = 0
    brighter_fatter_per_e
        Displacement of the boundary of two pixels, in pixels, per electron of the difference of their charges: the mean
        over an exposure, half of that at its end
    edge_px, edge_reach_px
        Outward displacement of images at the chip's edge, which falls by e per edge_reach_px; of the centers of discs,
        not of the sky
    noise
        False gives the expected value, not rounded, with fixed pattern and transfer loss, but without particles,
        full-well limit, nonlinearity and converter range
    """

    quantum_efficiency: Efficiency
    bayer: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    hardware_seed: Seed = 0
    prnu: Annotated[Number, within(0, 0.2)] = 0.0
    dark_e_s: Electrons = 0.0
    dark_temperature_c: Temperature = 20.0
    dark_doubling_c: Annotated[Number, within(1, 50)] = 7.0
    temperature_c: Temperature | None = None
    dsnu: Annotated[Number, within(0, 2)] = 0.0
    hot_pixels: Fraction = 0.0
    hot_e_s: Electrons = 0.0
    particles: tuple[ParticlesConfig, ...] = ()
    full_well_e: Annotated[Number, within(1, 1e9)]
    blooming: Literal["none", "column"] = "none"
    anti_blooming: Fraction = 0.0
    cti_parallel: TransferLoss = 0.0
    cti_serial: TransferLoss = 0.0
    read_noise_e: Electrons = 0.0
    reset_noise_e: Electrons = 0.0
    column_offset_e: Electrons = 0.0
    gain_e_dn: Annotated[Number, within(1e-6, 1e9)]
    offset_dn: NotNegative = 0.0
    nonlinearity: Annotated[Number, within(0, 0.4)] = 0.0
    intrapixel: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    brighter_fatter_per_e: Annotated[Number, within(0, 1e-3)] = 0.0
    edge_px: Annotated[Number, within(-10, 10)] = 0.0
    edge_reach_px: Annotated[Number, above(0, 1000)] = 10.0
    bits: Annotated[int, within(1, 16)]
    noise: bool = True

    @property
    def own_c(self) -> float:
        """Temperature of the detector, degrees Celsius."""
        set_c = self.temperature_c
        return self.dark_temperature_c if set_c is None else set_c

    @property
    def doublings(self) -> float:
        """Number of times that the dark current doubles from dark_temperature_c to temperature_c."""
        return (self.own_c - self.dark_temperature_c) / self.dark_doubling_c

    def check(self) -> None:
        if isinstance(self.quantum_efficiency, ColorEfficiencyConfig) != bool(self.bayer):
            raise InputError(
                "quantum_efficiency",
                f"{'one' if self.bayer else 'three curves'} with bayer: {self.bayer or 'none'}",
                "{red: bayer_red, green: bayer_green, blue: bayer_blue} with bayer: RGGB",
            )
        if self.temperature_c is not None and self.doublings > 40:
            raise InputError(
                "temperature_c",
                f"{self.temperature_c:g} doubles the dark current {self.doublings:.0f} times",
                "up to 40",
            )
        if self.edge_px < -self.edge_reach_px:
            raise InputError("edge_px", "the image folds at the edge", "from -edge_reach_px")
        if self.brighter_fatter_per_e * self.full_well_e > MOST_SHIFT_PX:
            raise InputError(
                "brighter_fatter_per_e",
                f"a full well displaces its boundaries by more than {MOST_SHIFT_PX} px",
                f"up to {MOST_SHIFT_PX / self.full_well_e:.2g}",
            )
        if self.offset_dn >= 2**self.bits:
            raise InputError(
                "offset_dn", f"{self.offset_dn:g} is beyond the range of {self.bits} bits"
            )


Walk = Annotated[Length, within(-0.1, 0.1)]


class CameraConfig(ConfigModel):
    """The true lens and detector. The section `tracker` has the assumptions of the tracker.

    Attributes
    ----------
    transmission
        Transmission of the lens: one number for all wavelengths, or a CSV file of wavelength_nm and transmission, which
        is 0 beyond its ends
    lens_table
        Errors of the lens against the field angle: a CSV or ECSV file, or its columns
    pupil_walk
        Displacement z = a tan^2 t + b tan^4 t of the entrance pupil along the boresight for light at the field angle t;
        only near lights (LEDs) are displaced
    ghosts, glare
        Stray light of lights in the field
    baffle
        Stray light of the bodies and of the Earth at their present places; none if left out
    """

    width_px: Side
    height_px: Side
    pixel_m: Annotated[Length, within(1e-7, 1e-2)]
    focal_length_m: Annotated[Length, within(1e-5, 1e3)]
    f_number: Annotated[Number, within(0.3, 1e6)]
    focus_m: Annotated[
        float, BeforeValidator(focus_distance, json_schema_input_type=FocusText), Field(gt=0)
    ] = math.inf
    transmission: Transmission = 1.0
    vignetting: Annotated[TwoStopsConfig | VignettingTableConfig, BY_KIND] | None = None
    distortion: Distortion = (
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )
    principal_point_px: tuple[Signed, Signed] | None = None
    pupil_walk_m: tuple[Walk, Walk] = (0.0, 0.0)
    psf: Psf = GaussianPsfConfig()
    chromatic: ChromaticConfig | None = None
    lens_table: (
        Annotated[
            LensTableConfig,
            BeforeValidator(read_columns, json_schema_input_type=LensTableConfig | str),
        ]
        | None
    ) = None
    ghosts: tuple[GhostConfig, ...] = ()
    glare: GlareConfig | None = None
    baffle: BaffleConfig | None = None
    shutter: Shutter = GlobalShutterConfig()
    detector: DetectorConfig

    def check(self) -> None:
        if self.focus_m <= 2 * self.focal_length_m:
            raise InputError(
                "focus",
                f"{self.focus_m:g} m is less than twice the focal length {self.focal_length_m:g} m",
            )
        table = self.lens_table
        if table and (
            (table.coma_um and self.psf.coma_px)
            or (table.sigma_um and self.psf.corner_sigma_px)
            or (table.lateral and not self.chromatic)
        ):
            raise InputError(
                "lens_table",
                "columns that conflict with keys of camera",
                "coma_um or psf.coma_px, sigma_um or psf.corner_sigma_px, lateral with chromatic",
            )

    def along_radius(self, column: str, corner: Any, xy_px: Floats) -> Floats:
        """Displacements (..., 2) in px along the field's radius at xy_px (..., 2), by an error of the lens.

        They grow with the radius, to `corner` px at the farthest corner. A column of the lens's table gives them
        instead; `lateral` is relative to `corner`.
        """
        from_center_px = xy_px - self.center_px
        table = self.lens_table
        if table is None or not (values := getattr(table, column)):
            return corner * from_center_px / self.corner_px
        # The image's radius at the table's angles, with radial distortion up to its fold.
        tangent = np.tan(np.radians(table.field_deg))
        knots_px = self.focal_px * np.maximum.accumulate(
            tangent * radial(self.distortion, tangent**2)
        )
        # Not zero: on the axis blur has no direction.
        from_center_px += 1e-12
        radius_px = np.linalg.norm(from_center_px, axis=-1, keepdims=True)
        unit_px = corner if column == "lateral" else 1e-6 / self.pixel_m
        return unit_px * np.interp(radius_px, knots_px, values) * from_center_px / radius_px

    @property
    def pupil_m(self) -> float:
        """Diameter of the entrance pupil."""
        return self.focal_length_m / self.f_number

    @property
    def gray_transmission(self) -> float:
        """Transmission of the lens at all wavelengths; 1 if it has a curve, which is part of the band (`Band`)."""
        return 1.0 if isinstance(self.transmission, str) else self.transmission

    @property
    def image_distance_m(self) -> float:
        """Distance v from lens to detector, by the thin lens: 1/v = 1/f - 1/u; f if focused at infinity."""
        return 1 / (1 / self.focal_length_m - 1 / self.focus_m)

    @property
    def row_delay_s(self) -> float:
        """Time from the exposure of a row to that of the next one: 0 unless the shutter is a rolling one."""
        shutter = self.shutter
        return shutter.row_time_s if isinstance(shutter, RollingShutterConfig) else 0.0

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the detector."""
        return self.width_px, self.height_px

    @property
    def focal_px(self) -> float:
        """Image distance in pixels, which is the focal length of a star tracker: pixels per unit tangent."""
        return self.image_distance_m / self.pixel_m

    @property
    def center_px(self) -> tuple[float, float]:
        """The principal point; by default the center of the detector."""
        return self.principal_point_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)

    def calibration(self) -> OpencvCalibration:
        """The result of a perfect calibration of this camera."""
        return OpencvCalibration(
            self.width_px, self.height_px, self.focal_px, self.center_px, self.distortion
        )

    @property
    def corner_px(self) -> float:
        """Distance from the principal point to the farthest corner of the detector."""
        return self.calibration().corner_px


CURVE_FOLDER = DATA / "qe"


def curve_file(name: str) -> Path:
    """The file of a quantum efficiency: a name in data/qe, or a path that ends in .csv.

    Raises InputError, with the names of data/qe, if it is neither.
    """
    curves = {path.stem: path for path in sorted(CURVE_FOLDER.glob("*.csv"))}
    if name in curves:
        return curves[name]
    if name.endswith(".csv") and Path(name).is_file():
        return Path(name)
    raise InputError("", *unknown_name("curve", name, curves))
