"""Compare the tracker's solution of each shot with the truth, as rows and tables of numbers."""

import html
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, RateEstimate, ra_dec_roll_rad
from estimator.trackers.pipeline import Report
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Array, Frame, Record, Truth, frozen
from skysim.results import metrics
from skysim.results.plots import Picture, annotate, reduce_width, visible
from skysim.results.report import embed
from skysim.scene.scene import Scene
from skysim.simulation.flight import Shot
from skysim.simulation.lab import StarCamera

# RA, Dec, roll, or roll, pitch, yaw of the vehicle, degrees.
Angles = tuple[float, float, float]


@frozen
class FrameRow:
    """One frame of a run for the report: angles in degrees, errors in arcseconds, times in ms.

    Attributes
    ----------
    truth_deg, estimate_deg
        (RA, Dec, roll) of the camera under the stars, (roll, pitch, yaw) of the vehicle under the dome
    wrong
        Whether the solution has an error of more than ten arcminutes and of more than the tracker claims
        (`metrics.is_wrong`)
    filter
        Status of the attitude filter's update with the solution; empty without a filter
    cross_sigma_arcsec, roll_sigma_arcsec
        Standard deviations that the tracker claims
    log10_chance
        Logarithm of the probability that its matches are chance
    rate_error_deg_s
        Length of the tracker's angular rate of the camera minus the truth; with the nearer of the two signs if the
        tracker does not know the sign
    rate_sigma_deg_s
        Standard deviation that the tracker claims for the rate
    magnitude_error_mag, magnitude_sigma_mag
        Mean and standard deviation of measured minus catalog magnitude of its stars; NaN of LEDs
    nees
        Squared error over the claimed covariance; 3 on average if the claim is true
    survey_share
        Share of the claimed variance by errors of the survey, which all frames have in common
    """

    frame: int
    t_s: float
    rate_deg_s: float
    status: str
    truth_deg: Angles
    estimate_deg: Angles | None
    cross_arcsec: float
    roll_arcsec: float
    detected: int
    matched: int
    rms_px: float
    time_ms: float
    wrong: bool
    filter: str = ""
    cross_sigma_arcsec: float = math.nan
    roll_sigma_arcsec: float = math.nan
    log10_chance: float = math.nan
    exposure_s: float = math.nan
    rate_error_deg_s: float = math.nan
    rate_sigma_deg_s: float = math.nan
    magnitude_error_mag: float = math.nan
    magnitude_sigma_mag: float = math.nan
    nees: float = math.nan
    survey_share: float = math.nan


def angle_names(scene: Scene) -> tuple[str, str, str]:
    """Names of the three angles of a row."""
    return ("RA", "Dec", "roll") if scene.stars else ("roll", "pitch", "yaw")


def angles_deg(cam_from_lab: Rotation, camera: StarCamera) -> Angles:
    """RA, Dec, roll of the camera under the stars; otherwise roll, pitch, yaw (3-2-1 sequence) of the vehicle."""
    if camera.scene.stars:
        ra, dec, roll = np.degrees(ra_dec_roll_rad(cam_from_lab))
        return float(ra), float(dec), float(roll)
    lab_from_body = cam_from_lab.inv() * camera.mount.cam_from_body
    yaw, pitch, roll = lab_from_body.as_euler("ZYX", degrees=True)
    return float(roll), float(pitch), float(yaw)


def scored_attitude(camera: StarCamera, truth: Truth) -> Rotation:
    """The cam_from_lab that solutions are compared with: the mean over the exposure, by the mount of the calibration.

    A mount that has moved since makes an error of the vehicle's attitude.
    """
    return camera.mount.cam_from_body * truth.mean_lab_from_body.inv()


def true_angles_deg(camera: StarCamera, truth: Truth) -> Angles:
    """`angles_deg` of the truth that solutions are compared with."""
    return angles_deg(scored_attitude(camera, truth), camera)


