"""Draw the figures of the explanations with the simulator's code. `make figures` runs it."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.camera.render import Window, render
from skysim.core.types import Floats, Mount, Sources, Trajectory
from skysim.dynamics import multibody
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.surroundings import ExclusionConfig
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.flight import simulate_motion
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.effects import stray_e_s
from skysim.simulation.lights.light import Exposure, beam_of
from skysim.sources import air as air_physics
from skysim.sources import stars as star_sources
from skysim.sources.camera_orbit import Pointing, sample
from skysim.sources.catalog import read
from skysim.sources.dome import surface
from skysim.sources.photometry import (
    Band,
    black_body_v0,
    chromatic_shifts,
    led_chromatic,
    measured,
    star_chromatic,
    temperature_k,
)
from skysim.sources.refraction import Refraction, Weather
from skysim.sources.satellites import GHOST, MIRRORED

mpl.rcParams.update(
    {
        "svg.fonttype": "none",
        "svg.hashsalt": "skysim",
        "font.family": "sans-serif",
        "font.size": 11,
    }
)
# An opaque background for labels.
LABEL_BOX = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
INK = "#333333"
LAB = "#666666"
BODY = "#1f6fb2"
CAM = "#c0392b"
LIGHT = "#d68910"
ORION = {
    "Betelgeuse": 27989, "Rigel": 24436, "Bellatrix": 25336, "Saiph": 27366,
    "Mintaka": 25930, "Alnilam": 26311, "Alnitak": 26727,
}  # fmt: skip


def axes(path: Path) -> None:
    """Lab, body and camera axes of SimSat, yawed by 30 and rolled by 20 degrees."""
    mount = multibody.camera_mount(multibody.build(loader.load("afit_simsat").vehicle))
    lab_from_body = Rotation.from_euler("ZYX", [30, 0, 20], degrees=True)
    lab_from_cam = lab_from_body * mount.cam_from_body.inv()
    camera_m = lab_from_body.apply(mount.camera_body_m)
    azimuth, height = np.radians([-38, 24])  # from where it is looked at
    toward = np.array(
        [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    flat = np.column_stack(
        [right, np.cross(toward, right)]
    )  # (3, 2) from the lab to the paper
    frames = (
        ("lab", Rotation.identity(), np.zeros(3), LAB, 0.26),
        ("body", lab_from_body, np.zeros(3), BODY, 0.24),
        ("cam", lab_from_cam, camera_m, CAM, 0.2),
    )
    fig, ax = plt.subplots(figsize=(6.4, 5.6))
    ax.plot(
        *np.transpose([np.zeros(2), camera_m @ flat]), color=INK, linestyle=":", linewidth=1.4
    )
    for name, lab_from_own, origin_m, color, length_m in frames:
        begin = origin_m @ flat
        for letter, axis in zip("xyz", lab_from_own.apply(np.eye(3)), strict=True):
            end = begin + length_m * axis @ flat
            ax.annotate(
                "",
                end,
                begin,
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": color,
                    "lw": 2,
                    "shrinkA": 0,
                    "shrinkB": 0,
                },
            )
            ax.annotate(
                f"{name} {letter}",
                end,
                (5 if end[0] >= begin[0] - 1e-9 else -5, 3 if end[1] >= begin[1] else -3),
                textcoords="offset points",
                color=color,
                ha="left" if end[0] >= begin[0] - 1e-9 else "right",
                va="center",
            )
    ax.plot(0, 0, "o", color=INK)
    ax.text(-0.012, -0.012, "bearing's center", color=INK, ha="right", va="top")
    ax.text(
        *(0.35 * camera_m @ flat - [0.015, 0.0]),
        f"lever {np.linalg.norm(camera_m):.3f} m",
        color=INK,
        ha="right",
    )
    ax.set(xlim=(-0.26, 0.32), ylim=(-0.2, 0.56), aspect="equal")
    ax.set_axis_off()
    save(fig, path)


def optics_with_detector() -> Optics:
    """A small detector and a lens with round numbers: f = 1000 px, principal point (3, 2)."""
    detector = {"quantum_efficiency": 0.5, "full_well_e": 40000, "gain_e_dn": 10, "bits": 12}
    config = {
        "width_px": 16,
        "height_px": 16,
        "principal_point_px": [3, 2],
        "pixel": "10 um",
        "focal_length": "10 mm",
        "f_number": 2,
    }
    return Optics.from_camera(CameraConfig.model_validate(config | {"detector": detector}))


def pixels(path: Path) -> None:
    """A star drawn by the renderer, in a corner of seven by five pixels."""
    optics = optics_with_detector()
    direction = np.array(
        [[1.3e-3, -0.6e-3, 1.0]]
    )  # 1.3 px right of the boresight, 0.6 px above it
    direction /= np.linalg.norm(direction)
    ones = np.ones(1)
    image = np.zeros((16, 16))
    still = Trajectory(np.array([0.0, 1.0]), Rotation.identity(2), np.zeros((2, 3)))
    star = Sources(
        np.array([1]),
        np.column_stack([direction, [0.0]]),
        np.zeros((1, 3)),
        0 * ones,
        1e9 * ones,
        ones,
        0 * ones,
        ones,
        np.zeros(1, np.int64),
        0 * ones,
    )
    visible = render(
        image, star, optics, still, Mount(np.zeros(3), Rotation.identity()), Window(0.0, 1.0)
    )
    (x, y), (column, row) = visible.xy_px[0], visible.peak_xy[0]
    fig, ax = plt.subplots(figsize=(6.4, 4.6))
    ax.imshow(image[:5, :7], cmap="gray_r", vmax=1.6 * image.max())
    ax.set_xticks(np.arange(7))
    ax.set_yticks(np.arange(5))
    ax.set_xticks(np.arange(8) - 0.5, minor=True)
    ax.set_yticks(np.arange(6) - 0.5, minor=True)
    ax.grid(which="minor", color="#999999", linewidth=0.8)
    ax.tick_params(which="minor", length=0)
    ax.xaxis.tick_top()
    ax.plot(*np.mgrid[:7, :5].reshape(2, -1), ".", color=BODY, markersize=4)
    ax.plot(x, y, "+", color=CAM, markersize=13, markeredgewidth=2)
    ax.annotate(
        f"star at (x, y) = ({x:.1f}, {y:.1f})",
        (x, y),
        (x - 3.9, y + 1.5),
        color=CAM,
        bbox=LABEL_BOX,
        arrowprops={"arrowstyle": "-", "color": CAM},
    )
    ax.annotate(
        f"brightest: image[{row}, {column}]",
        (column, row),
        (column - 1.4, row + 3.0),
        color=INK,
        bbox=LABEL_BOX,
        arrowprops={"arrowstyle": "-", "color": INK},
    )
    ax.annotate(
        "corner (-0.5, -0.5)",
        (-0.5, -0.5),
        (-0.2, 0.3),
        color=INK,
        bbox=LABEL_BOX,
        arrowprops={"arrowstyle": "-", "color": INK},
    )
    ax.plot(*optics.project(np.array([0.0, 0.0, 1.0])), "x", color=BODY, markersize=9)
    ax.text(2.8, 2.0, "boresight (3, 2)", color=BODY, ha="right", va="center", bbox=LABEL_BOX)
    ax.set_xlabel("x, right: columns", loc="left")
    ax.xaxis.set_label_position("top")
    ax.set_ylabel("y, down: rows", loc="top")
    save(fig, path)


def roll(path: Path) -> None:
    """Orion at roll 0 and at roll 30, in the image, with north, east and the image's up."""
    stars = read("hipparcos_hp6.5")
    camera = loader.load("shefex2", {"camera.focal_length": "14 mm"}).camera
    optics = Optics.from_camera(camera)
    rows = [int(np.flatnonzero(stars.hip == number)[0]) for number in ORION.values()]
    directions = unit(stars.ra_rad, stars.dec_rad)
    fig, panels = plt.subplots(1, 2, figsize=(9.2, 3.9), layout="constrained")
    for ax, roll_deg in zip(panels, (0, 30), strict=True):
        cam_from_icrs = star_sources.cam_from_icrs(84.0, 0.0, roll_deg)
        xy = optics.project(cam_from_icrs.apply(directions))
        bright = (stars.v_mag < 5) & (np.abs(xy - camera.center_px) < camera.center_px).all(
            axis=1
        )
        ax.scatter(
            *xy[bright].T, s=2 + 6 * (5 - stars.v_mag[bright]) ** 1.3, color=INK, linewidths=0
        )
        for name, place in zip(
            ORION, optics.project(cam_from_icrs.apply(directions[rows])), strict=True
        ):
            if name not in ("Alnilam", "Mintaka"):
                # Where no arrow and no star stands.
                side = -1 if name in ("Betelgeuse", "Alnitak") else 1
                ax.annotate(
                    name,
                    place,
                    (9 * side, 3),
                    textcoords="offset points",
                    fontsize=9,
                    color=INK,
                    ha="left" if side > 0 else "right",
                )
        middle = np.array(camera.center_px)
        for name, ra_deg, dec_deg in (("N", 84.0, 7.6), ("E", 91.0, 0.0)):
            end = optics.project(
                cam_from_icrs.apply(unit(*np.radians([[ra_deg], [dec_deg]])))
            )[0]
            ax.annotate(
                "", end, middle, arrowprops={"arrowstyle": "->", "color": BODY, "lw": 1.8}
            )
            ax.text(
                *(middle + 1.15 * (end - middle)), name, color=BODY, ha="center", va="center"
            )
        ax.annotate(
            "",
            middle - [0, 120],
            middle,
            arrowprops={"arrowstyle": "->", "color": CAM, "lw": 1.8},
        )
        ax.text(
            middle[0] - 12, middle[1] - 100, "up (-y)", color=CAM, ha="right", va="center"
        )
        if roll_deg:
            angles = np.radians(np.linspace(0, roll_deg, 30))
            north = np.arctan2(
                *(
                    optics.project(cam_from_icrs.apply(unit(*np.radians([[84.0], [7.0]]))))[0]
                    - middle
                )
            )
            arc = middle + 95 * np.column_stack(
                [np.sin(north + angles), np.cos(north + angles)]
            )
            ax.plot(*arc.T, color=LIGHT, linewidth=2)
        ax.set(
            xlim=(-0.5, camera.width_px - 0.5),
            ylim=(camera.height_px - 0.5, -0.5),
            aspect="equal",
        )
        ax.set_title(f"roll {roll_deg}°", color=LIGHT)
        ax.set_xticks([])
        ax.set_yticks([])
    save(fig, path)


