"""Schema of the scene sections `tracker` and `filter`."""

from typing import Annotated, Literal

from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.units import (
    ZEROS,
    ConfigModel,
    Delay,
    Duration,
    InnerFraction,
    LengthError,
    Magnitude,
    NotNegative,
    Number,
    NumberError,
    Options,
    Position,
    Positive,
    PositiveInt,
    PositiveLength,
    Seed,
    Spins,
    Time,
    TimeLimit,
    Whole,
    within,
)
from skysim.core.yaml_reader import ExistingFile, value_at
from skysim.scene.sections.camera import Distortion

OWN = "own"  # skysim's tracker


class TotalStationConfig(ConfigModel):
    """A total station that measures every LED by a horizontal direction, a zenith angle and a distance from one point.

    Errors of a sight are drawn for each LED. Errors of the set-up are drawn once and are common to all LEDs. See
    `skysim.sources.dome.survey_errors`. Sizes are standard deviations or tolerances.

    Attributes
    ----------
    position
        Intersection of its axes, in the lab
    angle_sigma_arcsec
        Error of a direction and of a zenith angle, measured in both faces (ISO 17123-3); for each LED
    distance_sigma
        Error of a distance, a of the data sheet's a + b ppm (ISO 17123-4), without reflector if the LEDs have none; for
        each LED
    distance_ppm
        Error of the scale of distances, b of the data sheet; common
    zero_sigma
        Error of the distance meter's zero point on these targets (additive constant); common
    centering
        Error of its position along each axis of the lab; common
    orientation_sigma_arcsec
        Error of the zero of its horizontal circle (the backsight), about the vertical; common
    leveling_sigma_arcsec
        Error of its vertical axis, about each horizontal axis (the compensator); common
    """

    kind: Literal["total_station"]
    position_m: Position
    angle_sigma_arcsec: NumberError
    distance_sigma_m: LengthError
    distance_ppm: NumberError = 0.0
    zero_sigma_m: LengthError = 0.0
    centering_m: LengthError = 0.0
    orientation_sigma_arcsec: NumberError = 0.0
    leveling_sigma_arcsec: NumberError = 0.0


PlaceError = Annotated[LengthError, Field(le=0.1)]


class SurveyErrorsConfig(ConfigModel):
    """Errors of the survey of LEDs and camera, drawn once from their own seed, which also draws `light.surface.error`.

    Attributes
    ----------
    rotation_deg
        Rotation vector of the survey's axes relative to the lab's, which rotates all surveyed LEDs: the error of the
        level or IMU to which the survey was referenced
    surface_seed
        Seed of `light.surface.error`; `seed` if left out
    led_sigma
        Standard deviation of each LED's surveyed position along each axis of the lab, or its tolerance; with an
        instrument it is that of the target (the LED in its window)
    lever_sigma
        Standard deviation of the camera's surveyed position along each axis of the body, or its tolerance
    focal_length_sigma
        Standard deviation of the assumed focal length about the true one, or its tolerance
    instrument
        Instrument that measured the LEDs, with its own errors; none if left out
    seed
        Seed of the errors
    """

    rotation_deg: Spins = ZEROS
    surface_seed: Seed | None = None
    led_sigma_m: PlaceError = 0.0
    lever_sigma_m: PlaceError = 0.0
    focal_length_sigma_m: LengthError = 0.0
    instrument: TotalStationConfig | None = None
    seed: Seed = 0


class ExposureControlConfig(ConfigModel):
    """Exposure control from frame to frame: the SHEFEX-2 flow chart (Samaan & Theil 2011).

    The first frame has `exposure.time`. If a frame is too bright, the next exposure is one step shorter; otherwise, if
    it has too few stars, one step longer. Each exposure time depends on earlier frames, so with exposure control a
    frame cannot be rendered on its own. See `estimator.trackers.exposure_control`.

    Attributes
    ----------
    mean_dn
        Mean of a frame above which it is overexposed, for example twice its bias and sky
    shortest, longest, step
        Limits of the exposure time, and its change from frame to frame
    min_stars
        Number of stars below which the exposure is too short
    overexposed_objects, saturated_px
        Number of objects with more than saturated_px full pixels each from which a frame is overexposed
    """

    mean_dn: Positive
    shortest_s: Annotated[Time, Field(ge=10e-6)] = 10e-6
    longest_s: Annotated[Time, Field(le=10.0)] = 50e-3
    step_s: Annotated[Time, Field(ge=1e-6)] = 2e-3
    min_stars: PositiveInt = 4
    overexposed_objects: PositiveInt = 4
    saturated_px: Whole = 1

    def check(self) -> None:
        if self.shortest_s > self.longest_s:
            raise InputError(
                "shortest", f"{self.shortest_s:g} s is above longest {self.longest_s:g} s"
            )


class DecoderConfig(ConfigModel):
    """Decoding of the codes of a dome's LEDs (`light.led.code`) over the frames.

    Attributes
    ----------
    flux_sigma
        Relative error of a light's brightness that the decoder assumes in addition to photon noise
    gate_px
        Greatest difference of an image's motion between two frames from the prediction by `tracker.gyro` or by the last
        motion
    frames
        Number of last frames whose brightness is used; that of the bits of the code if left out
    """

    flux_sigma: Annotated[Number, within(1e-6, 1)] = 0.03
    gate_px: Annotated[Number, within(1, 10_000)] = 60.0
    frames: Annotated[int, within(3, 10_000)] | None = None


