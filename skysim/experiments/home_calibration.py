"""AFIT's calibration of camera and LEDs on the vehicle (Padro 2012, sections 3.6.3, 3.6.4, 4.4 and appendix A).

The vehicle is held at several attitudes (stops), and each frame shows the same LEDs. `measure_scene` or
`measure_folder` make a sighting of each frame; `calibrated` takes the thesis's steps:

1. Scale: neighbors in the first frame are a known distance apart (the thesis's four clicks), which gives the focal
   length.
2. Magnitude of each LED (`instrument_brightness`), position by eqs 43-44, and angles of all pairs by eq. 45; mean and
   standard deviation of each, over all frames and at each stop. The largest deviations are the epsilons.
3. Catalog: the LEDs as the frames at home show them.
4. Attitude of each stop by QUEST with the two brightest LEDs of its first frame and of the catalog, and its
   difference from the IMU.

LEDs are named by the predicted image of the assumed dome at the IMU's attitude, so the truth is not used.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from estimator.attitude.nearfield import thesis_points
from estimator.attitude.solvers import quest
from estimator.calibration.home_position import (
    HomeCatalog,
    Sighting,
    body_positions,
    calibrate,
    instrument_brightness,
    led_map,
    separation_rad,
)
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.detection.detect import THESIS_AREA_PX
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError, refusing
from skysim.core.files import make_folder
from skysim.core.types import UP, Array, Floats, Ints, Record, lengths, normalized
from skysim.experiments.dome_survey.survey_frames import CalibrationPrior, calibration_prior
from skysim.experiments.dome_survey.survey_procedure import (
    ATTITUDES,
    pixels_of,
    read_attitudes,
)
from skysim.results.plots import INK, png
from skysim.results.report import (
    Column,
    Figure,
    Report,
    Section,
    Table,
    Verdict,
)
from skysim.results.telemetry_report import EULER, euler_deg
from skysim.scene.scene import Scene
from skysim.simulation.flight import Progress, open_flight
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking.dome_map_file import DomeMap, write_dome_map

SAME_STOP_DEG = 0.5  # frames of a stop differ by less, two stops in a row by more
# A frame whose attitude differs by more from the frame before is taken in motion.
STILL_DEG = 0.05
CLICKS = 4
# Angles with a larger gap are distinct: a bucket of the thesis's pair catalog.
DISTINCT_ARCSEC = 100.0
QUEST_LEDS = 2


class Calibration(NamedTuple):
    """F frames of N LEDs each, and what the thesis computes from them.

    A board that is moved shows other LEDs of the map at each stop; its LEDs are then told apart by their order.

    Attributes
    ----------
    led
        (N,) numbers of the LEDs at home
    stop
        (F,) number of the stop of each frame, from 0
    magnitude, lab_m
        (F, N), and (F, N, 3) positions in the lab by the IMU
    angle_rad
        (F, N (N - 1) / 2) of the pairs, in the order of np.triu_indices
    imu_deg, algorithm_deg
        (S, 3) roll, pitch and yaw of each stop by the IMU and by step 4
    """

    camera: Camera
    catalog: HomeCatalog
    led: Ints
    stop: Ints
    magnitude: Floats
    lab_m: Floats
    angle_rad: Floats
    imu_deg: Floats
    algorithm_deg: Floats


def assumed(lab: Lab) -> CalibrationPrior:
    """What the scene's tracker assumes. Raises InputError for a scene without LEDs."""
    if lab.scene.dome is None:
        raise InputError(
            "light.kind", lab.scene.light.kind, "dome, for a calibration by its LEDs"
        )
    return calibration_prior(lab)


# Frames of a flight, or of a folder.


class HeldFrame(NamedTuple):
    """A frame with the IMU's attitude: the thesis's blobs, and their magnitudes."""

    lab_from_body: Rotation
    xy_px: Floats
    magnitude: Floats


