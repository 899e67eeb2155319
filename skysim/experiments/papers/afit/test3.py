"""AFIT's Test 3, calibration (Padro 2012, 4.4.1, Tables 6-9, Figs 74-79): five LEDs, five positions, 50 images each.

The thesis derives its identification tolerances (epsilons) from the scatter of magnitudes, positions and separations
over 250 images. We repeat this on rendered images with LED positions that are fitted to Table 8, then with likely
faults of the camera, and with the IMU errors of Tables 10-14.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from estimator.calibration.home_position import Sighting, instrument_brightness
from estimator.catalog.catalog import unit
from estimator.catalog.pair_index import bucket_of, build_pair_catalog
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.checks import Ints
from estimator.core.types import FramePriors
from estimator.detection.detect import DETECTORS
from skysim.core.constants import ARCSEC_RAD
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Mount
from skysim.dynamics import guidance
from skysim.experiments.papers.afit.test_stand import light_positions_m, pair_angles_arcsec
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_interval,
)
from skysim.experiments.papers.published import experiments, published_values
from skysim.results.metrics import Summary, exact, extremum
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.sections.motion import AttitudeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import factory, onboard_model

# AFIT's Test 3 at fixed attitudes (Padro 2012, 3.7.3): five LEDs imaged from five attitudes, and
# his measurements.


# Roll, pitch, yaw in degrees, Tables 10-14: by the IMU, and by the thesis's algorithm.
IMU_DEG = experiments()["afit-table-10-15"].data["imu_deg"]
ALGORITHM_DEG = experiments()["afit-table-10-15"].data["algorithm_deg"]
LEDS = 5
HOME = 0

CAMERA_ROTATION_DEG = (
    55.0  # of the camera about its boresight: assumed; at 0 deg it misses position 4
)
# Table 9
EPSILON_MAG = 10.191
EPSILON_POS_M = 1.9861e-3
EPSILON_SEP_ARCSEC = 9.675

# What the thesis states about its images, and assumptions for the rest; see data/published.
STATED_IMAGING = {
    "camera.detector.bits": "8",
    "camera.detector.gain_e_dn": "164",
    "camera.detector.offset_dn": "2",
    "light.led.scatter": "0",
    "light.led.intensity": "35 mcd",
    "light.layout.levels": "[1.0, 0.5, 0.4, 0.2, 0.075]",
    "exposure.rate_hz": "0.987",
}
FITTED_IMAGING = {  # rolling shutter, exposure of a non-integer number of LED cycles, early saturation
    "camera.shutter": '{kind: rolling, row_time: "83 us"}',
    "tracker.assumed_row_time": "0 s",  # the thesis's tracker does not know its rows' times
    "camera.detector.full_well_e": "30500",
    "exposure.time": "16.667 ms",
    "light.led.intensity": "73.5 mcd",
}


def build_test3(overrides: Mapping[str, str] | None = None) -> Lab:
    """Test 3's lab, with the camera turned so that all five positions are on the detector."""
    lab = build_lab(loader.load("afit_test3_ideal", STATED_IMAGING | dict(overrides or {})))
    cam_from_body = (
        Rotation.from_euler("z", CAMERA_ROTATION_DEG, degrees=True)
        * lab.camera.mount.cam_from_body
    )
    return lab.with_camera(mount=Mount(lab.camera.mount.camera_body_m, cam_from_body))


def lab_from_body(angles_deg: Sequence[float] | Floats) -> Rotation:
    """lab_from_body from roll, pitch and yaw."""
    roll, pitch, yaw = angles_deg
    return guidance.attitude(AttitudeConfig(roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw))


