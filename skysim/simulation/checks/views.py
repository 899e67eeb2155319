"""What the camera has in its field at an attitude: positions, electrons and image sizes of the lights, in closed form.

A light's image is a point-spread function convolved with the LED's disk, the defocus disk and the path during the
exposure. It is described by variances and a peak, so that no frame is rendered:

    sigma^2 = lens^2 + disk^2 / 4 + defocus^2 / 4,

lens the standard deviation of the Gaussian with the lens's peak (pixel included), disk and defocus the radii of uniform
disks. The share of the light in the brightest pixel is that of a disk of radius R, the larger of the two, blurred by a
Gaussian of variance s^2 = lens^2 + r^2 / 4, r the smaller one,

    peak = (1 - exp(-R^2 / 2 s^2)) / (pi R^2),      1 / (2 pi s^2) for R = 0,

exact for one disk and a Gaussian lens. A path of length L spreads it over a trace: it falls by the factor
sqrt(2 pi) S erf(L / (2 sqrt 2 S)) / L with S = 1 / sqrt(2 pi peak).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from skysim.camera.glow import background
from skysim.camera.glow.air_glow import sky_light
from skysim.camera.optics import Optics
from skysim.camera.psf.kernel import build_kernel
from skysim.camera.psf.otf import blur_radius_px, chromatic_sigma_px, field_sigma_px
from skysim.camera.render import Poses, project
from skysim.core.types import Floats, Sources
from skysim.dynamics import multibody
from skysim.simulation.checks.attitudes import Attitudes
from skysim.simulation.exposure import stray_light_e_s
from skysim.simulation.lab import Lab, bodies_during, sky_during
from skysim.sources.dome.led import irradiance_e_s_m2

STEP = 1e-6  # relative displacement of a light, for the numerical derivative of its image
NO_ACCELERATION = np.zeros(3)
FIELD_MARGIN = 1.02  # of the cone in which lights are projected


class View(NamedTuple):
    """The lights on the chip at one attitude, (n,) each.

    row         : row of the sources
    xy_px       : (n, 2)
    offset_m    : (n, 3) from the pupil to the light in camera axes; a unit vector for a star
    arm_m       : (n, 3) from the bearing to the light in camera axes; the same as offset_m for a star
    gradient    : (n, 2, 3) derivative of xy_px by offset_m
    distance_m  : along the boresight; infinite for a star
    electrons   : mean photo-electrons of an exposure
    disk_px, defocus_px, sigma_px : radii of the LED's and of the defocus disk, rms radius per axis without motion
    streak_px   : (n, 2) path during the exposure
    peak_e      : mean electrons in the brightest pixel, background included
    bend_px     : (n, 2) mean of the path minus its middle, by the angular acceleration
    """

    row: NDArray[np.int64]
    xy_px: Floats
    offset_m: Floats
    arm_m: Floats
    gradient: Floats
    distance_m: Floats
    electrons: Floats
    disk_px: Floats
    defocus_px: Floats
    sigma_px: Floats
    streak_px: Floats
    peak_e: Floats
    bend_px: Floats

    def __len__(self) -> int:
        return len(self.row)

    @property
    def jacobian(self) -> Floats:
        """(n, 2, 3) derivative of xy_px by a small rotation w of the lights in camera axes, about the bearing.

        d(offset) = w x arm, so a row of the gradient g gives g . (w x arm) = w . (arm x g).
        """
        return np.cross(self.arm_m[:, None, :], self.gradient)

    @property
    def streak_length_px(self) -> Floats:
        """(n,) length of the path during the exposure."""
        return np.linalg.norm(self.streak_px, axis=1)

    @property
    def blur2_px2(self) -> Floats:
        """(n,) variance of the lens's image, without LED, defocus and motion."""
        return self.sigma_px**2 - (self.disk_px**2 + self.defocus_px**2) / 4

    def take(self, which: NDArray[Any]) -> View:
        """The chosen lights, by mask or index."""
        return View(*(column[which] for column in self))


