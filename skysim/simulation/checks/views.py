"""The lights in the camera's field at an attitude: positions, electrons and image sizes, in closed form.

The image of a light is a point-spread function convolved with the LED's disk, the defocus disk and the path during the
exposure. Variances and a peak describe it, so no frame is rendered:

    sigma^2 = lens^2 + disk^2 / 4 + defocus^2 / 4,

with lens the standard deviation of the Gaussian that has the peak of the lens's image (pixel included), disk and
defocus the radii of uniform disks. `peak_share` is the share of the light in the brightest pixel.
"""

import datetime
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.camera.projection import rates_e_s
from skysim.camera.psf.kernel import build_kernel
from skysim.camera.psf.otf import blur_radius_px, chromatic_sigma_px, field_sigma_px
from skysim.core.types import Array, Bools, Floats, Ints, Mount, Sources, lengths, median
from skysim.simulation.exposure import expected_exposure, on_detector
from skysim.simulation.lab import Lab
from skysim.simulation.lights.light import Exposure, Lit, Occluder, beam_of

STEP = 1e-6  # relative displacement of a light, for the numerical derivative of its image
VISIBLE = ""  # name in place of an occluder's for a light that is not hidden


class View(NamedTuple):
    """The n lights on the detector at one attitude.

    Attributes
    ----------
    time
        UTC of the exposure
    lab_from_cam
        Attitude of the camera, with its assumed mount
    row
        (n,) rows among the sources
    xy_px
        (n, 2) image positions
    offset_m
        (n, 3) vectors from the pupil to the lights in camera axes; unit vectors for stars
    gradient
        (n, 2, 3) derivatives of xy_px by offset_m
    jacobian
        (n, 2, 3) derivatives J_i of xy_px by a small rotation w of the lights about the bearing, in camera axes
    distance_m
        (n,) distances along the boresight; infinite for stars
    electrons
        (n,) mean photo-electrons of an exposure
    disk_px, defocus_px
        (n,) radii of the LED's disk and of the defocus disk
    sigma_px
        (n,) rms radii along each axis without motion
    streak_px
        (n, 2) paths during the exposure
    peak_e
        (n,) mean electrons in the brightest pixel, background included
    behind
        (n,) names of the occluders that hide the lights; VISIBLE for none
    noise_px2
        (n, 2, 2) covariances of the centroids, see `detection.with_noise`; zeros before
    """

    time: datetime.datetime
    lab_from_cam: Rotation
    row: Ints
    xy_px: Floats
    offset_m: Floats
    gradient: Floats
    jacobian: Floats
    distance_m: Floats
    electrons: Floats
    disk_px: Floats
    defocus_px: Floats
    sigma_px: Floats
    streak_px: Floats
    peak_e: Floats
    behind: Array
    noise_px2: Floats

    def __len__(self) -> int:
        return len(self.row)

    @property
    def visible(self) -> Bools:
        """(n,) whether nothing hides the lights."""
        return self.behind == VISIBLE

    @property
    def streak_length_px(self) -> Floats:
        """(n,) length of the path during the exposure."""
        return lengths(self.streak_px)

    @property
    def blur2_px2(self) -> Floats:
        """(n,) variances of the lens's image, without LED, defocus and motion."""
        return self.sigma_px**2 - (self.disk_px**2 + self.defocus_px**2) / 4

    def take(self, which: Array) -> "View":
        """The lights selected by a mask or by indices."""
        return View(*self[:2], *(column[which] for column in self[2:]))