def photograph(
    lab: Lab, position: int, lab_from_body: Rotation, images: int, rng: np.random.Generator
) -> list[Sighting]:
    """Images from one attitude at random times; lights identified by the truth, in the order of the LEDs.

    The IMU's attitude is the true one. Images without all five LEDs are left out.
    """
    camera = onboard_model.calibration(lab.scene.camera)
    settings = factory.assumed_settings(lab.scene)
    sightings = []
    # Each image in a run of its own, for a random phase of the LEDs.
    for seed in rng.integers(2**62, size=images):
        frame, truth = render_at_rest(lab.in_run(int(seed)).camera, lab_from_body)
        priors = FramePriors(None, frame.saturation_dn)
        blobs = DETECTORS["thesis"](frame.image_dn, priors=priors)
        lights = CENTROIDERS["cog"](frame.image_dn, blobs, settings.gain_e_dn, priors)
        inside = camera.contains(lights.xy_px)
        _, nearest = cKDTree(truth.sources.xy_px).query(lights.xy_px[inside])
        magnitude = instrument_brightness(
            blobs.flux / blobs.area_px, blobs.area_px.astype(float)
        )
        led, led_row = np.unique(truth.sources.id[nearest], return_index=True)
        if len(led) == LEDS:
            row = np.flatnonzero(inside)[led_row]
            sightings.append(
                Sighting(
                    position, lab_from_body.inv(), led, lights.xy_px[row], magnitude[row]
                )
            )
    return sightings


class Measurements(NamedTuple):
    """F images of all five LEDs as the thesis measures them (eqs 43-45).

    Attributes
    ----------
    position
        (F,) of the vehicle, from 0
    magnitude
        (F, 5)
    body_m, lab_m
        (F, 5, 3) LED positions in body axes, and rotated to the lab frame by the IMU's attitude
    """

    position: Ints
    magnitude: Floats
    body_m: Floats
    lab_m: Floats

    @property
    def separation_arcsec(self) -> Floats:
        """(F, 10) angle about the bearing of every pair, in the order of np.triu_indices."""
        return pair_angles_arcsec(self.body_m)


def measure(lab: Lab, sightings: Sequence[Sighting]) -> Measurements:
    """Measure the images as in the thesis."""
    body_m = np.array([light_positions_m(lab, sighting.xy_px) for sighting in sightings])
    lab_m = [
        one.body_from_lab.inv().apply(led_m)
        for one, led_m in zip(sightings, body_m, strict=True)
    ]
    position = np.array([one.stop for one in sightings])
    magnitude = np.array([one.brightness for one in sightings])
    return Measurements(position, magnitude, body_m, np.array(lab_m))


ID = "afit-table-6-9"
BUMPED_POSITION = 4
# True attitudes: the IMU's angles, but the algorithm's at the fifth position, where the IMU was bumped.
TRUE_ANGLES_DEG = (*IMU_DEG[:BUMPED_POSITION], ALGORITHM_DEG[BUMPED_POSITION])
ON_US = np.array([1000.0, 500.0, 400.0, 200.0, 1.0])
LINEAR_LEDS = slice(1, 4)  # LEDs of 500, 400 and 200 us
# Rows of neighbors, diagonals, opposite ends of the cross.
TABLE_8_GROUPS = ((0, 4), (4, 8), (8, 10))
MIN_DIFFERENCE_ARCSEC = (
    100.0  # width of the catalog's buckets; angles closer than this count as one
)
NOMINAL_POSITIONS = (
    '[["0 mm", "0 mm", "48 in"], ["8 mm", "0 mm", "48 in"], ["0 mm", "8 mm", "48 in"], \
["-8 mm", "0 mm", "48 in"], ["0 mm", "-8 mm", "48 in"]]'
)
CAUSE = "a rolling shutter, 1/60 s and pixels full at 186 DN"

Statistic = Callable[[Floats], Any]


