"""The project's conventions, each checked by a hand calculation. Read this file first."""

import re

import mujoco
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.types import ra_dec_roll_rad
from skysim.camera.optics import Optics
from skysim.camera.render import Window, render
from skysim.core.paths import ROOT
from skysim.core.types import Mount, Sources, Trajectory
from skysim.dynamics import multibody
from skysim.scene import opencv_calibration
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.sources.stars import cam_from_icrs

# A pinhole whose arithmetic can be done in the head: f = 1000 px, middle of the chip at (320, 240).
OPTICS = Optics.from_camera(
    CameraConfig.model_validate(
        {
            "width_px": 641,
            "height_px": 481,
            "pixel": "10 um",
            "focal_length": "10 mm",
            "f_number": 2,
            "detector": {
                "quantum_efficiency": 0.5,
                "full_well_e": 40000,
                "gain_e_dn": 10,
                "bits": 12,
            },
        }
    )
)
BELIEVED = Camera(641, 481, 1000.0, (320.0, 240.0))
EXACT = 1e-12  # double precision on numbers of order one


def icrs(ra_deg: float, dec_deg: float) -> np.ndarray:
    """Unit vector: x to RA 0, y to RA 90, z to the north pole."""
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


@pytest.mark.parametrize(
    ("vector_cam", "pixel"),
    [
        ([0.0, 0.0, 1.0], (320.0, 240.0)),  # on the boresight: the principal point
        ([0.01, 0.0, 1.0], (330.0, 240.0)),  # to the right: larger x
        ([0.0, -0.01, 1.0], (320.0, 230.0)),  # above: smaller y
        ([0.02, 0.03, 2.0], (330.0, 255.0)),  # only the direction counts
    ],
)
def test_the_pixel_of_a_direction_matches_a_hand_calculation(vector_cam, pixel):
    """Both implementations of the projection, of the hardware and of the tracker, agree."""
    vector = np.array([vector_cam])
    np.testing.assert_allclose(OPTICS.project(vector)[0], pixel, rtol=0, atol=1e-9)
    np.testing.assert_allclose(BELIEVED.pixels(vector)[0], pixel, rtol=0, atol=1e-9)


def test_pixel_zero_is_the_middle_of_the_first_pixel():
    """0-based, the integer is the pixel's center: the chip reaches from -0.5 to width - 0.5."""
    edges = np.array([[-0.5, -0.5], [-0.51, 0.0], [640.5, 480.5], [640.51, 0.0]])
    assert BELIEVED.contains(edges).tolist() == [True, False, True, False]


def test_arrays_are_indexed_row_first():
    """A light 313 px left of the boresight and 237 px above it is at (x, y) = (7, 3) and brightens image[3, 7]."""
    image = np.zeros((481, 641))
    still = Trajectory(np.array([0.0, 1.0]), Rotation.identity(2), np.zeros((2, 3)))
    one = np.ones(1)
    star = np.array([[-0.313, -0.237, 1.0, 0.0]])
    id = np.array([7])
    place = star / np.linalg.norm(star)
    light = Sources(
        id, place, np.zeros((1, 3)), 0 * one, 1e9 * one, one, 0 * one, one, 0 * id, 0 * one
    )
    seen = render(
        image, light, OPTICS, still, Mount(np.zeros(3), Rotation.identity()), Window(0.0, 1.0)
    )
    np.testing.assert_allclose(seen.xy_px, [[7.0, 3.0]], rtol=0, atol=1e-9)
    assert np.unravel_index(image.argmax(), image.shape) == (3, 7)
    assert seen.peak_xy.tolist() == [[7, 3]]


def test_camera_axes_for_a_camera_at_the_origin_of_right_ascension():
    """Boresight RA 0, Dec 0, north up: right is west (-y of ICRS), down is south (-z), boresight is +x."""
    expected = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    np.testing.assert_allclose(
        cam_from_icrs(0, 0, 0).as_matrix(), expected, rtol=0, atol=EXACT
    )


def test_north_is_up_and_east_is_left():
    """Seen from inside the sphere, as on the sky and unlike on a map of the ground."""
    look = cam_from_icrs(0, 0, 0)
    north, east = OPTICS.project(look.apply([icrs(0, 1), icrs(1, 0)]))
    offset = 1000 * np.tan(np.radians(1))  # 17.4551 px
    np.testing.assert_allclose(north, (320, 240 - offset), rtol=0, atol=1e-9)
    np.testing.assert_allclose(east, (320 - offset, 240), rtol=0, atol=1e-9)


def test_roll_is_the_position_angle_of_up_from_north_through_east():
    """At roll 90 the image's up points east: a star to the east is above, a star to the north is right."""
    look = cam_from_icrs(0, 0, 90)
    north, east = OPTICS.project(look.apply([icrs(0, 1), icrs(1, 0)]))
    offset = 1000 * np.tan(np.radians(1))
    np.testing.assert_allclose(east, (320, 240 - offset), rtol=0, atol=1e-9)
    np.testing.assert_allclose(north, (320 + offset, 240), rtol=0, atol=1e-9)


