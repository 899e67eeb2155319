"""What a dome costs as the number of LEDs grows: the places, the star tracker's index of them, and identification.

The places are those of AFIT's measured dome. The index holds all pairs of LEDs that one field can hold, or of a dense
dome near pairs only. Fields are seen by AFIT's camera at random attitudes, with an exact map. A regular lattice of so
many LEDs is alike in many places, so that most of its fields are refused, in about the same time.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import figure, verdict
from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.identification import led_search
from estimator.identification.led_index import build_dome_index
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking.onboard_model import calibration

KINDS = ("fibonacci", "random", "poisson_disk")
PLACED = (10_000, 100_000)
INDEXED = (2_500, 5_000, 10_000, 50_000, 100_000)
MOST_S = 5.0  # CPU time of 100,000 places, and of their index
MOST_MS = {10_000: 2.0, 50_000: 10.0}  # of the identification of one field
CAP_DEG = 40
FIELDS = 40
TILT_DEG = 25
SIGMA_PX = 0.3


def places(kind: str, count: int) -> tuple[Floats, float]:
    """(N, 3) places of a layout's LEDs in m, and the CPU seconds that they took."""
    layout = f"{{kind: {kind}, count: {count}, cap_deg: {CAP_DEG}}}"
    scene = loader.load("afit_simsat", {"light.layout": layout})
    assert scene.dome is not None
    band = Band.from_camera(scene.camera)
    begin_s = time.process_time()
    leds = dome.sources(scene.dome, band)
    return leds.place[:, :3], time.process_time() - begin_s


def identification_ms(
    place_m: Floats, camera: Camera, lever: Lever
) -> tuple[float, float, float]:
    """CPU seconds of the index, median CPU milliseconds of a field, and the share of fields that are solved."""
    leds = LedMap(np.arange(len(place_m)), place_m, np.zeros(3), np.ones(3))
    begin_s = time.process_time()
    index = build_dome_index(leds, lever, camera)
    index_s = time.process_time() - begin_s
    rng = np.random.default_rng(1)
    spent_ms = []
    solved = 0
    for field in range(FIELDS + 1):
        about, yaw = rng.uniform(0, 2 * np.pi, 2)
        tilt_rad = np.radians(TILT_DEG) * np.sqrt(rng.random())
        tilt = Rotation.from_rotvec(tilt_rad * np.array([np.cos(about), np.sin(about), 0]))
        xy_px = project(Rotation.from_euler("z", yaw) * tilt, place_m, lever, camera)
        xy_px = xy_px[camera.contains(np.nan_to_num(xy_px, nan=-1e9))]
        rays = camera.rays(rng.permutation(xy_px + rng.normal(0, 0.1, xy_px.shape)))
        sigma_rad = np.full(len(rays), SIGMA_PX / camera.focal_px)
        begin_s = time.process_time()
        match = led_search.identify(rays, sigma_rad, index, most_lights=40)
        # The first field may compile.
        if field > 0:
            spent_ms.append(1e3 * (time.process_time() - begin_s))
            solved += not isinstance(match, str)
    return index_s, float(np.median(spent_ms)), solved / FIELDS


def measure() -> list[dict[str, Any]]:
    """CPU seconds of places by layout and number, then those of the index, and of the identification of a field."""
    rows = []
    places("poisson_disk", 100)
    for kind in KINDS:
        for count in PLACED:
            what = f"{count:,} LEDs"
            spent_s = min(places(kind, count)[1] for _ in range(2))
            rows.append(verdict(f"{kind}: places", spent_s, "s", what, MOST_S))
    lab = build_lab(loader.load("afit_simsat"))
    mount = lab.camera.mount
    lever = Lever(np.array(mount.camera_body_m), mount.cam_from_body)
    camera = calibration(lab.scene.camera)
    for kind in ("fibonacci", "poisson_disk"):
        for count in INDEXED:
            what = f"{count:,} LEDs"
            index_s, field_ms, solved = identification_ms(
                places(kind, count)[0], camera, lever
            )
            rows.append(verdict(f"{kind}: index", index_s, "s", what, MOST_S))
            name = f"{kind}: identification"
            bar_ms = MOST_MS.get(count)
            rows.append(
                verdict(name, field_ms, "ms", what, bar_ms)
                if bar_ms
                else figure(name, field_ms, "ms", what)
            )
            rows.append(figure(f"{kind}: fields solved", 100 * solved, "%", what))
    return rows