def tables_6_to_9(options: ExperimentOptions) -> ExperimentResult:
    """Tables 6-9: with our baseline, with likely faults of the camera as the cause, and with a bumped IMU."""
    images = options.trials(50, 3)
    few_images = options.trials(10, 2)
    plan = {
        "ours": ({}, images),
        "camera faults": (FITTED_IMAGING, images),
        "nominal": ({"light.layout.positions": NOMINAL_POSITIONS}, few_images),
        "stated levels": ({"light.layout.levels": "[1.0, 0.5, 0.4, 0.2, 0.001]"}, few_images),
    }
    positions = [
        f'["{x * 1e3:.4f} mm", "{y * 1e3:.4f} mm", "48 in"]'
        for x, y, _ in fit_positions(build_test3())
    ]
    fitted_overrides = {"light.layout.positions": f"[{', '.join(positions)}]"}
    series = {}
    for done, (name, (overrides, n_images)) in enumerate(plan.items()):
        options.watch(done, len(plan))
        lab = build_test3(fitted_overrides | overrides)
        rng = random_stream(options.seed, done)
        series[name] = ImageSeries(lab, photograph_positions(lab, n_images, rng))
    ours = series["ours"].measurements
    with_faults = series["camera faults"].measurements
    nominal = series["nominal"].measurements
    bumped = series["ours"].bumped(BUMPED_POSITION)
    drifted = series["ours"].bumped(*range(len(IMU_DEG)))
    results = magnitudes(ours, with_faults, series["stated levels"]) | separations(
        ours, with_faults, nominal
    )
    results |= epsilons(ours, with_faults, bumped, drifted) | buckets()
    drawings = (
        FigureDrawing(
            f"Figs 74 and 75: magnitudes of 250 images, ours with {CAUSE}.",
            lambda fig: draw_magnitudes(fig, with_faults),
        ),
        FigureDrawing(
            f"Fig. 76: angles of all pairs, ours with {CAUSE}.",
            lambda fig: draw_separations(fig, with_faults),
        ),
        FigureDrawing(
            "Figs 77 and 79: positions of the five LEDs; the IMU is correct except at the bumped position 5.",
            lambda fig: draw_scatter(fig, bumped),
            (6.4, 3.9),
        ),
    )
    return ExperimentResult(results, drawings)


class ImageSeries(NamedTuple):
    """Images of one lab."""

    lab: Lab
    sightings: list[Sighting]

    @property
    def measurements(self) -> Measurements:
        """The images as measured in the thesis."""
        return measure(self.lab, self.sightings)

    def bumped(self, *positions: int) -> Measurements:
        """The same images, with the IMU errors of Tables 10-14 at these positions."""
        sightings = []
        for one in self.sightings:
            if one.stop in positions:
                imu_error_deg = np.subtract(IMU_DEG[one.stop], ALGORITHM_DEG[one.stop])
                by_imu = lab_from_body(np.add(TRUE_ANGLES_DEG[one.stop], imu_error_deg))
                one = replace(one, body_from_lab=by_imu.inv())
            sightings.append(one)
        return measure(self.lab, sightings)


def photograph_positions(lab: Lab, images: int, rng: np.random.Generator) -> list[Sighting]:
    """Images at each of the five positions, with a perfect IMU."""
    return [
        sighting
        for position, angles in enumerate(TRUE_ANGLES_DEG)
        for sighting in photograph(lab, position, lab_from_body(angles), images, rng)
    ]


def fit_positions(lab: Lab) -> Floats:
    """(5, 3) LED positions in the board's plane for which the thesis's eqs 43-45, without noise, give Table 8.

    Least squares of eight coordinates to ten angles; the central LED is fixed. Table 8 is sorted, so its angles are
    assigned to pairs by the order of the angles from the scene's positions, which neglect the error of eq. 44.
    """
    published_arcsec = published("separation", 10)
    position_m = lab.camera.sources.place[:, :3].copy()
    start_arcsec = expected_angles_arcsec(lab, position_m)
    # Table 8 is in ascending order: its k-th angle belongs to the pair with the k-th smallest start angle.
    target_arcsec = np.empty(len(published_arcsec))
    target_arcsec[np.argsort(start_arcsec)] = published_arcsec

    def residual_arcsec(arms_mm: Floats) -> Floats:
        position_m[1:, :2] = arms_mm.reshape(-1, 2) / 1e3
        return expected_angles_arcsec(lab, position_m) - target_arcsec

    fitted_mm = least_squares(residual_arcsec, position_m[1:, :2].ravel() * 1e3).x
    position_m[1:, :2] = fitted_mm.reshape(-1, 2) / 1e3
    return position_m


