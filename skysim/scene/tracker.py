"""Schema of the scene sections `tracker` and `filter`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from skysim.core.units import ConfigModel, Length, NotNegative, Number, Positive, Spin, Time
from skysim.core.yaml_reader import is_file


def existing_file(value: str) -> str:
    """A path that is there."""
    if not is_file(Path(value)):
        raise ValueError(f"{value!r} is no file; allowed: one beside the scene, or a path")
    return value


class SurveyErrorsConfig(ConfigModel):
    """How well the lab knows what it built. Drawn once, from a seed of its own; `light.surface.error` from it too.

    led_sigma    : standard deviation of every LED's believed place, about each axis of the lab
    lever_sigma  : of the camera's believed place, about each axis of the body
    turn_deg     : rotation vector by which the survey's axes stand turned in the lab's: what level or IMU it was
        referred to erred by. All believed LEDs are turned with it
    surface_seed : draws `light.surface.error`; `seed` if left out
    """

    turn_deg: tuple[Spin, Spin, Spin] = (0.0, 0.0, 0.0)
    surface_seed: Annotated[int, Field(ge=0)] | None = None
    led_sigma_m: Annotated[Length, Field(ge=0, le=0.1)] = 0.0
    lever_sigma_m: Annotated[Length, Field(ge=0, le=0.1)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0


class ExposureControlConfig(ConfigModel):
    """How long to expose, decided on the frame before: SHEFEX-2's chart, `estimator.trackers.exposure_control` (Samaan & Theil 2011).

    `exposure.time` is the first frame's. Too bright is a step shorter, else too few stars a step longer. What the
    exposure of a frame is hangs on all frames before it, so frame 57 does not render alone with this section.

    mean_dn             : of a frame, above which it is no picture of stars: twice its bias and sky, say
    least_stars         : fewer cannot be identified
    overexposed_objects : so many with more than saturated_px full pixels each are too many
    """

    mean_dn: Positive
    shortest_s: Annotated[Time, Field(ge=10e-6)] = 10e-6
    longest_s: Annotated[Time, Field(le=10.0)] = 50e-3
    step_s: Annotated[Time, Field(ge=1e-6)] = 2e-3
    least_stars: Annotated[int, Field(ge=1)] = 4
    overexposed_objects: Annotated[int, Field(ge=1)] = 4
    saturated_px: Annotated[int, Field(ge=0)] = 1

    @model_validator(mode="after")
    def in_order(self) -> ExposureControlConfig:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest {self.shortest_s:g} s is above longest {self.longest_s:g} s")
        return self


class TrackerConfig(ConfigModel):
    """What the star tracker's computer does and believes. `null` believes what the hardware is.

    name : own, or a tracker of somebody else's: an entry point, or a program that the command line names (`--program`)
    options, time_limit : what such a tracker is told, and for how long it may look at a frame
    map : a file that `skysim survey` wrote: LEDs, lever, focal length and distortion as measured
    detector, centroider, identifier, solver : if left out, under a dome local, cog, led_pairs and rotation_only, and
        under the stars all of them `default`
    believed_distortion : k1, k2, p1, p2, k3 of the lens; as it is if left out
    brightest : no more lights of a frame than that are looked at
    exposure_control : every frame is exposed for `exposure.time` if left out
    """

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")] = "own"
    options: dict[str, bool | int | Number | str] = Field(default_factory=dict)
    time_limit_s: Annotated[Time, Field(ge=1e-3, le=3600)] = 10.0
    detector: str | None = None
    centroider: str | None = None
    identifier: str | None = None
    solver: str | None = None
    threshold_sigma: Annotated[Number, Field(gt=0)] = 5.0
    min_area_px: Annotated[int, Field(ge=1)] = 3
    limit_mag: Number = 6.0
    centroid_sigma_px: Annotated[Number, Field(gt=0)] = 0.2
    believed_focal_length_m: Annotated[Length, Field(gt=0)] | None = None
    believed_distortion: tuple[Number, Number, Number, Number, Number] | None = None
    brightest: Annotated[int, Field(ge=3, le=1000)] | None = None
    believed_camera_body_m: tuple[Length, Length, Length] | None = None
    survey: SurveyErrorsConfig = SurveyErrorsConfig()
    exposure_control: ExposureControlConfig | None = None
    map: Annotated[str, AfterValidator(existing_file)] | None = None

    @model_validator(mode="after")
    def one_lever(self) -> TrackerConfig:
        if self.believed_camera_body_m is not None and self.survey.lever_sigma_m:
            raise ValueError(
                "survey.lever_sigma: believed_camera_body tells the place; allowed: one of the two"
            )
        return self

    @model_validator(mode="after")
    def one_map(self) -> TrackerConfig:
        told = {
            "believed_focal_length": self.believed_focal_length_m,
            "believed_camera_body": self.believed_camera_body_m,
            "believed_distortion": self.believed_distortion,
            "survey.led_sigma": self.survey.led_sigma_m,
            "survey.lever_sigma": self.survey.lever_sigma_m,
        }
        beside = [key for key, value in told.items() if value]
        if self.map and beside:
            raise ValueError(f"{beside[0]}: the file of tracker.map tells it; allowed: one of the two")
        return self


class FilterConfig(ConfigModel):
    """What the attitude filter believes of the gyro and of the star tracker (MEKF: attitude and gyro bias).

    The bias is believed to wander about zero in body axes. The Earth's turning where imu.earth_rate is uncompensated is
    learnt as bias while the attitude stays; a vehicle that turns takes it for another one, unless bias_deg_h has room
    for it (15) and bias_time is that of the turning. So with the gyro's scale and misalignment.

    arw_deg_sqrt_h, bias_deg_h, bias_time : of the gyro; the bias a Gauss-Markov process
    start_deg, start_bias_deg_h           : standard deviation of attitude and bias about each axis at the start
    floor_arcsec : of a star tracker's solution, added to its own covariance: what is the same in every frame
    gate_sigma   : a solution farther off than this is refused
    latency      : from the end of an exposure to its solution
    """

    arw_deg_sqrt_h: NotNegative = 0.07
    bias_deg_h: NotNegative = 1.0
    bias_time_s: Annotated[Time, Field(gt=0)] = 300.0
    start_deg: Positive = 1.0
    start_bias_deg_h: Positive = 10.0
    floor_arcsec: NotNegative = 1.0
    gate_sigma: Positive = 5.0
    latency_s: Annotated[Time, Field(ge=0)] = 0.0