def measure(image_dn: Array, scene: Scene) -> tuple[Floats, Floats]:
    """(N, 2) centroids and (N,) magnitudes of the lights of an image (Padro 2012, sections 3.4.1.3 and 3.6.2.1).

    As the thesis does with MATLAB's `bwlabel` and `regionprops`, by their counterparts in scikit-image: regions of at
    least 50 connected pixels above the threshold, without a filter, so that noise makes holes in a dim light. The
    centroid is that of the region's pixels, all with the same weight. The threshold is the scene's, a share of the
    converter's range: 4 % in the thesis (section 3.7).
    """
    from skimage.measure import label, regionprops_table

    range_dn = 2.0**scene.camera.detector.bits - 1
    threshold_dn = scene.tracker.intensity_threshold * range_dn
    region = label(image_dn > threshold_dn, connectivity=2)
    area_px = np.bincount(region.ravel())
    area_px[0] = 0
    kept = area_px >= THESIS_AREA_PX
    if not kept.any():
        return np.empty((0, 2)), np.empty(0)
    number = np.where(kept, np.cumsum(kept), 0)[region]
    names = ("centroid", "area", "intensity_mean")
    found = regionprops_table(number, image_dn, properties=names)
    xy_px = np.column_stack([found["centroid-1"], found["centroid-0"]])
    return xy_px, instrument_brightness(found["intensity_mean"], found["area"])


def measure_scene(
    scene: Scene, progress: Progress | None = None
) -> tuple[CalibrationPrior, list[HeldFrame]]:
    """Fly a scene and measure its frames. The IMU's attitude is the true one if the vehicle has none."""
    with open_flight(scene) as flight:
        known = assumed(flight.lab)
        measured = [
            (shot.truth.t_s, *measure(shot.frame.image_dn, scene))
            for shot in flight.shots(solves=False, progress=progress)
            if shot.camera is flight.lab.camera
        ]
        log = flight.telemetry()
    attitude = log.lab_from_body if log.lab_from_imu is None else log.lab_from_imu
    at = Slerp(log.t_s, attitude)
    return known, [HeldFrame(at(t_s), *rest) for t_s, *rest in measured]


def measure_folder(folder: Path, scene: Scene) -> tuple[CalibrationPrior, list[HeldFrame]]:
    """Measure the images of a folder with the IMU's attitudes in its `attitudes.csv`. Raises InputError."""
    known = assumed(build_lab(scene))
    attitudes = read_attitudes(folder / ATTITUDES)
    return known, [
        HeldFrame(lab_from_body, *measure(pixels_of(folder / name, known.camera), scene))
        for name, lab_from_body in attitudes.items()
    ]


def sightings(known: CalibrationPrior, frames: Sequence[HeldFrame]) -> Iterator[Sighting]:
    """The frames that show a stop's LEDs: in motion or without an LED they are left out."""
    stop = -1
    start = before = None
    for frame in frames:
        attitude = frame.lab_from_body
        moved_deg = np.inf if before is None else apart_deg(attitude, before)
        before = attitude
        if (moved_deg > STILL_DEG and stop >= 0) or not len(frame.xy_px):
            continue
        if start is None or apart_deg(attitude, start) > SAME_STOP_DEG:
            stop += 1
            start = attitude
        led, row = name_lights(known, frame)
        if len(led):
            yield Sighting(
                stop,
                attitude.inv(),
                known.leds.id[led],
                frame.xy_px[row],
                frame.magnitude[row],
            )


def apart_deg(a: Rotation, b: Rotation) -> float:
    """Rotation angle between two attitudes."""
    return float(np.degrees((a.inv() * b).magnitude()))


def name_lights(known: CalibrationPrior, frame: HeldFrame) -> tuple[Array, Array]:
    """Rows of the map and of the frame's lights that are each other's nearest, within half the least spacing.

    An error of the IMU moves all images alike, so a frame with all its LEDs is first moved onto the expected ones.
    """
    expected_px = known.pixels(frame.lab_from_body.inv())
    led = np.flatnonzero(known.camera.contains(expected_px))
    if not len(led):
        return led, led
    expected_px = expected_px[led]
    xy_px = frame.xy_px
    if len(xy_px) == len(led):
        xy_px = xy_px - xy_px.mean(axis=0) + expected_px.mean(axis=0)
    tree = cKDTree(expected_px)
    # The spacing of a single LED is infinite.
    spacing_px = tree.query(expected_px, 2)[0][:, 1].min()
    _, nearest = tree.query(xy_px)
    distance_px, light = cKDTree(xy_px).query(expected_px)
    is_mutual = nearest[light] == np.arange(len(led))
    named = is_mutual & (distance_px < spacing_px / 2)
    return led[named], light[named]


# The thesis's steps.