def row(
    camera: StarCamera, frame: Frame, truth: Truth, report: Report, update_status: str = ""
) -> FrameRow:
    """Truth, solution and errors of one frame; `update_status` is how the attitude filter used the solution.

    Errors and standard deviations are in arcseconds, NaN without a solution.
    """
    attitude = report.attitude
    cam_from_lab = scored_attitude(camera, truth)
    cross = roll = cross_sigma = roll_sigma = chance = nees = survey_share = math.nan
    estimate = None
    wrong = False
    if attitude.cam_from_ref is not None:
        cross, roll = metrics.cross_and_roll_rad(attitude.cam_from_ref, cam_from_lab)
        estimate = angles_deg(attitude.cam_from_ref, camera)
        covariance = np.full((3, 3), np.nan)
        if attitude.covariance_rad2 is not None:
            covariance = attitude.covariance_rad2
            nees = metrics.normalized_error_squared(
                attitude.cam_from_ref, cam_from_lab, covariance
            )
        unclaimed = math.isnan(nees)
        wrong = metrics.is_wrong(np.hypot(cross, roll), np.inf if unclaimed else nees)
        variance = np.diag(covariance)
        if attitude.systematic_rad2 is not None:
            survey_share = float(np.trace(attitude.systematic_rad2) / variance.sum())
        cross_sigma = math.sqrt(variance[:2].sum())
        roll_sigma = math.sqrt(variance[2])
        chance = attitude.match.log10_chance if attitude.match else chance
    rate_error, rate_sigma = rate_errors_deg_s(attitude.rate, truth)
    magnitude_error, magnitude_sigma = magnitude_errors_mag(report, frame.exposure_s)
    return FrameRow(
        frame=frame.index,
        t_s=truth.t_s,
        rate_deg_s=float(np.degrees(np.linalg.norm(truth.mean_rate_cam_rad_s))),
        status=attitude.status,
        truth_deg=true_angles_deg(camera, truth),
        estimate_deg=estimate,
        cross_arcsec=cross / ARCSEC_RAD,
        roll_arcsec=roll / ARCSEC_RAD,
        cross_sigma_arcsec=cross_sigma / ARCSEC_RAD,
        roll_sigma_arcsec=roll_sigma / ARCSEC_RAD,
        log10_chance=chance,
        detected=len(report.centroids),
        matched=len(attitude.match.observed) if attitude.match else 0,
        rms_px=attitude.rms_px,
        time_ms=1e3 * sum(report.seconds.values()),
        wrong=wrong,
        filter=update_status,
        exposure_s=frame.exposure_s,
        rate_error_deg_s=rate_error,
        rate_sigma_deg_s=rate_sigma,
        magnitude_error_mag=magnitude_error,
        magnitude_sigma_mag=magnitude_sigma,
        nees=nees,
        survey_share=survey_share,
    )