class CameraModel(NamedTuple):
    """The camera's properties that all views share.

    Attributes
    ----------
    optics, mount
        Geometry of lens and detector, and the assumed mount
    lens_px
        Standard deviation of the Gaussian that has the peak of the lens's image, pixel included
    background_e
        Mean electrons in a pixel from extended light and dark current
    glow_e
        Mean electrons in a pixel from the extended light of each light, by name; light with edges counts by its median
        over the detector
    noise_e
        Standard deviation of a pixel without light: shot noise of that charge, read-out noise, quantization, and fixed
        pattern (without hot pixels)
    exposure_s
        Exposure time
    """

    optics: Optics
    mount: Mount
    lens_px: float
    background_e: float
    glow_e: dict[str, float]
    noise_e: float
    exposure_s: float

    @classmethod
    def of(cls, lab: Lab) -> "CameraModel":
        """The main camera of a lab, with the background at its initial attitude."""
        camera = lab.scene.camera
        detector = lab.scene.camera.detector
        exposure_s = lab.scene.exposure.time_s
        exposure = expected_exposure(lab.camera, lab.start, np.zeros(3), math.nan)
        # Extended light by name. Light with edges that hides other lights is not in their background.
        lits = beam_of(lab.camera.lights, exposure).lits
        glow_e = dict.fromkeys((lit.name for lit in lits), 0.0)
        for lit in lits:
            if lit.glow:
                glow_e[lit.name] += exposure_s * float(np.mean(lit.glow()))
            edged_e_s = lit.edged() if lit.edged and lit.hides is None else None
            if edged_e_s is not None:
                glow_e[lit.name] += exposure_s * median(edged_e_s)
        dark_e_s = detector.dark_e_s * 2.0**detector.doublings
        background_e = sum(glow_e.values()) + dark_e_s * exposure_s
        # Variances of the fixed pattern and of the read-out; a converter's step q has the variance q^2 / 12.
        pattern_e2 = (
            detector.dsnu * dark_e_s * exposure_s
        ) ** 2 + detector.column_offset_e**2
        read_e2 = (
            detector.read_noise_e**2
            + detector.reset_noise_e**2
            + detector.gain_e_dn**2 / 12
            + pattern_e2
        )
        lens_px = float(1 / np.sqrt(2 * np.pi * build_kernel(camera.psf, camera).peak))
        noise_e = float(np.sqrt(background_e + read_e2))
        return cls(
            lab.camera.optics,
            lab.camera.mount,
            lens_px,
            background_e,
            glow_e,
            noise_e,
            exposure_s,
        )


def view(
    lit: Lit,
    exposure: Exposure,
    camera: CameraModel,
    occluders: Sequence[Occluder],
) -> View:
    """The points of a light on the detector in an exposure; `behind` names the occluders that hide some of them.

    1. Select the points on the detector.
    2. Electrons, from rate and on-time.
    3. Vectors to the lights, derivatives of the images, paths.
    4. Occluders.
    5. Sizes of lens image, LED disk and defocus disk.
    """
    # 1. Points on the detector.
    assert lit.points is not None
    mount = exposure.mount
    optics = exposure.optics
    row, (xy_px, distance_m, cos_out, cos_in) = on_detector(lit.points, exposure)
    chosen = lit.points.take(row)
    # 2. Electrons.
    rate_e_s = rates_e_s(chosen, optics, lit.emitter, distance_m, cos_out, cos_in)
    electrons = rate_e_s * chosen.duty * camera.exposure_s
    # 3. Vectors, derivatives, paths.
    arm_m = exposure.cam_from_lab.apply(chosen.xyz)
    offset_m = arm_m - chosen.place[:, 3:] * mount.cam_from_body.apply(mount.camera_body_m)
    gradient = image_gradient(optics, offset_m)
    # d(offset) = w x arm, so a row of the gradient g gives g . (w x arm) = w . (arm x g).
    jacobian = np.cross(arm_m[:, None, :], gradient)
    streak_px = paths_px(exposure, camera.exposure_s, chosen.motion, gradient, jacobian)
    # 4. What hides them: of several occluders, the last.
    behind = np.full(len(row), VISIBLE, object)
    for occluder in occluders:
        behind[occluder.hides(chosen.place)] = occluder.name
    # 5. Sizes.
    depth_m = np.where(chosen.place[:, 3] > 0, offset_m[:, 2], np.inf)
    disk_px = optics.camera.focal_px * chosen.radius_m / distance_m  # a star has no radius
    lens2_px2, defocus_px = lens_blur(camera, chosen, xy_px, depth_m)
    share = peak_share(lens2_px2, disk_px, defocus_px, lengths(streak_px))
    sigma_px = np.sqrt(lens2_px2 + (disk_px**2 + defocus_px**2) / 4)
    return View(
        exposure.time,
        exposure.lab_from_body * camera.mount.body_from_cam,
        row,
        xy_px,
        offset_m,
        gradient,
        jacobian,
        depth_m,
        electrons,
        disk_px,
        defocus_px,
        sigma_px,
        streak_px,
        electrons * share + camera.background_e,
        behind,
        np.zeros((len(row), 2, 2)),
    )