def expected_angles_arcsec(lab: Lab, position_m: Floats) -> Floats:
    """(10,) angle of every pair as the thesis measures it, without noise, averaged over the vehicle's positions."""
    lever = onboard_model.assumed_lever(lab.scene, lab.camera.mount)
    camera = onboard_model.calibration(lab.scene.camera)
    pixels = [
        project(lab_from_body(angles_deg).inv(), position_m, lever, camera)
        for angles_deg in TRUE_ANGLES_DEG
    ]
    body_m = np.array([light_positions_m(lab, xy_px) for xy_px in pixels])
    return pair_angles_arcsec(body_m).mean(axis=0)


# Statistics of the images, with intervals over the images.


def stratified_bootstrap(
    measurements: Measurements, values: Floats, statistic: Statistic
) -> Summary:
    """A statistic of (F, ...) values of the images, with a bootstrap interval stratified by position.

    Images are resampled within each position only, because the differences between positions are systematic.

    Parameters
    ----------
    statistic
        Of (..., F, K) values to (...), over the last two axes
    """
    position = measurements.position
    rows = np.arange(len(values))
    first_row = np.searchsorted(position, position)
    count = np.bincount(position)[position]
    table = values.reshape(len(values), -1)

    def statistic_of_draw(index: Floats, axis: int = -1) -> Any:
        unchanged = np.array_equal(index, rows)
        # A resampled index becomes an image of the position of the image that it replaces (stratified bootstrap).
        chosen = index if unchanged else first_row + index % count
        return statistic(table[chosen.astype(int)])

    return bootstrap_interval(rows.astype(float), statistic_of_draw)


def with_camera_faults(
    baseline: Measurements,
    with_faults: Measurements,
    quantity: str,
    columns: Any,
    statistic: Statistic,
    note: str = "",
) -> RowResult:
    """A statistic of columns of a quantity, of our images and of those with likely faults of the camera."""
    ours, theirs = (
        stratified_bootstrap(one, getattr(one, quantity)[:, columns], statistic)
        for one in (baseline, with_faults)
    )
    return RowResult(ours, note, Cause(CAUSE, theirs))


def mean(values: Floats) -> Any:
    """Mean over images and columns."""
    return values.mean(axis=(-2, -1))


def largest_std(values: Floats) -> Any:
    """Largest standard deviation of the columns over all images. It includes the systematic differences between
    positions, so the sum is divided by n and not by n - 1."""
    return values.std(axis=-2).max(axis=-1)


def std_within_position(measurements: Measurements) -> float:
    """Standard deviation of a pair's angle within a position, averaged over positions; the largest over pairs."""
    angle = measurements.separation_arcsec
    std = [
        angle[measurements.position == n].std(axis=0, ddof=1)
        for n in np.unique(measurements.position)
    ]
    return float(np.mean(std, axis=0).max())


def slope(values: Floats) -> Any:
    """Least-squares slope of the mean magnitude against the on-time in microseconds."""
    lit = ON_US[LINEAR_LEDS] - ON_US[LINEAR_LEDS].mean()
    return values.mean(axis=-2) @ lit / (lit @ lit)