def unit(ra_rad: Floats, dec_rad: Floats) -> Floats:
    """(N, 3) unit vectors of right ascensions and declinations."""
    return np.column_stack(
        [np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)]
    )


def lever(path: Path) -> None:
    """AFIT's measured dome from the side, the vehicle level and rolled by 20 degrees: why LEDs are no stars."""
    afit = loader.load("afit_simsat")
    dome = surface.build_surface(afit.light.surface)
    mount = multibody.camera_mount(multibody.build(afit.vehicle))
    fig, ax = plt.subplots(figsize=(9.0, 4.6))
    tilts = np.radians(np.linspace(-60, 60, 241))
    along = np.column_stack([0 * tilts, np.sin(tilts), np.cos(tilts)])
    wall = dome.meet(np.zeros(3), along)  # NaN beneath the rim
    ax.plot(wall[:, 1], wall[:, 2], color=LAB, linewidth=2)
    led = wall[np.argmin(np.abs(tilts - np.radians(8)))]
    ax.plot(*led[1:], "o", color=LIGHT, markersize=8)
    ax.annotate("LED P", led[1:], (6, 8), textcoords="offset points", color=LIGHT)
    for roll_deg, color, at_pt, side in ((0.0, BODY, 14, "left"), (20.0, CAM, -14, "right")):
        lab_from_body = Rotation.from_euler("x", roll_deg, degrees=True)
        camera = lab_from_body.apply(mount.camera_body_m)
        bore = lab_from_body.apply([0.0, 0.0, 1.0])
        ax.plot(
            *np.transpose([np.zeros(3), camera])[1:],
            color=color,
            linewidth=5,
            alpha=0.5,
            solid_capstyle="round",
        )
        ax.plot(
            *np.transpose([camera, dome.meet(camera, bore[None])[0]])[1:],
            color=color,
            linestyle="--",
            linewidth=1,
        )
        ax.plot(*np.transpose([camera, led])[1:], color=color, linewidth=1.6)
        angle_deg = np.degrees(
            np.arccos((led - camera) @ bore / np.linalg.norm(led - camera))
        )
        label = f"roll {roll_deg:.0f}°: the LED {angle_deg:.2f}° off the boresight"
        ax.annotate(
            label, camera[1:], (at_pt, -12), textcoords="offset points", color=color, ha=side
        )
    bearing_angle_deg = np.degrees(np.arctan2(led[1], led[2]))
    ax.plot(*np.transpose([np.zeros(3), led])[1:], color=LAB, linestyle=":", linewidth=1.2)
    ax.text(
        0.05,
        -0.11,
        f"bearing's center O: from here it stands at {bearing_angle_deg:.2f}°",
        color=LAB,
    )
    ax.plot(0, 0, "o", color=INK)
    ax.set(
        aspect="equal",
        xlabel="lab y (m)",
        ylabel="lab z (m)",
        ylim=(-0.2, 1.32),
        xlim=(-1.35, 1.7),
    )
    save(fig, path)