class CameraModel(NamedTuple):
    """What all views share.

    optics       : lens and chip geometry
    lens_px      : standard deviation of the Gaussian that has the peak of the lens's image, pixel included
    background_e : mean electrons in a pixel, of extended light and dark current
    stray_e      : of them those that come past the baffle
    noise_e      : standard deviation of a pixel without light: of that charge, of the read-out, of the converter, and
                   of the fixed pattern (without hot pixels)
    exposure_s   : exposure time
    """

    optics: Optics
    lens_px: float
    background_e: float
    stray_e: float
    noise_e: float
    exposure_s: float

    @classmethod
    def of(cls, lab: Lab) -> CameraModel:
        """The camera of a lab, with the background at its initial attitude."""
        camera, detector = lab.scene.camera, lab.scene.camera.detector
        cam_from_lab = lab.camera.mount.cam_from_body * lab.start.inv()
        first_s, glows = lab.scene.exposure.first_s, lab.scene.background
        lit = sky_light(sky_during(lab.camera, first_s))
        stray_e_s = sum(stray_light_e_s(lab.camera, bodies_during(lab.camera, first_s), cam_from_lab, first_s).values())
        glow_e_s = (
            float(background.glow_map(glows, lab.camera.optics, cam_from_lab, lab.camera.band, lit).mean()) + stray_e_s
        )
        dark_e_s = detector.dark_e_s * 2.0**detector.doublings
        background_e = (glow_e_s + dark_e_s) * lab.scene.exposure.time_s
        pattern_e2 = (detector.dsnu * dark_e_s * lab.scene.exposure.time_s) ** 2 + detector.column_offset_e**2
        read_e2 = detector.read_noise_e**2 + detector.reset_noise_e**2 + detector.gain_e_dn**2 / 12 + pattern_e2
        lens_px = float(1 / np.sqrt(2 * np.pi * build_kernel(camera.psf, camera).peak))
        noise_e = float(np.sqrt(background_e + read_e2))
        exposure_s = lab.scene.exposure.time_s
        return cls(lab.camera.optics, lens_px, background_e, stray_e_s * exposure_s, noise_e, exposure_s)


def views(lab: Lab, lights: Sources, attitudes: Attitudes, camera: CameraModel) -> list[View]:
    """The view at each attitude, of the lights that no obstacle hides."""
    rows = zip(attitudes.lab_from_body, attitudes.rate_body_rad_s, attitudes.accelerations(), strict=True)
    return [view(lab, lights, at, rate, camera, acceleration) for at, rate, acceleration in rows]