def error_statistics(errors_arcsec: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Median and worst magnitude of cross-boresight and roll errors in arcseconds; NaN without any."""
    sizes = np.abs(errors_arcsec or [(math.nan, math.nan)]).T
    return {
        f"{name}_arcsec_{kind}": float(statistic(size))
        for name, size in zip(("cross", "roll"), sizes, strict=True)
        for kind, statistic in (("median", np.median), ("worst", np.max))
    }


def magnitude_errors_mag(report: Report, exposure_s: float) -> tuple[float, float]:
    """Mean and standard deviation of measured minus catalog magnitude of a frame's identified stars; NaN without any.

    A star's measured magnitude is -2.5 log10 of its light in DN per second of exposure, so that the mean is the offset
    of the instrument's magnitudes. PTASE's identifier "returns the mean and variance for the identified stars magnitude
    errors", for the calibration of offset and tolerance (Fialho & Saotome 2005, section 3.5).
    """
    match = report.attitude.match
    if match is None or match.v_mag is None:
        return math.nan, math.nan
    flux_dn_s = report.centroids.flux[match.observed] / exposure_s
    errors = -2.5 * np.log10(flux_dn_s) - match.v_mag
    return float(errors.mean()), float(errors.std(ddof=1))


def rate_errors_deg_s(rate: RateEstimate | None, truth: Truth) -> tuple[float, float]:
    """Error of a rate, with the sign that is nearer to the truth if its own is unknown, and the error that it claims.

    Both are lengths of vectors, NaN without a rate.
    """
    if rate is None:
        return math.nan, math.nan
    signs = (1,) if rate.sign_known else (1, -1)
    error = min(
        np.linalg.norm(sign * rate.rate_rad_s - truth.mean_rate_cam_rad_s) for sign in signs
    )
    return float(np.degrees(error)), float(
        np.degrees(np.sqrt(np.trace(rate.covariance_rad2_s2)))
    )


def table(rows: list[FrameRow], scene: Scene) -> Any:
    """The rows as an astropy table, one column per quantity."""
    from astropy.table import Table

    missing = (math.nan,) * 3
    columns: Record = {
        name: [getattr(row, name) for row in rows]
        for name in ("frame", "t_s", "rate_deg_s", "status")
    }
    for n, name in enumerate(angle_names(scene)):
        columns[f"true_{name.lower()}_deg"] = [row.truth_deg[n] for row in rows]
        columns[f"{name.lower()}_deg"] = [(row.estimate_deg or missing)[n] for row in rows]
    for name in (
        "cross_arcsec",
        "roll_arcsec",
        "cross_sigma_arcsec",
        "roll_sigma_arcsec",
        "log10_chance",
        "detected",
        "matched",
        "rms_px",
        "time_ms",
        "exposure_s",
        "rate_error_deg_s",
        "rate_sigma_deg_s",
        "wrong",
        "filter",
    ):
        columns[name] = [getattr(row, name) for row in rows]
    return Table(columns)


def annotated(frame: Frame, truth: Truth, report: Report | None) -> Picture:
    """The stretched frame with visible true sources and, if it was solved, detections and matches marked."""
    detected = report.centroids.xy_px if report else np.empty((0, 2))
    match = report.attitude.match if report else None
    matched = detected[match.observed] if match else np.empty((0, 2))
    return annotate(
        frame.image_dn,
        detected,
        matched,
        truth_px=truth.sources.xy_px[visible(truth.sources)],
    )


class Score:
    """A solved shot with the error of its solution.

    Attributes
    ----------
    row
        The shot as numbers: angles in degrees, errors and the tracker's standard deviations in
        arcseconds
    """

    def __init__(self, shot: Shot) -> None:
        self.shot = shot
        self.row = row(shot.camera, shot.frame, shot.truth, shot.solution, shot.update_status)

    @property
    def image(self) -> Array:
        """(H, W) digital numbers: uint16, or float64 for a noise-free detector."""
        return self.shot.frame.image_dn

    @property
    def truth(self) -> Truth:
        """Attitude, rates and sources at mid-exposure."""
        return self.shot.truth

    @property
    def attitude(self) -> Attitude:
        """The tracker's solution; if it has no attitude, its `status` gives the reason."""
        return self.shot.solution.attitude

    @property
    def error_arcsec(self) -> float:
        """Rotation angle between the solution and the truth, arcseconds; NaN without a solution."""
        return math.hypot(self.row.cross_arcsec, self.row.roll_arcsec)

    def annotated(self) -> Picture:
        """(H, W, 3) stretched frame in BGR: truth in blue, detections in red, identified sources in green."""
        return annotated(self.shot.frame, self.truth, self.shot.report)

    def __repr__(self) -> str:
        identified = f"{self.row.matched} of {self.row.detected} detections identified"
        return f"<frame {self.row.frame}: {self.row.status}, error {self.error_arcsec:.3g} arcsec, {identified}>"

    def _repr_html_(self) -> str:
        return f"{image_tag(self.annotated())}<p>{html.escape(repr(self)[1:-1])}</p>"


def image_tag(image: Picture) -> str:
    """An HTML <img> element of an image, reduced to at most 800 pixels in width."""
    data = cv2.imencode(".jpg", reduce_width(image, 800))[1].tobytes()
    return f'<img src="{embed(data, "jpeg")}">'