def bodies(path: Path) -> None:
    """Moon, earthshine, full Moon and a solar eclipse through a 200 mm lens."""
    sunny = {
        "exposure.time": "1 us",
        "camera.f_number": "16",
        "camera.transmission": "0.0001",
    }
    eclipse = sunny | {"site.latitude_deg": "37", "site.longitude_deg": "-90"}
    views = (
        ("moon", "2012-06-24T21:00:00", {"exposure.time": "1 ms"}, "the Moon, 1 ms"),
        ("moon", "2012-06-24T21:00:00", {"exposure.time": "40 ms"}, "40 ms: earthshine"),
        ("moon", "2012-06-04T21:00:00", {"exposure.time": "10 us"}, "the full Moon, 10 µs"),
        ("sun", "2017-08-21T18:26:40", eclipse, "an eclipse of the Sun"),
    )
    fig, all_axes = plt.subplots(1, 4, figsize=(10, 2.8))
    for ax, (name, time, settings, title) in zip(all_axes, views, strict=True):
        small = {
            "camera.focal_length": "200 mm",
            "camera.width_px": "240",
            "camera.height_px": "240",
        }
        settings |= small | {
            "light.bodies": "{}",
            "start_time": time,
            "motion.rate_deg_s": "[0, 0, 0]",
        }
        lab = build_lab(loader.load("shefex2", settings))
        beam = beam_of(lab.camera.lights, exposure_at(lab, 0.0))
        shown = next(body for body in beam.discs if body.name == name)
        start = f"{{ra_deg: {shown.truth().ra_deg}, dec_deg: {shown.truth().dec_deg}}}"
        scene = loader.load(
            "shefex2", settings | {"motion.start": start, "exposure.frames": "1"}
        )
        image = simulate_motion(scene).render(0)[0].image_dn.astype(float)
        dark = np.percentile(image, 5)
        ax.imshow(np.sqrt(np.clip(image - dark, 0, None)), cmap="gray")
        ax.set(xticks=[], yticks=[], title=title)
    save(fig, path)


