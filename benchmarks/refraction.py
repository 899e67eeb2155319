"""Refraction in photographs of the real sky: residuals of stars with and without the air over the site.

The four photographs of ESA's tetra3 have one camera; their lens (focal
length, center, five coefficients of distortion) and the attitude of each are fitted to stars that a first calibration
identified; then again to the same stars as the air of the site raises them. Time, altitude and azimuth are in the
files' names; the altitudes (1.3 degrees off, all of them) and the time give the site: 51.98 N, 4.34 E, which is Delft.
Their folder is named by the environment variable SKYSIM_PHOTOGRAPHS.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.timing import figure
from estimator.calibration.star_field import Calibration, StarFrame, calibrate, self_calibrate
from estimator.catalog import catalog
from estimator.catalog.refraction import SiteAir, raised, refraction_constants
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.core import images
from skysim.core.paths import CATALOGS

FOLDER = "SKYSIM_PHOTOGRAPHS"
DATE = datetime.datetime(2019, 7, 29, 20, 47, 26)
PRESSURE_HPA = 1013.25
DELFT = SiteAir(51.98, 4.34, DATE, PRESSURE_HPA, 15.0)
FOV_DEG = 11.42
SIGMA_PX = 0.1  # of a centroid at least
LOWEST_DEG = 8.0  # altitude of a star
FILES = tuple(
    f"2019-07-29T204726_Alt{view}_Try1.tiff"
    for view in ("40_Azi-135", "40_Azi45", "60_Azi-45", "60_Azi135")
)


def star_frames(folder: Path) -> tuple[list[StarFrame], Camera]:
    """The identified stars of each photograph without air, and the camera of a first calibration."""
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    vectors = catalog.apparent(stars, catalog.on_earth(DATE))
    pictures = [images.monochrome(images.read_image(folder / file)) for file in FILES]
    height, width = pictures[0].shape
    sheet = Camera.from_fov(width, height, np.radians(FOV_DEG))

    def tracker(camera: Camera, focal_uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars, vectors, focal_uncertainty=focal_uncertainty)

    found = [
        with_floor(detect_and_centroid(picture, sheet, Settings(), Clock()))
        for picture in pictures
    ]
    camera = self_calibrate(found, tracker, sheet).camera
    final = tracker(camera, 0.002)
    frames = []
    for centroids in found:
        match = final.solve_centroids(centroids).match
        assert match is not None
        seen = centroids.take(match.observed)
        frames.append(StarFrame(seen.xy_px, seen.sigma_px, final.stars.vectors[match.star]))
    return frames, camera


def with_floor(centroids: Centroids) -> Centroids:
    return replace(centroids, sigma_px=np.hypot(centroids.sigma_px, SIGMA_PX))


def fitted(frames: Sequence[StarFrame], camera: Camera) -> tuple[Calibration, Floats]:
    """The calibration, and the rms residual of a coordinate of each photograph in px, without its outliers."""
    calibration = calibrate(frames, camera)
    outlying = {tuple(row) for row in calibration.report.outliers.tolist()}
    rms = []
    for n, frame in enumerate(frames):
        seen = calibration.camera.pixels(
            calibration.report.cam_from_ref[n].apply(frame.vectors_ref)
        )
        kept = np.array([(n, k) not in outlying for k in range(len(seen))])
        rms.append(np.sqrt(np.mean((seen - frame.xy_px)[kept] ** 2)))
    return calibration, np.array(rms)


def through(
    frames: Sequence[StarFrame], zenith: Floats, constants: tuple[float, float]
) -> list[StarFrame]:
    """The same stars as the air under a zenith raises them."""
    return [
        replace(frame, vectors_ref=raised(frame.vectors_ref, zenith, *constants))
        for frame in frames
    ]


def best_zenith(frames: Sequence[StarFrame], camera: Camera, start: Floats) -> Floats:
    """The zenith with the least residuals of all photographs, by a simplex from a start 8 degrees off."""
    stars = np.concatenate([frame.vectors_ref for frame in frames])
    constants = refraction_constants(PRESSURE_HPA, 15.0, 600e-9)

    def rms_px(place: Floats) -> float:
        zenith = direction(*place)
        if (stars @ zenith).min() < np.sin(np.radians(LOWEST_DEG)):
            return 10.0
        return calibrate(through(frames, zenith, constants), camera).report.rms_px

    off = start + 0.08 * np.array([1.0, -1.0, 1.0])
    first = np.array([np.arctan2(off[1], off[0]), np.arcsin(off[2] / np.linalg.norm(off))])
    return direction(
        *minimize(
            rms_px, first, method="Nelder-Mead", options={"maxfev": 60, "xatol": 0.004}
        ).x
    )


def direction(ra_rad: float, dec_rad: float) -> Floats:
    return np.array(
        [np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)]
    )


def fitted_scale(
    frames: Sequence[StarFrame], camera: Camera, zenith: Floats
) -> tuple[float, float]:
    """The factor of the refraction with the least residuals, and its standard deviation: a parabola of chi-square."""
    a_rad, b_rad = refraction_constants(PRESSURE_HPA, 15.0, 600e-9)
    scales = np.array([0.0, 0.5, 1.0, 1.5])
    reports = []
    for scale in scales:
        reports.append(
            calibrate(through(frames, zenith, (scale * a_rad, scale * b_rad)), camera).report
        )
    squares = np.array([report.rms_px**2 for report in reports])
    curve, slope, _ = np.polyfit(scales, squares, 2)
    return -slope / (2 * curve), float(
        np.sqrt(squares.min() / (2 * reports[0].stars * curve))
    )


def measure() -> list[dict[str, Any]]:
    """Residuals of each photograph without and with the air, and what the residuals tell of the refraction."""
    if FOLDER not in os.environ:
        raise SystemExit(f"refraction: {FOLDER} does not name the folder of the photographs")
    frames, camera = star_frames(Path(os.environ[FOLDER]))
    calibration, without = fitted(frames, camera)
    zenith = DELFT.zenith(0.0)
    constants = refraction_constants(PRESSURE_HPA, 15.0, 600e-9)
    _, with_air = fitted(through(frames, zenith, constants), camera)
    rows = []
    for n, file in enumerate(FILES):
        boresight = calibration.report.cam_from_ref[n].inv().apply([0.0, 0.0, 1.0])
        altitude_deg = np.degrees(np.arcsin(boresight @ zenith))
        what = f"{len(frames[n].xy_px)} stars, altitude {altitude_deg:.1f} deg"
        rows += [
            figure(f"{file}: residual without air", without[n], "px rms", what),
            figure(f"{file}: residual with air", with_air[n], "px rms", what),
        ]
    scale, sigma = fitted_scale(frames, camera, zenith)
    off_deg = np.degrees(np.arccos(best_zenith(frames, camera, zenith) @ zenith))
    return [
        *rows,
        figure("refraction over the model's", scale, "x", f"sigma {sigma:.2f}"),
        figure("zenith from refraction alone: off by", off_deg, "deg"),
    ]
