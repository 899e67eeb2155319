"""Schema of the scene section `vehicle`: body, bearing, actuators, sensors and disturbances."""

from typing import Annotated, Literal

from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.units import (
    ZEROS,
    AboveZero,
    ConfigModel,
    Damping,
    Delay,
    Duration,
    Force,
    Imbalance,
    Inertia,
    Length,
    LinearImpulse,
    Mass,
    NotNegative,
    Number,
    NumberError,
    Position,
    Positive,
    PositiveLength,
    QuadraticDrag,
    Seed,
    Signed,
    Speed,
    Spin,
    Spins,
    Stiffness,
    Three,
    Time,
    Torque,
    ZeroOrMore,
    above,
    within,
)

# Keys of `vehicle`, and the ideal torques.
ActuatorsName = Literal["ideal", "wheels", "fans", "thrusters", "trims", "cmgs"]
TorqueLimit = AboveZero[Torque]
TorqueLevel = ZeroOrMore[Torque]
Friction = ZeroOrMore[Damping]
Bend = Annotated[Number, within(-3600, 3600)]
Deviation = Annotated[Length, within(-1e-3, 1e-3)]
LagTime = Annotated[Time, Field(ge=5e-3)]


class WheelsConfig(ConfigModel):
    """Reaction wheels: every hinge joint `wheel_*` of the model.

    Attributes
    ----------
    torque_limit, speed_limit_rpm
        Greatest motor torque and speed
    coulomb, viscous
        Bearing friction, T = coulomb sign(speed) + viscous speed
    stiction
        Torque from which a wheel at rest breaks away; the Coulomb friction if it is zero
    static_imbalance
        Mass times offset of the rotor's center of mass from its axle; its disturbance grows with the speed squared
    dynamic_imbalance
        Product of inertia between the axle and a line across it; its disturbance grows with the speed squared
    start_rpm
        Speed of each wheel at the start; at rest if left out
    """

    torque_limit_nm: TorqueLimit = 0.5
    speed_limit_rpm: Positive = 3000.0
    coulomb_nm: TorqueLevel = 0.0
    viscous_nms: Friction = 0.0
    stiction_nm: TorqueLevel = 0.0
    static_imbalance_kg_m: ZeroOrMore[Imbalance] = 0.0
    dynamic_imbalance_kg_m2: ZeroOrMore[Inertia] = 0.0
    start_rpm: tuple[Signed, ...] = ()

    def check(self) -> None:
        if any(abs(rpm) > self.speed_limit_rpm for rpm in self.start_rpm):
            raise InputError("start_rpm", f"beyond speed_limit_rpm {self.speed_limit_rpm:g}")
        if 0 < self.stiction_nm < self.coulomb_nm:
            raise InputError("stiction", f"below coulomb {self.coulomb_nm:g} N m")


class FansConfig(ConfigModel):
    """Fans: every site `fan_*` of the model exerts a thrust along its own z, in both directions.

    Attributes
    ----------
    thrust_limit
        Greatest thrust
    time_constant
        Time constant of the first-order lag between command and thrust
    """

    thrust_limit_n: AboveZero[Force] = 0.5
    time_constant_s: LagTime = 0.2


class ThrustersConfig(ConfigModel):
    """Cold-gas thrusters: every site `thruster_*` of the model pushes along its own z, with its valve open or closed.

    The defaults are `assumed` of a small nitrogen thruster with a solenoid valve, and a tank of 1.3 l at 200 bar.

    Attributes
    ----------
    thrust
        Thrust of an open valve
    minimum_impulse
        Impulse of the shortest pulse; shorter ones are saved up for a later period
    time_constant
        Time constant of the first-order lag between valve and thrust; 0 for none
    specific_impulse
        Thrust over weight flow of propellant; nitrogen of 293 K gives 80 s in vacuum, sqrt(2 c_p T) / g0, less in air
    propellant
        Propellant at the start
    supply
        `regulated`: the thrust is constant until the tank is empty; `blowdown`: proportional to the propellant left
    """

    thrust_n: AboveZero[Force] = 0.5
    minimum_impulse_ns: ZeroOrMore[LinearImpulse] = 2.5e-3
    time_constant_s: Delay = 3e-3
    specific_impulse_s: Duration = 60.0
    propellant_kg: AboveZero[Mass] = 0.3
    supply: Literal["regulated", "blowdown"] = "regulated"


class TrimsConfig(ConfigModel):
    """Motors that move the trim masses in flight: every slide joint `trim_*` of the model, from its place in `trim`.

    The defaults are `assumed` of a stepper motor with a lead screw of 2 mm at 5 turns a second.

    Attributes
    ----------
    travel
        Largest position in both directions
    speed_limit
        Greatest speed of the masses
    """

    travel_m: PositiveLength = 0.02
    speed_limit_m_s: AboveZero[Speed] = 0.01