def color(path: Path) -> None:
    """Photo-electrons of four lights by wavelength, the lateral color of a lens, and the mean of each."""
    lens = "{wavelength: [450 nm, 550 nm, 650 nm, 850 nm], corner_px: [-0.38, -0.13, 0.12, 0.62]}"
    band = Band.from_camera(loader.load("shefex2", {"camera.chromatic": lens}).camera)
    nm = np.arange(390.0, 1000.0)
    lights = (
        ("star A0V", (0.0, 0.004), "#1f6fb2"),
        ("G2V", (0.65, 0.713), LIGHT),
        ("M1V", (1.485, 2.005), CAM),
        ("white LED", None, "#27ae60"),
    )
    fig, (spectra, shift) = plt.subplots(2, 1, figsize=(6.4, 5), sharex=True)
    shift.plot(nm, chromatic_shifts(band, nm * 1e-9)[1], color=INK)
    for name, colors, paint in lights:
        if colors:
            photons = black_body_v0(nm * 1e-9, temperature_k(*colors))
            moments = star_chromatic(*colors, band)
        else:
            photons = measured("white").response_at(nm * 1e-9) * nm
            moments = led_chromatic("white", band)
        electrons = photons * band.response_at(nm * 1e-9)
        spectra.plot(nm, electrons / electrons.max(), color=paint, label=name)
        shift.plot(
            np.interp(moments[1], chromatic_shifts(band, nm * 1e-9)[1], nm),
            moments[1],
            "o",
            color=paint,
        )
    spectra.set(ylabel="photo-electrons, relative")
    spectra.legend(frameon=False)
    shift.set(xlabel="wavelength [nm]", ylabel="shift at the corner [px]")
    fig.align_ylabels()
    save(fig, path)