class ComputerConfig(ConfigModel):
    """Another computer, for which the times of the tracker are computed.

    Attributes
    ----------
    clock_mhz
        Its clock
    cycles_factor
        Its cycles for the same work over those of this machine
    host_clock_mhz
        Clock of this machine; that of /proc/cpuinfo if left out
    """

    clock_mhz: Positive
    cycles_factor: Positive = 1.0
    host_clock_mhz: Positive | None = None


# Keys of a tracker, and of its survey, whose values a map contains.
ASSUMED_KEYS = ("assumed_focal_length", "assumed_camera_body", "assumed_distortion")
SURVEYED_KEYS = ("led_sigma", "lever_sigma", "focal_length_sigma", "instrument")


class TrackerConfig(ConfigModel):
    """Settings of the star tracker and its assumed values of the hardware; an assumed value of `null` is the true one.

    Attributes
    ----------
    name
        `own`, or an external tracker: an entry point, or a program given on the command line (`--program`)
    options, time_limit
        Options of an external tracker, and its time limit for each frame
    detector, centroider, identifier, solver
        Algorithms. If left out, `local`, `cog`, `led_pairs` and `rotation_only` under a dome, `default` under the
        stars. With the dome's identifier `non_dimensional` the assumed focal length may be wrong by up to 12 %, and the
        tracker fits it with the attitude
    acceptance
        Rule by which a published identifier accepts a match: `evidence`, if it is significant against chance, or
        `thesis`, by the rule of its own paper, which does not test it (SAA: the hypothesis of least cost; SHEFEX-2: a
        fourth star; Fialho: the fraction of matched stars; NPS: the most angles)
    cos_error
        Tolerance of the cosine of an angle between two stars, for the identifier `shefex` (Samaan & Theil 2011, eq. 3:
        c |cos FOV - cos(FOV - centroid error)|; they chose 5.5e-5). If left out, from centroid_sigma_px
    centroid_sigma_px
        Least error that the tracker claims for a centroid. If left out, under the stars it is estimated from the
        residuals of each frame, and under a dome it is 0.2
    intensity_threshold
        Threshold of the detector `thesis` and of `skysim calibrate`, as a share of full scale (Padro 2012: 0.04)
    catalog
        Star catalog of the tracker, not that of the simulator: a name in data/catalogs, or a file of `skysim catalog
        build`, `select`, `readcat` or `proc-cat`
    assumed_distortion
        Assumed coefficients k1, k2, p1, p2, k3 of the lens; the true ones if left out
    assumed_row_time
        Assumed row time of a rolling shutter; 0 for a tracker that assumes a global shutter
    gyro
        Whether the tracker gets the mean rate that `vehicle.imu` measures during each exposure, unless saturated, for
        smear and rolling shutter. Without it, as in the published laboratories, both follow from the frame alone
    orbit_velocity
        Whether the tracker gets the velocity of the scene's `orbit` and corrects its aberration (5")
    refraction
        Whether the tracker knows `site`, weather and time, and corrects the refraction of `light.air`
    brightest
        Number of the brightest detections of a frame that are used
    survey
        Errors of the survey
    exposure_control
        Control of the exposure time; every frame has `exposure.time` if left out
    decoder
        Identification of LEDs by their codes over the frames, in order; without it frame by frame, by their positions
    brightness_sigma
        Standard deviation of the logarithm of the LEDs' brightness over that of the data sheet (scatter, aging, angle,
        flicker), for identification by brightness and position; by position alone if left out
    assumed_attitude_deg
        Roll, pitch and yaw (3-2-1) of the vehicle by another sensor, from which the dome's identifiers pyramid, saa and
        master_star compute the distances of the lights, as for a panel that is not a sphere; a sphere if left out
    magnitude_sigma
        Standard deviation of a star's measured magnitude over the catalog's V (noise, colors), for identification by
        magnitude and place; by place alone if left out. The zero point is that of a star of the Sun's color
    computer
        Computer whose times a run reports and a study has as `computer_ms`
    map
        File that `skysim survey` wrote: measured LEDs, lever, focal length and distortion
    """

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")] = OWN
    options: Options = Field(default_factory=dict)
    time_limit_s: TimeLimit = 10.0
    detector: str | None = None
    centroider: str | None = None
    identifier: str | None = None
    acceptance: Literal["evidence", "thesis"] = "evidence"
    cos_error: Annotated[Number, within(1e-12, 0.1)] | None = None
    solver: str | None = None
    threshold_sigma: Positive = 5.0
    min_area_px: PositiveInt = 3
    intensity_threshold: InnerFraction = 0.04
    catalog: str = "hipparcos_hp6.5"
    limit_mag: Magnitude = 6.0
    centroid_sigma_px: Positive | None = None
    assumed_focal_length_m: PositiveLength | None = None
    assumed_distortion: Distortion | None = None
    assumed_row_time_s: Delay | None = None
    gyro: bool = False
    orbit_velocity: bool = True
    refraction: bool = False
    brightest: Annotated[int, within(3, 1000)] | None = None
    assumed_camera_body_m: Position | None = None
    survey: SurveyErrorsConfig = SurveyErrorsConfig()
    exposure_control: ExposureControlConfig | None = None
    decoder: DecoderConfig | None = None
    brightness_sigma: Annotated[Number, within(0.02, 2)] | None = None
    assumed_attitude_deg: Spins | None = None
    magnitude_sigma: Annotated[Number, within(0.01, 5)] | None = None
    computer: ComputerConfig | None = None
    map: ExistingFile | None = None

    def check(self) -> None:
        if self.assumed_camera_body_m is not None and self.survey.lever_sigma_m:
            raise InputError(
                "survey.lever_sigma",
                "conflicts with assumed_camera_body",
                "0, or the survey alone",
            )
        if self.assumed_focal_length_m is not None and self.survey.focal_length_sigma_m:
            raise InputError(
                "survey.focal_length_sigma",
                "conflicts with assumed_focal_length",
                "one of the two",
            )
        tree = self.model_dump(by_alias=True) if self.map else {}
        for key in (*ASSUMED_KEYS, *(f"survey.{name}" for name in SURVEYED_KEYS)):
            if value_at(tree, key):
                raise InputError(
                    key, "conflicts with tracker.map, which contains it", "0, or no map"
                )