def calibrated(
    known: CalibrationPrior, frames: Sequence[HeldFrame], clicks: int = CLICKS
) -> Calibration:
    """The numbered steps of the module.

    Parameters
    ----------
    clicks
        Number of spacings that are measured in the first frame; 0 keeps the scene's focal length

    Raises
    ------
    InputError
        If the frames show no LEDs in common, or too few frames.
    """
    common = complete(list(sightings(known, frames)))
    camera = scaled(known, common[0], clicks) if clicks else known.camera
    with refusing(ImageError, "frames"):
        catalog = calibrate(common, camera, known.leds, known.lever)
    body_m = np.array(
        [body_positions(one.xy_px, camera, known.leds, known.lever) for one in common]
    )
    imu = Rotation.concatenate([one.body_from_lab.inv() for one in common])
    lab_m = np.array([at.apply(led_m) for at, led_m in zip(imu, body_m, strict=True)])
    stop = np.array([one.stop for one in common])
    first = np.unique(stop, return_index=True)[1]
    brightness = np.array([one.brightness for one in common])
    brightest = np.argsort(-brightness[0])[:QUEST_LEDS]
    at_home = normalized(lab_m[0, brightest])
    algorithm_deg = [
        euler_deg(quest(at_home, normalized(body_m[n, brightest]), np.ones(len(brightest))))
        if np.array_equal(common[n].led, common[0].led)
        else np.full(3, np.nan)
        for n in first
    ]
    return Calibration(
        camera,
        catalog,
        common[0].led,
        stop,
        brightness,
        lab_m,
        pair_angles_rad(body_m),
        euler_deg(imu[first]),
        np.array(algorithm_deg),
    )


def complete(seen: Sequence[Sighting]) -> list[Sighting]:
    """The frames that show as many LEDs as the best one, without those of a pause in a motion.

    A pause has less than a tenth of the frames of the longest stop. Raises InputError for fewer than two frames.
    """
    most = max((len(one.led) for one in seen), default=0)
    shown = [one for one in seen if len(one.led) == most]
    frames = np.bincount([one.stop for one in shown], minlength=1)
    kept = [one for one in shown if frames[one.stop] >= frames.max() / 10]
    if most < QUEST_LEDS or len(kept) < 2:
        raise InputError(
            "frames", f"{len(kept)} with {most} LEDs", "2 or more with 2 LEDs or more"
        )
    return kept


def scaled(known: CalibrationPrior, first: Sighting, clicks: int) -> Camera:
    """Step 1: the camera whose focal length makes the first frame's spacings those of the map.

    MATLAB's `cp2tform` of type `linear conformal` is scikit-image's `SimilarityTransform`; its scale is millimeters per
    pixel. As many LEDs around the central one are clicked as asked.
    """
    from skimage.transform import estimate_transform

    place_m = known.leds.position_m[np.searchsorted(known.leds.id, first.led)][:, :2]
    from_center = lengths(place_m - place_m.mean(axis=0))
    clicked = np.argsort(from_center)[: clicks + 1]
    if len(clicked) < QUEST_LEDS:
        raise InputError("clicks", f"{len(clicked)} LEDs in the first frame", "2 or more")
    transform = estimate_transform("similarity", first.xy_px[clicked], place_m[clicked])
    # The first frame is taken at home, with the board before the camera at the distance R - M.
    _, distance_m = thesis_points(UP[None], known.leds, known.lever)
    return replace(known.camera, focal_px=float(distance_m / transform.scale))


def pair_angles_rad(body_m: Floats) -> Floats:
    """(..., N (N - 1) / 2) angles of (..., N, 3) points about the bearing."""
    directions = normalized(body_m)
    a, b = np.triu_indices(directions.shape[-2], 1)
    return separation_rad(directions[..., a, :], directions[..., b, :])


# Numbers and pages.