def air(path: Path) -> None:
    """Refraction and extinction against altitude, and scintillation against the aperture."""
    refraction = Refraction(Weather(0.0, np.radians(53), 1013.25, 15.0, 0.5, 650e-9))
    altitude_deg = np.geomspace(2, 89.5, 300)
    fig, (bent, dimmed, twinkling) = plt.subplots(
        1, 3, figsize=(11, 3.1), layout="constrained"
    )
    apparent_rad = np.radians(altitude_deg)
    # The table has zenith distances without air; the curve is drawn against the altitude that is seen.
    raised_rad = refraction.bending_rad(np.pi / 2 - apparent_rad)
    for _ in range(3):
        raised_rad = refraction.bending_rad(np.pi / 2 - apparent_rad + raised_rad)
    bent.loglog(altitude_deg, np.degrees(raised_rad) * 3600, color=BODY)
    bent.set(title="refraction", ylabel="raised by (arcsec)")
    mass = air_physics.air_mass(apparent_rad)
    for extinction_mag, color in ((0.1, BODY), (0.17, LIGHT), (0.3, CAM)):
        dimmed.loglog(
            altitude_deg,
            extinction_mag * mass,
            color=color,
            label=f"{extinction_mag:g} mag an air mass",
        )
    dimmed.set(title="extinction", ylabel="fainter by (mag)")
    for ax in (bent, dimmed):
        ax.set(xlabel="altitude (deg)", xlim=(2, 90), xticks=[2, 5, 10, 20, 45, 90])
        ax.set_xticklabels(["2", "5", "10", "20", "45", "90"])
        ax.minorticks_off()
    aperture_m = np.geomspace(2e-3, 1, 25)
    ours = np.sqrt(
        [air_physics.variance(np.ones(1), d, 0.05, 0.0, 650e-9)[0] for d in aperture_m]
    )
    young = np.sqrt(
        air_physics.YOUNG_M_S * air_physics.C_Y**2 * aperture_m ** (-4 / 3) / 0.05
    )
    twinkling.loglog(100 * aperture_m, ours, color=BODY, label="simulated")
    twinkling.loglog(100 * aperture_m, young, color=LAB, linestyle="--", label="Young's law")
    twinkling.set(
        title="scintillation, zenith, 50 ms",
        xlabel="aperture (cm)",
        ylabel="standard deviation",
        ylim=(0.01, 2),
    )
    for ax in (dimmed, twinkling):
        ax.legend(frameon=False, fontsize=9)
    save(fig, path)