def test_the_image_of_three_stars_is_not_mirrored():
    """From the Belt (Mintaka, west, to Alnitak, east) Betelgeuse is north: counter-clockwise on the sky.

    Seen north up, Mintaka is right of Alnitak and Betelgeuse above both; a mirrored image would not do.
    """
    mintaka = icrs(83.00, -0.30)
    alnitak = icrs(85.19, -1.94)
    betelgeuse = icrs(88.79, 7.41)
    pixels = OPTICS.project(cam_from_icrs(85, 2, 0).apply([mintaka, alnitak, betelgeuse]))
    assert pixels[0, 0] > pixels[1, 0] > pixels[2, 0]
    assert pixels[2, 1] < pixels[0, 1] < pixels[1, 1]


def test_the_tracker_s_attitude_is_the_simulator_s_pointing():
    """Vega at the center (RA 279.2347, Dec +38.7837), up at position angle -25, in both directions of conversion."""
    look = Rotation.from_matrix(hand_made(279.2347, 38.7837, -25.0))
    np.testing.assert_allclose(
        np.degrees(ra_dec_roll_rad(look)), (279.2347, 38.7837, -25.0), rtol=0, atol=1e-10
    )
    assert (look * cam_from_icrs(279.2347, 38.7837, -25.0).inv()).magnitude() < EXACT


def hand_made(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """Rows right, down, boresight by elementary rotations: Rz(-roll) applied to (west, south, out)."""
    turn = Rotation.from_euler("z", ra_deg, degrees=True) * Rotation.from_euler(
        "y", -dec_deg, degrees=True
    )
    out, east, north = turn.apply(np.eye(3))  # where x, y, z of a frame at RA 0, Dec 0 go
    c = np.cos(np.radians(roll_deg))
    s = np.sin(np.radians(roll_deg))
    up = c * north + s * east
    right = s * north - c * east
    return np.array([right, -up, out])


def test_a_known_star_is_at_its_known_pixel():
    """Sirius (101.2872, -16.7161) seen from a boresight 2 deg south of it, north up: 34.92 px above the middle."""
    sirius = cam_from_icrs(101.2872, -18.7161, 0).apply(icrs(101.2872, -16.7161))
    expected = (320.0, 240 - 1000 * np.tan(np.radians(2)))  # 34.9208 px
    np.testing.assert_allclose(OPTICS.project(sirius[None])[0], expected, rtol=0, atol=1e-9)


def test_quaternions_have_their_documented_order():
    """A quarter turn about z: SciPy and the papers (x, y, z, w), MuJoCo (w, x, y, z)."""
    half = np.sqrt(0.5)
    quarter = Rotation.from_euler("z", 90, degrees=True)
    np.testing.assert_allclose(quarter.as_quat(), [0, 0, half, half], rtol=0, atol=EXACT)
    np.testing.assert_allclose(
        quarter.as_quat(scalar_first=True), [half, 0, 0, half], rtol=0, atol=EXACT
    )
    quat_wxyz = np.array([half, 0, 0, half])
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.array([1.0, 0, 0]), quat_wxyz)
    np.testing.assert_allclose(turned, [0, 1, 0], rtol=0, atol=EXACT)
    np.testing.assert_allclose(quarter.apply([1, 0, 0]), [0, 1, 0], rtol=0, atol=EXACT)


def test_rotation_names_chain_by_equal_frames():
    """v_a = a_from_b.apply(v_b), and neighbors cancel: cam_from_lab = cam_from_body * body_from_lab."""
    lab_from_body = Rotation.from_euler(
        "z", 90, degrees=True
    )  # the vehicle has yawed to the left
    cam_from_body = Rotation.identity()
    cam_from_lab = cam_from_body * lab_from_body.inv()
    # Something along lab y lies straight ahead of body x, which is the camera's right.
    np.testing.assert_allclose(cam_from_lab.apply([0, 1, 0]), [1, 0, 0], rtol=0, atol=EXACT)


def test_mujocos_camera_axes_convert_to_ours():
    """SimSat level: its camera is 15 in up, looks at the zenith, the image's right along lab x, down along lab y.

    MuJoCo's own camera (+y up, looks along -z) then has its x along lab x, y along lab -y, z along lab -z.
    """
    config = VehicleConfig.model_validate({"model": "vehicles/simsat.xml"})
    vehicle = multibody.build(config)
    data = mujoco.MjData(vehicle.model)
    mujoco.mj_forward(vehicle.model, data)
    axes = data.camera("star_camera").xmat.reshape(3, 3)
    np.testing.assert_allclose(axes, np.diag([1.0, -1.0, -1.0]), rtol=0, atol=EXACT)
    mount = multibody.camera_mount(vehicle)
    np.testing.assert_allclose(mount.camera_body_m, [0, 0, 0.381], rtol=0, atol=EXACT)
    np.testing.assert_allclose(mount.cam_from_body.as_matrix(), np.eye(3), rtol=0, atol=EXACT)