def statistics(found: Calibration) -> Record:
    """The numbers of `skysim calibrate --json`: LEDs by their brightness, pairs by their angle, stops in order."""
    order = np.argsort(-found.magnitude.mean(axis=0), kind="stable")
    ranked = -np.sort(-found.magnitude, axis=1)
    angle = found.angle_rad / ARCSEC_RAD
    ascending = angle[:, np.argsort(angle.mean(axis=0), kind="stable")]
    groups = np.flatnonzero(np.diff(ascending.mean(axis=0)) > DISTINCT_ARCSEC) + 1
    difference_deg = found.algorithm_deg - found.imu_deg
    columns_mm = 1e3 * found.lab_m
    return {
        "frames": len(found.stop),
        "focal_px": found.camera.focal_px,
        "leds": [{"led": found.led[n]} | spread(found, found.magnitude[:, n]) for n in order],
        "ranks": [spread(found, column) for column in ranked.T],
        "pairs": [spread(found, column) for column in ascending.T],
        "distinct": len(groups) + 1,
        "angles": [
            {"pairs": columns.shape[1]} | spread(found, columns.mean(axis=1))
            for columns in np.split(ascending, groups, axis=1)
        ],
        "epsilon": {
            "magnitude": found.catalog.epsilon_mag,
            "position_mm": 1e3 * found.catalog.epsilon_pos_m,
            "separation_arcsec": found.catalog.epsilon_sep_rad / ARCSEC_RAD,
        },
        "height_range_mm": np.ptp(columns_mm[:, :, 2]),
        "difference_deg": differences(difference_deg),
        "stops": [
            {
                "frames": len(one),
                "imu_deg": found.imu_deg[n],
                "algorithm_deg": found.algorithm_deg[n],
                "difference_deg": difference_deg[n],
                "x_mm": one[:, :, 0].mean(axis=0),
            }
            for n, one in enumerate(by_stop(found, columns_mm))
        ],
    }


def differences(difference_deg: Floats) -> dict[str, Floats]:
    """Table 15: least, largest and mean absolute difference of each angle over the stops, and its deviation (n - 1).

    A single stop has no deviation, NaN.
    """
    absolute = np.abs(difference_deg)
    return {
        "least": absolute.min(axis=0),
        "largest": absolute.max(axis=0),
        "mean": absolute.mean(axis=0),
        "sd": deviation(absolute),
    }


def spread(found: Calibration, values: Floats) -> Record:
    """Mean and standard deviation (n - 1) of (F,) values, over all frames and at each stop."""
    return moments(values) | {"stops": [moments(one) for one in by_stop(found, values)]}


def moments(values: Floats) -> Record:
    """Mean and standard deviation (n - 1) of (F,) values; NaN for the deviation of one."""
    return {"mean": values.mean(), "sd": deviation(values)}


def deviation(values: Floats) -> Any:
    """Standard deviation (n - 1) of (F, ...) values over the first axis; NaN for one."""
    return values.std(axis=0, ddof=1) if len(values) > 1 else np.nan * values[0]


def calibration_report(
    title: str, command: str, found: Calibration, numbers: Record
) -> Report:
    """The report of `statistics`: histograms as in the thesis's appendix A, the tables, and the epsilons."""
    epsilon = numbers["epsilon"]
    text = (
        f"{len(numbers['leds'])} LEDs in {numbers['frames']} frames at {len(numbers['stops'])} stops; epsilons, the"
        f" largest deviations: {epsilon['magnitude']:.3g} of the magnitude, {epsilon['position_mm']:.3g} mm of the"
        f" position, {epsilon['separation_arcsec']:.3g}″ of an angle"
    )
    figures = [
        Figure(png(partial(draw, found), size_in), caption)
        for draw, size_in, caption in (
            (draw_magnitudes, (7.4, 4.2), "Magnitudes by LED, a color for each stop."),
            (draw_angles, (7.4, 3.2), "Angles of all pairs about the bearing."),
            (draw_places, (6.0, 4.6), "LEDs in the lab by the IMU, a color for each stop."),
        )
    ]
    magnitude = Column("magnitude", "", ".2f")
    angle = Column("angle", "″", ".1f")
    by_led = spread_table("led", "LED", magnitude, numbers["leds"])
    by_rank = spread_table("", "rank in the image", magnitude, numbers["ranks"])
    pairs = spread_table("", "pair", angle, numbers["pairs"])
    distinct = spread_table("pairs", "pairs of one angle", angle, numbers["angles"])

    def angles(source: str = "") -> list[Column]:
        return [Column(name + source, "°", ".4f") for name in EULER]

    stops = Table(
        [Column("stop"), Column("frames"), *angles(" IMU"), *angles(" camera")],
        [
            [n, one["frames"], *one["imu_deg"], *one["algorithm_deg"]]
            for n, one in enumerate(numbers["stops"], 1)
        ],
    )
    difference = Table(
        ["camera minus IMU, absolute", *angles()],
        [[name, *values] for name, values in numbers["difference_deg"].items()],
    )
    sections = [
        Section("LEDs", [by_led, by_rank]),
        Section("Angles of pairs", [distinct, pairs]),
        Section("Attitudes", [stops, difference]),
    ]
    return Report(title, [Verdict(text), *figures, *sections], command)