def orbit(path: Path) -> None:
    """Two revolutions of a camera that looks at one place: angles of Sun, Earth and Moon, and their stray light."""
    settings = {
        "orbit": "{kind: circular, altitude: 500 km, inclination_deg: 97.4, raan_deg: 20, earth: {albedo: 0.3}}",
        "light.bodies": "{planets: false}",
        "camera.baffle": "{angle_deg: [20, 40, 60, 90, 120], pst: [1e-4, 1e-6, 1e-8, 1e-10, 1e-12]}",
        "motion.start": "{ra_deg: 30, dec_deg: -35, roll_deg: 0}",
        "start_time": "2012-06-24T21:00:00",
    }
    lab = build_lab(loader.load("shefex2", settings))
    camera = lab.camera
    assert camera.orbit is not None
    cam_from_lab = camera.mount.cam_from_body * lab.start.inv()
    boresight = cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    t_s = np.arange(0, 2 * 5677, 20.0)
    seen = sample(
        camera.orbit,
        lab.scene.start_time,
        t_s,
        Pointing("inertial", boresight),
        boresight[None],
        0.1,
    )
    limits = ExclusionConfig(sun_deg=60, earth_deg=25, moon_deg=20)
    stray = [stray_e_s(camera.lights, exposure_at(lab, t)) for t in t_s.tolist()]
    fig, (angles, light) = plt.subplots(
        2, 1, figsize=(8.5, 5.4), sharex=True, layout="constrained"
    )
    outside = seen.outside(limits)
    usable = outside["Sun"] & outside["Earth"] & outside["Moon"]
    minutes = t_s / 60
    for ax in (angles, light):
        ax.fill_between(
            minutes,
            0,
            1,
            where=usable,
            transform=ax.get_xaxis_transform(),
            color="#d5e8d4",
            lw=0,
        )
    for name, color in (("sun", LIGHT), ("earth", BODY), ("moon", LAB)):
        label = "the Earth's limb" if name == "earth" else f"the {name.capitalize()}"
        angles.plot(minutes, getattr(seen, f"{name}_deg"), color=color, label=label)
        angles.axhline(
            getattr(limits, f"{name}_deg"), color=color, linestyle=":", linewidth=1
        )
        light.semilogy(
            minutes,
            [one.get(f"the {name.capitalize()}", np.nan) for one in stray],
            color=color,
        )
    angles.set(ylabel="from the boresight (deg)", ylim=(-80, 180))
    angles.legend(frameon=False, ncols=3, loc="upper right")
    light.set(ylabel="stray light (e⁻/s a pixel)", xlabel="minutes", xlim=(0, minutes[-1]))
    save(fig, path)


def reflections(path: Path) -> None:
    """A frame without noise under a dome: black, and with mirror images and ghosts of its LEDs."""
    deep = "{kind: sphere, apex: 5 ft, radius: 4 ft, rim_deg: 130}"
    settings = {
        "light.surface": deep,
        "exposure.frames": "1",
        "camera.detector.noise": "false",
    }
    settings |= {
        f"camera.detector.{key}": "0"
        for key in ("prnu", "dsnu", "hot_pixels", "column_offset_e")
    }
    lens = {"camera.ghosts": "[{magnification: 0.5, share: 0.02, radius_px: 6}]"}
    wall = {"light.reflection": "{specular: 0.1}"}
    fig, both = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    titles = "black wall, clean lens", "satin wall that mirrors 10 %, one ghost"
    for ax, changes, title in zip(both, ({}, wall | lens), titles, strict=True):
        frame, truth = simulate_motion(loader.load("apl_dome", settings | changes)).render(0)
        light = frame.image_dn.astype(float)
        light -= np.median(light)
        # Every pixel as large as seven, on a logarithmic scale, so that LEDs and ghosts are seen.
        ax.imshow(
            np.log10(np.clip(maximum_filter(light, 7), 1e-3, None)),
            cmap="gray_r",
            vmin=-3,
            vmax=3,
        )
        number = truth.sources.id
        kinds = (
            ("LED", number < MIRRORED, BODY),
            ("its image in the wall", (number >= MIRRORED) & (number < GHOST), LIGHT),
            ("its ghost", (number >= GHOST) & (number % GHOST < MIRRORED), CAM),
        )
        for name, chosen, color in kinds:
            ax.plot(
                *truth.sources.xy_px[chosen].T,
                "o",
                ms=13,
                mfc="none",
                mew=1.3,
                color=color,
                label=name,
            )
        height, width = light.shape
        ax.set(
            xticks=[],
            yticks=[],
            title=title,
            xlim=(-0.5, width - 0.5),
            ylim=(height - 0.5, -0.5),
        )
    both[1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    save(fig, path)


def exposure_at(lab: Lab, t_s: float) -> Exposure:
    """An exposure of the main camera with the vehicle at rest at its start."""
    return expected_exposure(lab.camera, lab.start, np.zeros(3), t_s)


def save(fig: plt.Figure, path: Path) -> None:
    """Save a figure without a date, so that equal figures have equal bytes."""
    fig.savefig(path, metadata={"Date": None}, bbox_inches="tight")
    plt.close(fig)


FIGURES = {
    "axes": axes,
    "pixels": pixels,
    "roll": roll,
    "lever": lever,
    "bodies": bodies,
    "color": color,
    "air": air,
    "orbit": orbit,
    "reflections": reflections,
}


def main(folder: Path) -> None:
    for name, draw in FIGURES.items():
        draw(folder / f"{name}.svg")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "images")
