"""Frame rendering speed against getframes, GalSim and NumPy; scaling of time and memory; noise against random bytes.

Of every shipped scene also how often a run renders each of its frames.
"""

from __future__ import annotations

import importlib.util
import resource
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import verdict, versus
from skysim.camera.detector import Detector, expose
from skysim.camera.glow.background import fill
from skysim.camera.optics import Optics
from skysim.camera.render import Window, render
from skysim.core.types import Floats, Mount, Sources, Trajectory
from skysim.results.run import simulate
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation import exposure

AT_CENTER = Mount(np.zeros(3), Rotation.identity())
EXPOSURE_S = 0.01
NOISE = {
    "quantum_efficiency": 0.5,
    "prnu": 0.01,
    "dark_e_s": 25.0,
    "dsnu": 0.3,
    "hot_pixels": 1e-4,
    "hot_e_s": 2000.0,
    "full_well_e": 4e4,
    "read_noise_e": 10.0,
    "column_offset_e": 5.0,
    "gain_e_dn": 10.0,
    "offset_dn": 64.0,
    "bits": 12,
}


def camera(
    width: int, height: int, focal_px: float, sigma_px: float, **noise: Any
) -> CameraConfig:
    """A camera with square 5 um pixels and a Gaussian PSF; f/10000, so that defocus is negligible."""
    part = {
        "width_px": width,
        "height_px": height,
        "pixel": "5 um",
        "focal_length": f"{5e-6 * focal_px} m",
    }
    lens = {"f_number": 1e4, "psf": {"kind": "gaussian", "sigma_px": sigma_px}}
    return CameraConfig.model_validate(part | lens | {"detector": NOISE | noise})


def square_meter(lens: CameraConfig) -> Optics:
    """The optics with a pupil of one square meter, so that a source's strength equals its electrons per second."""
    return replace(Optics.from_camera(lens), collecting_m2=1.0)


def turning(rate_rad_s: float) -> Trajectory:
    """A rotation about the camera's y axis at a constant rate, with the identity at mid-exposure."""
    t = np.linspace(0, EXPOSURE_S, 11)
    rate = np.tile([0.0, rate_rad_s, 0.0], (11, 1))
    return Trajectory(t, Rotation.from_rotvec((t[:, None] - EXPOSURE_S / 2) * rate[:1]), rate)