def spread_table(key: str, name: str, value: Column, rows: list[Record]) -> Table:
    """Mean and deviation of the rows of `statistics`, over all frames, and the mean at each stop.

    The first column has the row's value of `key`, or its number.
    """
    stops = max((len(one["stops"]) for one in rows), default=0)
    columns = [Column(name), value, value._replace(title="deviation", format=".2f")]
    columns += [value._replace(title=f"stop {n + 1}") for n in range(stops)]
    cells = [
        [one.get(key, n), one["mean"], one["sd"], *(stop["mean"] for stop in one["stops"])]
        for n, one in enumerate(rows, 1)
    ]
    return Table(columns, cells)


def write_results(
    folder: Path, scene: str, known: CalibrationPrior, found: Calibration, command: str
) -> tuple[Record, Report]:
    """Write the report, and the catalog as a map for `tracker.map`; return what `--json` prints, and the report."""
    numbers = statistics(found)
    made = calibration_report(f"Calibration of {scene}", command, found, numbers)
    page = make_folder(folder) / "report.html"
    made.save(page)
    catalog = folder / "leds.ecsv"
    with refusing(ImageError, "catalog"):
        write_dome_map(catalog, catalog_map(known, found))
        numbers["map"] = str(catalog)
    return numbers | {"report": str(page)}, made


def catalog_map(known: CalibrationPrior, found: Calibration) -> DomeMap:
    """The on-board catalog (section 3.6.4), with the camera as calibrated. Raises ImageError."""
    leds = led_map(found.catalog, known.leds)
    camera = found.camera
    return DomeMap(
        leds.id,
        leds.position_m,
        np.full(len(leds.id), found.catalog.epsilon_pos_m),
        known.lever.camera_body_m,
        known.lever.sigma_m,
        (camera.width_px, camera.height_px),
        camera.focal_px,
        0.0,
        camera.center_px,
        (0.0, 0.0),
        camera.distortion,
        (0.0,) * 5,
    )


def by_stop(found: Calibration, values: Floats) -> list[Floats]:
    """The values of each stop's frames."""
    return [values[found.stop == n] for n in np.unique(found.stop)]


def draw_magnitudes(found: Calibration, fig: Any) -> None:
    """A histogram of each LED's magnitudes, stacked by stop (appendix A, Figs 85-92)."""
    order = np.argsort(-found.magnitude.mean(axis=0), kind="stable")
    axes = fig.subplots(-(-len(order) // 3), 3, squeeze=False).ravel()
    for one, led in zip(axes, order, strict=False):
        values = by_stop(found, found.magnitude[:, led])
        colors = [INK[n % len(INK)] for n in range(len(values))]
        one.hist(values, 20, stacked=True, color=colors)
        one.set_title(f"LED {found.led[led]}", fontsize=8)
    for one in axes[len(order) :]:
        one.set_axis_off()


def draw_angles(found: Calibration, fig: Any) -> None:
    """A histogram of all pairs' angles (Figs 66, 71, 76)."""
    axes = fig.subplots()
    axes.hist(found.angle_rad.ravel() / ARCSEC_RAD, 120, color=INK[0])
    axes.set(xlabel="angle of a pair (arcsec)", ylabel="pairs in all frames")


def draw_places(found: Calibration, fig: Any) -> None:
    """X and Y of the LEDs in the lab (Fig. 79); a bump of the IMU moves a stop's pattern."""
    axes = fig.subplots()
    for n, lab_m in enumerate(by_stop(found, found.lab_m)):
        x_mm, y_mm, _ = 1e3 * lab_m.mean(axis=0).T
        axes.plot(x_mm, y_mm, "o", color=INK[n % len(INK)], label=f"stop {n + 1}", alpha=0.8)
    axes.set(xlabel="X (mm)", ylabel="Y (mm)", aspect="equal")
    axes.legend()