def magnitudes(
    ours: Measurements, with_faults: Measurements, stated_levels: ImageSeries
) -> Results:
    """Table 7: means and standard deviations of the magnitudes."""
    results: Results = {}
    for n in range(len(ON_US)):
        magnitude = with_camera_faults(ours, with_faults, "magnitude", [n], mean)
        spread = with_camera_faults(ours, with_faults, "magnitude", [n], largest_std)
        results |= {f"magnitude_{n + 1}": magnitude, f"magnitude_sd_{n + 1}": spread}
    # Only images with five LEDs are kept, so every one of `stated_levels` shows the LED of 1 us.
    dimmest = 0.0
    if stated_levels.sightings:
        dimmest = stated_levels.measurements.magnitude[:, -1].mean()
    longer = Cause("75 us of light (fitted)", magnitude.ours)
    results["magnitude_5"] = RowResult(exact(dimmest), cause=longer)
    results["slope"] = stratified_bootstrap(ours, ours.magnitude[:, LINEAR_LEDS], slope)
    means = ours.magnitude.mean(axis=0)
    results["order"] = exact(1 + np.sum(np.diff(means) < 0))
    return results


def separations(
    ours: Measurements, with_faults: Measurements, nominal: Measurements
) -> Results:
    """Table 8: separations of the pairs in ascending order."""
    order = np.argsort(ours.separation_arcsec.mean(axis=0))
    angle = ours.separation_arcsec[:, order]
    results: Results = {}
    for n, pair in enumerate(order.tolist(), 1):
        results[f"separation_{n}"] = stratified_bootstrap(ours, angle[:, [n - 1]], mean)
        results[f"separation_sd_{n}"] = with_camera_faults(
            ours, with_faults, "separation_arcsec", [pair], largest_std
        )
    nominal_angle = np.sort(nominal.separation_arcsec, axis=1)
    for n, (first, last) in enumerate(TABLE_8_GROUPS, 1):
        results[f"class_{n}"] = stratified_bootstrap(
            nominal, nominal_angle[:, first:last], mean
        )
    is_distinct = np.diff(angle.mean(axis=0)) > MIN_DIFFERENCE_ARCSEC
    results["classes"] = exact(1 + np.sum(is_distinct))
    return results


def epsilons(
    ours: Measurements, with_faults: Measurements, bumped: Measurements, drifted: Measurements
) -> Results:
    """Table 9 and Figs 77-79: the largest pooled standard deviations; positions in millimeters."""
    position = {
        name: stratified_bootstrap(
            series, series.lab_m.reshape(len(series.lab_m), -1) * 1e3, largest_std
        )
        for name, series in (("ours", ours), ("bumped", bumped), ("drifted", drifted))
    }
    at_one_position = f"{std_within_position(ours):.2g} for a pair at one position"
    separation_note = f"{at_one_position}; the rest is the error of eq. 44 between positions"
    column_mm = np.sort(
        bumped.lab_m[bumped.position == BUMPED_POSITION, :, 0].mean(axis=0) * 1e3
    )
    return {
        "epsilon_mag": with_camera_faults(
            ours, with_faults, "magnitude", slice(None), largest_std
        ),
        "epsilon_pos": RowResult(
            position["ours"],
            f"with all differences of Tables 10-14 attributed to the IMU: {position['drifted'].value:.2f}",
            Cause("position 5 bumped", position["bumped"]),
        ),
        "epsilon_sep": with_camera_faults(
            ours, with_faults, "separation_arcsec", slice(None), largest_std, separation_note
        ),
        "columns": extremum(column_mm, lambda x: (x[-1] - x[0]) / 2),
        "height": extremum(ours.lab_m[:, :, 2].ravel() * 1e3, np.ptp),
    }


def buckets() -> Results:
    """Section 2.4.6: length of the example's bucket table, percentage searched outside the gate, and eq. 12."""
    low = np.radians(1.5)
    high = np.radians(8.0)
    width = 5 * ARCSEC_RAD
    gate = 20 * ARCSEC_RAD
    stars = unit(random_stream(0).standard_normal((500, 3)))
    entries = (
        len(build_pair_catalog(stars, np.zeros(len(stars)), width, (low, high)).table) - 1
    )
    # Average over the phase of a pair's angle within a bucket.
    angle = (low + high) / 2 + width * (np.arange(1000) + 0.5) / 1000
    first = bucket_of(angle - gate, high, width, entries)
    last = bucket_of(angle + gate, high, width, entries)
    searched_rad = (last - first + 1).mean() * width
    # Eq. 12: a pair 1.7 buckets below the end, a gate of 0.6.
    example_rad = high - np.array([2.3, 1.1]) * width
    example_low, example_high = bucket_of(example_rad, high, width, entries)
    return {
        "buckets": exact(entries),
        "extra": exact(100 * (searched_rad / (2 * gate) - 1)),
        "example_low": exact(entries - example_low),
        "example_high": exact(entries - example_high - 1),
    }