class CmgsConfig(ConfigModel):
    """Control moment gyroscopes: hinge joints `gimbal_*`, each with the joint `rotor_*` of the same suffix.

    Attributes
    ----------
    rotor_rpm
        Speed of the rotors
    gimbal_rate_limit_deg_s, gimbal_time_constant
        Greatest gimbal rate, and time constant of the servos
    steering
        Method that computes the gimbal rates; a key of STEERING
    start_deg
        Gimbal angles at the start; those of the model if left out
    rotor_torque_limit
        Greatest motor torque on the rotors of variable-speed CMGs; the rotor speeds are constant if left out
    """

    rotor_rpm: Annotated[Number, above(0, 60_000)] = 2600.0
    gimbal_rate_limit_deg_s: Positive = 60.0
    gimbal_time_constant_s: LagTime = 0.01
    steering: Literal["pseudo_inverse", "singularity_robust"] = "singularity_robust"
    start_deg: tuple[Spin, ...] = ()
    rotor_torque_limit_nm: TorqueLimit | None = None


class TrimConfig(ConfigModel):
    """Motorized trim masses: every slide joint `trim_*` of the model, held at its position during a run.

    Attributes
    ----------
    position
        Position of each mass along the axis of its joint, from that in the model; `skysim balance` finds the balanced
        positions
    travel
        Largest position in both directions
    step
        Step of the motors; a mass is held at a multiple of it
    """

    position_m: tuple[Length, ...] = ()
    travel_m: PositiveLength = 0.02
    step_m: PositiveLength = 1e-6

    def check(self) -> None:
        if any(abs(position_m) > self.travel_m for position_m in self.position_m):
            raise InputError("position", f"beyond travel {1e3 * self.travel_m:g} mm")


class DragConfig(ConfigModel):
    """Air drag about each body axis independently: T = -(viscous + quadratic |rate|) rate."""

    viscous_nms: Friction = 0.0
    quadratic_nms2: ZeroOrMore[QuadraticDrag] = 0.0


class CableConfig(ConfigModel):
    """A cable attached to the vehicle: a torsional spring that rotates it back to (0, 0, 0) by the shorter rotation."""

    stiffness_nm_rad: AboveZero[Stiffness]


class AirCurrentConfig(ConfigModel):
    """Air currents: a random torque about each lab axis, correlated over the correlation time."""

    rms_nm: Three[TorqueLevel]
    correlation_s: Duration = 2.0


class DisturbancesConfig(ConfigModel):
    """Disturbance torques; each is off if it is left out.

    Attributes
    ----------
    turbine
        Turbine torque of the bearing's air jets, constant in the lab's axes
    earth_rotation
        Whether the lab rotates with the Earth (`site` has its latitude)
    cable, air_current
        Cable and air currents
    """

    turbine_nm: Three[Torque] = ZEROS
    earth_rotation: bool = False
    cable: CableConfig | None = None
    air_current: AirCurrentConfig | None = None


class GyroConfig(ConfigModel):
    """Three fiber-optic gyroscopes. The defaults are those of an LN-200, of which only the first two have a source.

    Attributes
    ----------
    arw_deg_sqrt_h
        Angle random walk
    bias_deg_h, bias_time
        Bias instability: standard deviation and correlation time of a Gauss-Markov process
    turn_on_bias_deg_h
        Standard deviation over units of the constant part of the bias, or its tolerance
    scale_ppm, misalignment_arcsec
        Standard deviations over units of the scale factor and misalignment of each axis, or their tolerances
    quantum_arcsec
        Step of the angle counter
    rate_limit_deg_s
        Rate at which the output saturates
    """

    arw_deg_sqrt_h: NotNegative = 0.07
    bias_deg_h: NotNegative = 1.0
    bias_time_s: Duration = 300.0
    turn_on_bias_deg_h: NumberError = 1.0  # assumed
    scale_ppm: NumberError = 100.0  # assumed
    misalignment_arcsec: NumberError = 20.0  # assumed
    quantum_arcsec: NotNegative = 0.4  # assumed
    rate_limit_deg_s: Positive = 1000.0  # assumed


class AccelerometerConfig(ConfigModel):
    """Three accelerometers, with errors named like those of the gyros. The defaults are `assumed`."""

    vrw_ug_sqrt_hz: NotNegative = 50.0
    bias_ug: NotNegative = 50.0
    bias_time_s: Duration = 60.0
    turn_on_bias_ug: NumberError = 300.0
    scale_ppm: NumberError = 300.0
    misalignment_arcsec: NumberError = 20.0
    quantum_um_s: NotNegative = 0.0
    limit_g: Positive = 40.0


class ImuConfig(ConfigModel):
    """An inertial measurement unit and the navigator that integrates it to 3-2-1 Euler angles.

    Attributes
    ----------
    rate_hz
        Rate of the samples
    earth_rate
        `none`: the gyros do not measure the Earth's rotation; `uncompensated`: they do, and the navigator treats it as
        that of the vehicle; `compensated`: the navigator subtracts it
    home_error_deg
        Roll, pitch, yaw error of the vehicle's attitude when the navigator was zeroed
    hardware_seed
        Seed of the unit's turn-on bias, scale factors and misalignments
    """

    rate_hz: Annotated[Number, within(10, 1000)] = 400.0
    gyro: GyroConfig = GyroConfig()
    accelerometer: AccelerometerConfig = AccelerometerConfig()
    earth_rate: Literal["none", "uncompensated", "compensated"] = "none"
    home_error_deg: Spins = ZEROS
    hardware_seed: Seed = 200