def view(
    lab: Lab,
    lights: Sources,
    lab_from_body: Rotation,
    rate_body_rad_s: Floats,
    camera: CameraModel,
    acceleration_body_rad_s2: Floats = NO_ACCELERATION,
) -> View:
    """The view at one attitude while the vehicle rotates at a rate and an acceleration, (3,) each in body axes.

    At the time t from mid-exposure the lights are rotated by -(rate t + acceleration t^2 / 2); the mean over the
    exposure T is -acceleration T^2 / 24.
    """
    mount, optics, exposure_s = lab.camera.mount, camera.optics, lab.scene.exposure.time_s
    cam_from_lab = mount.cam_from_body * lab_from_body.inv()
    camera_m = lab_from_body.apply(mount.camera_body_m)
    near = np.flatnonzero(in_cone(lights, cam_from_lab.inv().apply([0.0, 0.0, 1.0]), camera_m, optics.field_rad))
    poses = Poses(cam_from_lab.as_matrix()[None], camera_m[None])
    xy_px, distance_m, cos_out, cos_in = (one[0] for one in project(lights.take(near), optics, poses))
    size = np.array([optics.camera.width_px, optics.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size - 0.5)).all(axis=1)
    if lab.camera.obstacles is not None:
        seen = np.flatnonzero(on_chip)
        on_chip[seen[multibody.occluded(lab.camera.obstacles, lab_from_body, lights.place[near[seen]])]] = False
    row = near[on_chip]
    chosen, is_led = lights.take(row), lights.place[row, 3] > 0
    xy_px, distance_m, cos_out, cos_in = (one[on_chip] for one in (xy_px, distance_m, cos_out, cos_in))
    throughput = optics.throughput(cos_in)
    rate_e_s = optics.collecting_m2 * np.where(
        is_led,
        irradiance_e_s_m2(chosen.strength, lab.camera.emitter, cos_out, throughput, distance_m),
        chosen.strength * throughput,
    )
    electrons = rate_e_s * np.minimum(chosen.on_s / chosen.period_s, 1.0) * exposure_s
    arm_m = cam_from_lab.apply(chosen.place[:, :3])
    offset_m = arm_m - chosen.place[:, 3:] * mount.cam_from_body.apply(mount.camera_body_m)
    gradient = image_gradient(optics, offset_m)
    jacobian = np.cross(arm_m[:, None, :], gradient)
    streak_px, bend_px = (
        -factor * np.einsum("nij,j->ni", jacobian, mount.cam_from_body.apply(body))
        for factor, body in ((exposure_s, rate_body_rad_s), (exposure_s**2 / 24, acceleration_body_rad_s2))
    )
    depth_m = np.where(is_led, offset_m[:, 2], np.inf)
    disk_px = np.where(is_led, optics.camera.focal_px * chosen.radius_m / distance_m, 0.0)
    lens2_px2 = camera.lens_px**2 + field_sigma_px(optics.camera.psf, optics.camera, xy_px) ** 2
    shift_m: Floats | float = 0.0
    if chosen.chromatic is not None:
        shift_m = chosen.chromatic[:, 0]
        lens2_px2 = lens2_px2 + chromatic_sigma_px(optics.camera, chosen.chromatic, xy_px) ** 2
    defocus_px = blur_radius_px(optics.camera, depth_m, shift_m)
    share = peak_share(lens2_px2, disk_px, defocus_px, np.linalg.norm(streak_px, axis=1))
    sigma_px = np.sqrt(lens2_px2 + (disk_px**2 + defocus_px**2) / 4)
    return View(
        row,
        xy_px,
        offset_m,
        arm_m,
        gradient,
        depth_m,
        electrons,
        disk_px,
        defocus_px,
        sigma_px,
        streak_px,
        electrons * share + camera.background_e,
        bend_px,
    )


def in_cone(lights: Sources, boresight: Floats, camera_m: Floats, field_rad: float) -> NDArray[np.bool_]:
    """(N,) whether the direction from the camera to a light is within the field's circle about the boresight."""
    offset = lights.place[:, :3] - lights.place[:, 3:] * camera_m
    cosine = np.cos(min(FIELD_MARGIN * field_rad, np.pi))
    return np.asarray(offset @ boresight > cosine * np.sqrt(np.einsum("nj,nj->n", offset, offset)))


def image_gradient(optics: Optics, offset_m: Floats) -> Floats:
    """(n, 2, 3) derivative of the image position by the offset in camera axes, from central differences."""
    step_m = STEP * np.linalg.norm(offset_m, axis=1)[:, None, None] * np.eye(3)
    ahead, behind = (optics.project(offset_m[:, None, :] + sign * step_m) for sign in (1, -1))
    return np.asarray(np.swapaxes(ahead - behind, 1, 2) / (2 * step_m.max(axis=2)[:, None, :]))


def peak_share(lens2_px2: Floats, disk_px: Floats, defocus_px: Floats, streak_px: Floats) -> Floats:
    """(n,) share of the light in the brightest pixel; see the module's description."""
    large, small = np.maximum(disk_px, defocus_px), np.minimum(disk_px, defocus_px)
    s2 = lens2_px2 + small**2 / 4
    still = -np.expm1(-(large**2) / (2 * s2)) / np.maximum(np.pi * large**2, 1e-12)
    still = np.where(large > 1e-3, still, 1 / (2 * np.pi * s2))
    sigma = 1 / np.sqrt(2 * np.pi * still)
    x = np.maximum(streak_px, 1e-9) / (2 * np.sqrt(2) * sigma)
    return np.asarray(still * np.sqrt(np.pi) / 2 * special.erf(x) / x)