# Figures.


def published(key: str, count: int) -> Floats:
    """Published values of the rows key_1 to key_count of Tables 7 and 8."""
    return published_values(ID, *(f"{key}_{n}" for n in range(1, count + 1)))


def draw_magnitudes(fig: Any, with_faults: Measurements) -> None:
    """A histogram for each LED, with Table 7's mean and deviation above."""
    axes = fig.subplots()
    edges = np.arange(0, 171, 2.0)
    heights = [
        axes.hist(magnitude, edges, color=INK[0], alpha=0.75)[0].max()
        for magnitude in with_faults.magnitude.T
    ]
    axes.patches[0].set_label("ours")
    mean, sd = (published(key, len(ON_US)) for key in ("magnitude", "magnitude_sd"))
    height = np.full(len(mean), 1.08 * max(heights))
    axes.errorbar(mean, height, xerr=sd, fmt="o", color=INK[1], label="published, with 1 sd")
    axes.set(xlabel="instrument magnitude", ylabel="images", ylim=(0, 1.3 * max(heights)))
    axes.legend(loc="upper right", ncols=2)


def draw_separations(fig: Any, with_faults: Measurements) -> None:
    """The three groups of angles side by side, and Table 8's means and deviations."""
    angle = np.sort(with_faults.separation_arcsec, axis=1)
    mean = published("separation", 10)
    sd = published("separation_sd", 10)
    panels = fig.subplots(1, len(TABLE_8_GROUPS), sharey=True)
    groups = [slice(*ends) for ends in TABLE_8_GROUPS]
    for axes, group in zip(panels, groups, strict=True):
        bins = np.arange(mean[group].mean() - 60, mean[group].mean() + 61, 4.0)
        axes.hist(angle[:, group].ravel(), bins, color=INK[0], alpha=0.75, label="ours")
        axes.set(xlabel="angle (arcsec)")
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes, group in zip(panels, groups, strict=True):
        height = top * (1.05 + 0.06 * np.arange(len(mean[group])))
        axes.errorbar(
            mean[group],
            height,
            xerr=sd[group],
            fmt="o",
            color=INK[1],
            label="published, with 1 sd",
        )
        axes.set(ylim=(0, 1.4 * top))
    panels[0].set(ylabel="pairs in images")
    panels[-1].legend(loc="upper right", fontsize=8)


def draw_scatter(fig: Any, bumped: Measurements) -> None:
    """X and Y of every LED in the lab frame, one marker per position, the mean in black, and Table 9's deviation."""
    axes = fig.subplots()
    position_mm = bumped.lab_m * 1e3
    for n in range(len(IMU_DEG)):
        x, y = position_mm[bumped.position == n].mean(axis=0)[:, :2].T
        axes.plot(x, y, MARKS[n], color=INK[n], ls="", label=f"position {n + 1}", alpha=0.8)
    x, y = position_mm.mean(axis=0)[:, :2].T
    axes.plot(x, y, "+", color="black", ms=9, ls="", label="mean")
    epsilon_mm = experiments()[ID].rows["epsilon_pos"].published
    axes.errorbar(
        x, y - 0.5, xerr=epsilon_mm, fmt="none", color=INK[1], label="published eps_position"
    )
    axes.set(xlabel="X (mm)", ylabel="Y (mm)", aspect="equal")
    fig.legend(loc="outside right upper")