def flown(
    parts: dict[str, object], motor: int, control: float
) -> tuple[multibody.VehicleModel, multibody.Simulation]:
    """A second of a free SimSat, initially at rest, with one motor driven."""
    given = {
        "model": "vehicles/simsat.xml",
        "mount": "free",
        "inertia": ["6 kg m2", "6.5 kg m2", "9 kg m2"],
        "center_of_mass": ["0 m", "0 m", "0 m"],
    }
    vehicle = multibody.build(VehicleConfig.model_validate(given | parts))
    flight = multibody.Simulation(vehicle, Rotation.identity(), np.zeros(3), 1.0)
    controls = np.zeros((1000, vehicle.model.nu))
    controls[:, motor] = control
    flight.advance(controls)
    return vehicle, flight


def test_a_wheel_spun_up_turns_the_body_the_other_way():
    """+0.1 N m for 1 s on wheel z (0.010125 kg m2, the vehicle without it 8.989875): both right-handed about z."""
    vehicle, flight = flown({"wheels": {}}, 5, 0.1)
    assert flight.rate_body_rad_s[2] == pytest.approx(-0.1 / 8.989875, rel=1e-9)
    assert flight.speeds_rad_s[vehicle.wheels.dof[2]] == pytest.approx(
        0.1 / 0.010125 + 0.1 / 8.989875, rel=1e-9
    )


def test_a_fan_pushes_the_vehicle_along_its_own_z():
    """fan_x_1 sits at +y and blows the vehicle up: y cross z is x, so the roll grows."""
    _, flight = flown({"fans": {"time_constant": "5 ms"}}, 3, 0.1)
    assert flight.rate_body_rad_s[0] == pytest.approx(0.1 * 0.46 * (1 - 5e-3) / 6, rel=1e-4)


def test_a_turned_gimbal_gives_the_body_the_opposite_of_the_rotor_s_momentum_change():
    """Rotor 1 has h = 0.00225 kg m2 * 2600 rpm = 0.6126 N m s along +y; gimbal 1 leans from z to x: (s, 0, c).

    A positive gimbal rate moves h along g x h = h (-c, 0, s), s = 0.8165, c = 0.5774; the body gains the opposite,
    after a turn of 0.1 rad +0.035 N m s about x, -0.049 about z. The little that the moving gimbal itself holds, a
    hundredth, is left out.
    """
    _, flight = flown(
        {"cmgs": {"rotor_rpm": 2600}, "inertia": ["600 kg m2", "650 kg m2", "900 kg m2"]},
        3,
        0.1,
    )
    momentum = flight.rate_body_rad_s * [600, 650, 900]
    turned = 0.1 * (1 - 2 * 0.01)  # the servo is two time constants late
    expected = 0.6126106 * np.array(
        [np.sin(turned) * 0.5773503, 0, -np.sin(turned) * 0.8164966]
    )
    np.testing.assert_allclose(momentum[[0, 2]], expected[[0, 2]], rtol=0.01, atol=0)


def test_the_motion_of_an_apex_led_by_a_tilt_matches_a_hand_calculation():
    """Roll +10 deg about lab x lifts lab +y: body z leans to -y, so the apex LED falls on the image's +y side.

    Camera 0.381 m up a vehicle tilted by 10 deg stands at (0, -0.381 sin 10, 0.381 cos 10). The apex LED, 1.2192 m
    up, is seen in body axes at (0, 1.2192 sin 10, 1.2192 cos 10 - 0.381), so v = 1000 * .21171 / .81968 below.
    """
    from estimator.attitude.dome_map import Lever, project

    body_from_lab = Rotation.from_euler("x", 10, degrees=True).inv()
    lever = Lever(np.array([0, 0, 0.381]), Rotation.identity())
    pixel = project(body_from_lab, np.array([[0, 0, 1.2192]]), lever, BELIEVED)[0]
    np.testing.assert_allclose(
        pixel, (320.0, 240 + 1000 * 0.2117119 / 0.8196768), rtol=0, atol=1e-3
    )


PICKLING = {
    "playback.py": "reads what the same process wrote to an unnamed temporary file",
}


def test_reading_data_executes_no_code():
    """YAML uses the safe loader, arrays and results do not use pickle, and no text is executed."""
    loads = r"yaml\.(unsafe_|full_)?load\((?!.*, Loader\))|pickle\b|marshal\b|shelve\b|allow_pickle=True"
    banned = rf"\b({loads}|(?<![.\w])(eval|exec)\()"
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for room in ("skysim", "estimator")
        for path in sorted((ROOT / room).rglob("*.py"))
        if path.name not in PICKLING
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(banned, line.partition("#")[0])
    ]
    assert found == []
    assert issubclass(opencv_calibration.Loader, yaml.SafeLoader)