def lights(
    lens: CameraConfig, count: int, electrons: Floats, radius_px: float = 0.0, seed: int = 1
) -> Sources:
    """`count` stars, or disks two meters away if radius_px > 0, at random positions in the frame.

    electrons : electrons of each source in one exposure
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform((30, 30), (lens.width_px - 30, lens.height_px - 30), (count, 2))
    toward = np.column_stack([(xy - lens.center_px) / lens.focal_px, np.ones(count)])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    near = radius_px > 0
    place = np.column_stack([toward * (2.0 if near else 1.0), np.full(count, float(near))])
    zero = np.zeros(count)
    one = np.ones(count)
    strength = electrons / EXPOSURE_S * (4.0 if near else 1.0)
    return Sources(
        np.arange(count),
        place,
        -toward * near,
        one * 2 * radius_px / lens.focal_px,
        strength,
        one,
        zero,
        one,
        np.zeros(count, int),
        zero,
    )


def camera_shot(lens: CameraConfig, sources: Sources, rate_rad_s: float) -> Callable[[], Any]:
    """A function that makes one frame: light with smear, then all noise."""
    optics = square_meter(lens)
    detector = Detector.from_camera(lens)
    rng = np.random.default_rng(0)
    path = turning(rate_rad_s)
    image = np.empty((lens.height_px, lens.width_px), np.float32)

    def shot() -> Any:
        fill(image, np.zeros((1, 1)), EXPOSURE_S)
        render(image, sources, optics, path, AT_CENTER, Window(0.0, EXPOSURE_S))
        return expose(image, EXPOSURE_S, detector, rng)

    return shot


def light_of(lens: CameraConfig, sources: Sources, rate_rad_s: float) -> Floats:
    """Mean photoelectrons of the same frame."""
    image = np.zeros((lens.height_px, lens.width_px))
    render(
        image,
        sources,
        square_meter(lens),
        turning(rate_rad_s),
        AT_CENTER,
        Window(0.0, EXPOSURE_S),
    )
    return image


def measure() -> list[dict[str, Any]]:
    """Results for the dome frame, the sky frame, the noise alone, the scaling, and the runs of the shipped scenes."""
    return [*dome_frame(), *sky_frame(), noise_floor(), *growth(), *renders_a_frame()]


def dome_frame() -> list[dict[str, Any]]:
    """1600 x 1200 pixels, 45 disks 20 px wide that move by 20 px, all noise including the fixed pattern.

    The peers receive the finished light image, so their time is that of the noise alone.
    """
    lens = camera(1600, 1200, 8000.0, 1.0)
    sources = lights(lens, 45, np.full(45, 3e6), radius_px=10.0)
    rate = 20 / 8000.0 / EXPOSURE_S
    ours = camera_shot(lens, sources, rate)
    mean = light_of(lens, sources, rate)
    what = "frame: 45 smeared disks, 1600x1200"
    return [
        versus(what, ours, "getframes, its noise alone", getframes(lens, mean), bar=10),
        versus(what, ours, "numpy Poisson + normal", numpy_noise(mean + 0.25), bar=8),
    ]


def getframes(lens: CameraConfig, mean_e: Floats) -> Callable[[], Any] | None:
    """The same detector model in getframes: PRNU, dark current and DSNU, hot pixels, shot and read noise, ADC.

    None if it is not installed.
    """
    if importlib.util.find_spec("getframes") is None:
        return None
    import getframes as gf

    part = lens.detector
    config = gf.CameraConfig(
        name="bench",
        sensor_type=gf.SensorType.CCD,
        pixel_size_um=5.0,
        resolution=(lens.height_px, lens.width_px),
        quantum_efficiency=1.0,
        full_well_e=part.full_well_e,
        bit_depth=part.bits,
        gain_e_per_adu=part.gain_e_dn,
        bias_offset_adu=part.offset_dn,
        read_noise_e=part.read_noise_e,
        prnu=part.prnu,
        dark_current_e_per_s=part.dark_e_s,
        dark_current_nonuniformity=part.dsnu,
        hot_pixel_fraction=part.hot_pixels,
        hot_pixel_factor=part.hot_e_s / part.dark_e_s,
        readout_channel_count=lens.width_px,
        readout_channel_axis=1,
        bias_channel_spread_adu=part.column_offset_e / part.gain_e_dn,
    )
    made = gf.Camera(config, seed=1)
    rate = mean_e / EXPOSURE_S
    return lambda: made.expose(rate, EXPOSURE_S, include_truth=False)


def numpy_noise(mean_e: Floats) -> Callable[[], Any]:
    """Poisson noise, read noise and ADC in NumPy, without fixed pattern."""
    rng = np.random.default_rng(2)

    def noise() -> Any:
        frame = rng.poisson(mean_e) + 10.0 * rng.standard_normal(mean_e.shape)
        return np.clip(np.rint(frame / 10 + 64), 0, 4095).astype(np.uint16)

    return noise


def sky_frame() -> list[dict[str, Any]]:
    """1024 x 1024 pixels over 20 deg, PSF sigma 0.8 px: the 15,200 stars to V 7 give 146 in such a field."""
    lens = camera(
        1024, 1024, 512 / np.tan(np.radians(10)), 0.8, prnu=0.0, dsnu=0.0, hot_pixels=0.0
    )
    # Star counts grow by 0.51 dex per magnitude at V 7; this draws magnitudes from that distribution.
    magnitude = 7 + np.log10(np.random.default_rng(3).uniform(0, 1, 146)) / 0.51
    electrons = 2e4 * 10 ** (-0.4 * (magnitude - 4))
    sources = lights(lens, 146, electrons)
    ours = camera_shot(lens, sources, 0.0)
    result = versus(
        "frame: 146 stars to V 7, 1024x1024",
        ours,
        "GalSim",
        galsim(lens, sources, electrons),
        bar=15,
    )
    return [result, verdict("the same, in ms", result["value"], "ms", "most wanted", 5.0)]


def galsim(
    lens: CameraConfig, sources: Sources, electrons: Floats
) -> Callable[[], Any] | None:
    """The same stars drawn by GalSim on stamps of its default size, with its CCDNoise; None if it is not installed."""
    if importlib.util.find_spec("galsim") is None:
        return None
    import galsim

    toward = sources.place[:, :3] / sources.place[:, 2:3]
    xy = toward[:, :2] * lens.focal_px + lens.center_px + 1  # GalSim counts from 1
    psf = galsim.Gaussian(sigma=0.8)
    rng = galsim.BaseDeviate(1)

    def shot() -> Any:
        image = galsim.ImageF(lens.width_px, lens.height_px, scale=1.0)
        for (x, y), flux in zip(xy, electrons, strict=True):
            stamp = psf.withFlux(flux).drawImage(
                center=galsim.PositionD(x, y), scale=1.0, dtype=np.float32
            )
            bounds = stamp.bounds & image.bounds
            image[bounds] += stamp[bounds]
        image.addNoise(galsim.CCDNoise(rng, sky_level=0.25, gain=10.0, read_noise=10.0))
        return image

    return shot


def noise_floor() -> dict[str, Any]:
    """Noise of a dark frame against the time to generate as many random bytes as the frame has."""
    lens = camera(1600, 1200, 8000.0, 1.0)
    detector = Detector.from_camera(lens)
    rng = np.random.default_rng(0)
    dark = np.zeros((1200, 1600), np.float32)

    def ours() -> None:
        dark[:] = 0
        expose(dark, EXPOSURE_S, detector, rng)

    # The bar is 1.6 times the time of filling the frame with random bytes.
    return versus(
        "noise of a dark frame, 1600x1200",
        ours,
        "Generator.bytes",
        lambda: rng.bytes(2 * 1600 * 1200),
        bar=1 / 1.6,
    )


def growth() -> list[dict[str, Any]]:
    """Scaling: drawing time is linear in the number of stars and independent of the area; memory in frames."""
    few = camera(1024, 1024, 3000.0, 0.8)
    many = camera(2048, 2048, 3000.0, 0.8)

    def drawing(lens: CameraConfig, count: int) -> Callable[[], Any]:
        image = np.zeros((lens.height_px, lens.width_px), np.float32)
        optics = square_meter(lens)
        sources = lights(lens, count, np.full(count, 1e4))
        path = turning(0.0)
        return lambda: render(
            image, sources, optics, path, AT_CENTER, Window(0.0, EXPOSURE_S)
        )

    stars = versus(
        "draw 500 stars", drawing(few, 500), "ten times as many, a star", drawing(few, 5000)
    )
    area = versus(
        "draw 500 stars, 1024x1024", drawing(few, 500), "on 2048x2048", drawing(many, 500)
    )
    return [
        verdict(
            "ten times the stars beyond 500", stars["ratio"], "times as long", "linear", 11.0
        ),
        verdict(
            "four times the area, drawing", area["ratio"], "times as long", "level", 1.25
        ),
        verdict(
            "memory of a frame being made",
            memory_frames(),
            "frames of float32",
            "most wanted",
            6.0,
        ),
    ]


def memory_frames() -> float:
    """Memory growth of the process while it makes a frame of 36 megapixels, in float32 frames of that size.

    The fixed pattern is included.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    lens = camera(6000, 6000, 8000.0, 1.0)
    camera_shot(lens, lights(lens, 500, np.full(500, 1e4)), 0.0)()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return float(grown * 1024 / (6000 * 6000 * 4))


def renders_a_frame() -> list[dict[str, Any]]:
    """Calls of `render_frame` for a frame in a run of each scene, with a filter or without; 1 is the least."""
    what = "renders of a frame in a run, {}"
    return [
        verdict(what.format(name), renders_in_run(name), "", "one", 1.0)
        for name in loader.list_scenes()
    ]


def renders_in_run(name: str) -> float:
    """Calls of `render_frame` over frames of all cameras; each call exposes the detector once."""
    scene = loader.load(name, {"exposure.frames": "2"})
    with mock.patch.object(exposure, "expose", wraps=exposure.expose) as exposed:
        run = simulate(scene)
    return float(exposed.call_count / sum(len(one) for one in (run, *run.heads.values())))