class FilterConfig(ConfigModel):
    """Noise model and settings of the attitude filter (MEKF: attitude and gyro errors), for gyro and star tracker.

    The bias is modeled as a Gauss-Markov process about zero in body axes. If imu.earth_rate is uncompensated, the
    filter estimates the Earth rate as a bias while the attitude is constant. When the vehicle rotates, this bias
    changes in body axes, so bias_deg_h must contain it (15) and bias_time must be that of the rotation. The gyro's
    scale factors and misalignments, the tracker's slow error and its mount are states, too, if their standard deviation
    is not 0. A state that is `considered` is in the covariance, but its value is not estimated.

    Attributes
    ----------
    arw_deg_sqrt_h
        Angle random walk of the gyros
    bias_deg_h, bias_time
        Standard deviation and correlation time of the gyro bias
    scale_ppm, misalignment_arcsec
        Standard deviations of the gyros' scale factors and of the directions of their axes
    rate_limit_deg_s
        Largest rate that the gyros measure; from nine tenths of it a rate counts as saturated, even if the IMU does not
        report it
    start_deg, start_bias_deg_h
        Standard deviations of attitude and bias about each axis at the start
    systematic_arcsec
        Standard deviation about each axis of the tracker's slow error, which does not average out; added to the error
        of the survey that a dome tracker reports
    systematic_time, systematic_angle_deg
        Time and rotation after which the slow error has changed
    mounting_arcsec
        Standard deviation about each axis of the tracker's mount, and of those of `heads` relative to it, which are
        estimated
    mounting_drift_arcsec_sqrt_h
        Random walk of each mount about each axis
    floor_arcsec
        Error that all lights of a frame share and that differs from frame to frame, added to the covariance
    considered
        States that are considered
    gate_sigma
        Largest innovation of a solution that is accepted
    missed_per_h
        Number of motions per hour that the gyros miss without a report
    wrong_share, wrong_repeat
        Probability that a wrong solution begins at a frame, and that the next one agrees with it
    latency
        Time from the end of an exposure to its solution
    time_tag_sigma
        Standard deviation of a frame's time tag, which adds sigma^2 w w^T to the covariance at the rate w
    """

    arw_deg_sqrt_h: NotNegative = 0.07
    bias_deg_h: NotNegative = 1.0
    bias_time_s: Duration = 300.0
    scale_ppm: NotNegative = 0.0
    misalignment_arcsec: NotNegative = 0.0
    rate_limit_deg_s: Positive | None = None
    start_deg: Positive = 1.0
    start_bias_deg_h: Positive = 10.0
    systematic_arcsec: NotNegative = 1.0
    systematic_time_s: Duration = 3600.0
    systematic_angle_deg: Positive = 10.0
    mounting_arcsec: NotNegative = 0.0
    mounting_drift_arcsec_sqrt_h: NotNegative = 0.0
    floor_arcsec: NotNegative = 0.0
    considered: tuple[
        Literal["bias", "scale", "misalignment", "mounting", "systematic"], ...
    ] = (
        "mounting",
        "systematic",
    )
    gate_sigma: Positive = 5.0
    missed_per_h: Annotated[Number, Field(gt=0, lt=3600)] = 1e-4
    wrong_share: InnerFraction = 1e-4
    wrong_repeat: InnerFraction = 0.75
    latency_s: Delay = 0.0
    time_tag_sigma_s: Delay = 0.0

    def check(self) -> None:
        if self.mounting_drift_arcsec_sqrt_h and not self.mounting_arcsec:
            raise InputError(
                "mounting_drift_arcsec_sqrt_h", "requires mounting_arcsec above 0"
            )