class GimbalsConfig(ConfigModel):
    """The axes of a two-axis mount: lab_from_body = Rz(azimuth) Ry(elevation), so that elevation 0 is the zenith.

    Attributes
    ----------
    azimuth_deg, elevation_deg
        Least and greatest angle
    rate_limit_deg_s
        Greatest rate of each axis
    resolution_arcsec
        Step of both angles
    backlash_arcsec
        Play of the gears, through which an axis does not follow after each reversal
    """

    azimuth_deg: tuple[Signed, Signed] = (-180.0, 180.0)
    elevation_deg: tuple[Spin, Spin] = (-90.0, 90.0)
    rate_limit_deg_s: Positive = 30.0
    resolution_arcsec: NotNegative = 0.0
    backlash_arcsec: NotNegative = 0.0


class VehicleConfig(ConfigModel):
    """The moving body: an MJCF file, and values of the scene that replace those of the file.

    Attributes
    ----------
    model
        Name of the MJCF file
    mount
        `air_bearing`: gravity and a tilt stop; `free`: neither; `two_axis`: follows a profile with `gimbals`
    mass, inertia, center_of_mass
        Mass properties with all trim masses at zero; those of the file if left out
    camera
        Entrance pupil on the body, with which the housing moves; that of the file if left out
    camera_rotation_deg
        Rotation vector from the axes of the file's camera to those of the scene's, in the axes of the file's camera
        (+x right, +y down, +z boresight): [0, 0, 55] rolls it about its boresight
    sag_arcsec
        Bending of a camera's bracket by 1 g across its boresight, about its x and y axes; aligned when level
    mast
        Distance of the pupil along the boresight from where the bracket bends, which moves it by the angle times this
    runout
        Deviations of the ball's radius along the body's axes, which displace the bearing's center as it turns
    torque_limit
        Limit of each ideal torque about body x, y, z
    wheels, fans, thrusters, cmgs
        Actuators that are switched on; joints of the others are locked
    trim, trims
        Trim masses at their places, and the motors that move them in flight
    gimbals
        Axes of mount two_axis
    """

    model: str
    mount: Literal["air_bearing", "free", "two_axis"] = "air_bearing"
    mass_kg: AboveZero[Mass] | None = None
    inertia_kg_m2: Three[Inertia] | None = None
    center_of_mass_m: Position | None = None
    camera_m: Position | None = None
    camera_rotation_deg: Spins = ZEROS
    sag_arcsec: tuple[Bend, Bend] = (0.0, 0.0)
    mast_m: Annotated[Length, within(-10, 10)] = 0.0
    runout_m: Three[Deviation] = ZEROS
    tilt_stop_deg: Annotated[Number, Field(gt=0, lt=90)] = 30.0
    torque_limit_nm: TorqueLimit = 1.0
    wheels: WheelsConfig | None = None
    fans: FansConfig | None = None
    thrusters: ThrustersConfig | None = None
    cmgs: CmgsConfig | None = None
    trim: TrimConfig | None = None
    trims: TrimsConfig | None = None
    drag: DragConfig = DragConfig()
    disturbances: DisturbancesConfig = DisturbancesConfig()
    imu: ImuConfig | None = None
    gimbals: GimbalsConfig | None = None

    @property
    def is_bent(self) -> bool:
        """Whether camera and bearing move in the vehicle with its attitude."""
        return any((*self.sag_arcsec, *self.runout_m))

    def check(self) -> None:
        inertia = self.inertia_kg_m2
        if inertia and (min(inertia) <= 0 or 2 * max(inertia) > sum(inertia)):
            raise InputError(
                "inertia",
                f"{inertia} is not possible for a rigid body",
                "positive, none above the sum of the others",
            )
        if self.mount != "free":
            return
        if self.is_bent:
            raise InputError(
                "sag_arcsec", "a free vehicle has no weight", "mount: air_bearing"
            )
        if self.disturbances != DisturbancesConfig():
            raise InputError("disturbances", "a free vehicle has none", "mount: air_bearing")
        if self.imu and self.imu.earth_rate != "none":
            raise InputError("imu.earth_rate", "a free vehicle is not on the Earth", "none")
        if self.trim or self.trims:
            raise InputError(
                "trim" if self.trim else "trims",
                "a free vehicle rotates about its center of mass",
                "mount: air_bearing",
            )


class SiteConfig(ConfigModel):
    """Place of the lab on the Earth.

    Attributes
    ----------
    longitude_deg
        East longitude; without it `light.bodies` are seen from the Earth's center
    height
        Height above the ellipsoid
    x_azimuth_deg
        Azimuth of the lab's x axis from north through east
    """

    latitude_deg: Annotated[Number, within(-90, 90)] = 39.8
    longitude_deg: Annotated[Number, within(-180, 360)] | None = None
    height_m: Annotated[Length, within(-500, 10_000)] = 0.0
    x_azimuth_deg: Spin = 90.0