def paths_px(
    exposure: Exposure,
    exposure_s: float,
    motion: Floats | None,
    gradient: Floats,
    jacobian: Floats,
) -> Floats:
    """(n, 2) paths during the exposure, by minus the rate of the vehicle; moving lights add their `motion`."""
    cam_from_body = exposure.mount.cam_from_body
    rate_cam = cam_from_body.apply(exposure.trajectory.rate_at(exposure.t_s))
    streak_px = -exposure_s * np.einsum("nij,j->ni", jacobian, rate_cam)
    if motion is not None:
        motion_cam = exposure.cam_from_lab.apply(motion[:, 0])
        streak_px = streak_px + exposure_s * np.einsum("nij,nj->ni", gradient, motion_cam)
    return streak_px


def lens_blur(
    model: CameraModel, points: Sources, xy_px: Floats, depth_m: Floats
) -> tuple[Floats, Floats]:
    """(n,) variances of the lens's images at xy_px, in px^2, and (n,) radii of the defocus disks in px."""
    camera = model.optics.camera
    lens2_px2 = model.lens_px**2 + field_sigma_px(camera, xy_px) ** 2
    shift_m: Floats | float = 0.0
    if points.chromatic is not None:
        shift_m = points.chromatic[:, 0]
        # Lateral color spreads along the radius: half of its variance is on each axis.
        spread_px = camera.along_radius("lateral", points.chromatic[:, 3:4], xy_px)
        lens2_px2 += chromatic_sigma_px(camera, points.chromatic) ** 2
        lens2_px2 += np.sum(spread_px**2, axis=-1) / 2
    return lens2_px2, blur_radius_px(camera, depth_m, shift_m)


def image_gradient(optics: Optics, offset_m: Floats) -> Floats:
    """(n, 2, 3) derivatives of the image positions by the offsets in camera axes, from central differences."""
    step_m = STEP * lengths(offset_m)[:, None, None] * np.eye(3)
    ahead, behind = (optics.project(offset_m[:, None, :] + sign * step_m) for sign in (1, -1))
    return np.swapaxes(ahead - behind, 1, 2) / (2 * step_m.max(axis=2)[:, None, :])


def peak_share(
    lens2_px2: Floats | float,
    disk_px: Floats | float = 0.0,
    defocus_px: Floats | float = 0.0,
    streak_px: Floats | float = 0.0,
) -> Floats:
    """(n,) share of the light in the brightest pixel; arguments that are numbers hold for all.

    The image is a disk of radius R, the larger of LED and defocus disk, blurred by a Gaussian of variance
    s^2 = lens^2 + r^2 / 4 with the smaller radius r:

        peak = (1 - exp(-R^2 / 2 s^2)) / (pi R^2),      1 / (2 pi s^2) for R = 0

    This is exact for one disk and a Gaussian lens. A path of length L spreads it over a trace, which reduces it by the
    factor sqrt(2 pi) S erf(L / (2 sqrt 2 S)) / L with S = 1 / sqrt(2 pi peak).
    """
    large = np.maximum(disk_px, defocus_px)
    small = np.minimum(disk_px, defocus_px)
    s2 = lens2_px2 + small**2 / 4
    still = -np.expm1(-(large**2) / (2 * s2)) / np.maximum(np.pi * large**2, 1e-12)
    still = np.where(large > 1e-3, still, 1 / (2 * np.pi * s2))
    # With x = L / (2 sqrt 2 S) the factor is sqrt(pi) / 2 erf(x) / x.
    sigma = 1 / np.sqrt(2 * np.pi * still)
    x = np.maximum(streak_px, 1e-9) / (2 * np.sqrt(2) * sigma)
    return still * np.sqrt(np.pi) / 2 * special.erf(x) / x
