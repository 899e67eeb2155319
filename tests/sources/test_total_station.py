"""A total station's errors: their covariance against Monte Carlo and geometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter
from scipy.stats import chi2

from estimator.identification.chance import GATE_SIGMA
from estimator.identification.led_index import build_dome_index
from estimator.trackers.dome_tracker import DomeTracker
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.scene.sections.tracker import SurveyErrorsConfig, TotalStationConfig
from skysim.simulation.lab import build_lab, build_tracker
from skysim.sources.dome import surface, survey_errors

ARCSEC = np.pi / 180 / 3600
STATION = {
    "kind": "total_station",
    "position": ["0.8 m", "-0.3 m", "-0.2 m"],
    "angle_sigma_arcsec": 60,  # far more than any, so that all parts matter
    "distance_sigma": "0.4 mm",
    "distance_ppm": 200,
    "zero_sigma": "0.3 mm",
    "centering": "0.5 mm",
    "orientation_sigma_arcsec": 90,
    "leveling_sigma_arcsec": 50,
}
PLACES_M = np.array(
    [[0.0, 0.0, 1.2], [0.3, 0.5, 1.0], [-0.9, 0.1, 0.6], [0.9, -0.3, 1.1], [0.8, 0.9, -0.2]]
)
DRAWS = 6_000


def station(**more: Any) -> TotalStationConfig:
    return TotalStationConfig.model_validate(STATION | more)


def draws(config: TotalStationConfig, own: bool, setup: bool) -> np.ndarray:
    """(D, N, 3) errors of surveyed places over many surveys."""
    rng = np.random.default_rng(1)
    shape = (len(PLACES_M), 3)
    return np.array(
        [
            survey_errors.surveyed_m(
                config,
                PLACES_M,
                own * rng.standard_normal(shape),
                survey_errors.draw_setup(
                    config, setup * rng.standard_normal(survey_errors.SETUP_ERRORS)
                ),
            )
            - PLACES_M
            for _ in range(DRAWS)
        ]
    )


# --- the laws


def test_a_total_station_without_errors_gives_the_truth() -> None:
    """Polar coordinates and back, to the rounding of a meter."""
    found = survey_errors.surveyed_m(
        station(), PLACES_M, np.zeros(PLACES_M.shape), np.zeros(8)
    )
    np.testing.assert_allclose(found, PLACES_M, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_independent_errors_have_the_claimed_covariance() -> None:
    """Monte Carlo of angles and distances through the polar coordinates, each LED, each element."""
    config = station()
    error_m = draws(config, own=True, setup=False)
    claimed = survey_errors.station_covariance_m2(config, PLACES_M)
    found = np.einsum("dni,dnj->nij", error_m, error_m) / DRAWS
    # A sample covariance errs by sqrt((C_ii C_jj + C_ij^2) / D).
    variance = np.einsum("nii->ni", claimed)
    spread = np.sqrt((variance[:, :, None] * variance[:, None] + claimed**2) / DRAWS)
    assert (np.abs(found - claimed) / spread).max() < 5
    # LEDs err independently of each other.
    across = np.einsum("di,dj->ij", error_m[:, 0], error_m[:, 1]) / DRAWS
    assert np.abs(across).max() < 5 * variance.max() / np.sqrt(DRAWS)


@pytest.mark.slow
def test_common_errors_of_a_survey_have_the_claimed_covariance() -> None:
    """Between any two LEDs too: sum over the errors of the outer products of their displacements."""
    config = station()
    error_m = draws(config, own=False, setup=True).reshape(DRAWS, -1)
    fields = survey_errors.station_displacements_m(config, PLACES_M)
    assert len(fields) == survey_errors.SETUP_ERRORS
    flat = fields.reshape(len(fields), -1)
    claimed = flat.T @ flat
    variance = np.diag(claimed)
    spread = np.sqrt((np.outer(variance, variance) + claimed**2) / DRAWS)
    assert (np.abs(error_m.T @ error_m / DRAWS - claimed) / spread).max() < 5


def test_no_leds_and_no_errors_of_the_set_up_are_empty() -> None:
    """A camera that looks beside the dome sees none: (errors, LEDs, 3)."""
    perfect = {
        "kind": "total_station",
        "position": STATION["position"],
        "angle_sigma_arcsec": 1,
        "distance_sigma": "1 mm",
    }
    for config, errors in ((TotalStationConfig.model_validate(perfect), 0), (station(), 8)):
        assert survey_errors.station_displacements_m(config, np.zeros((0, 3))).shape == (
            errors,
            0,
            3,
        )


def test_range_and_angle_errors_are_along_and_across_the_sight() -> None:
    """A data sheet's 1 mm along the sight; 1" at 100 m is half a millimeter across (Leica MS60 manual)."""
    place_m = np.array([[100.0, 0.0, 0.0]])
    config = station(
        position=["0 m", "0 m", "0 m"], angle_sigma_arcsec=1, distance_sigma="1 mm"
    )
    covariance = survey_errors.station_covariance_m2(config, place_m)[0]
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariance)), [1e-3, 100 * ARCSEC, 100 * ARCSEC], rtol=1e-12
    )
    assert 100 * ARCSEC == pytest.approx(0.5e-3, rel=0.05)  # noqa: SIM300
    # Toward the zenith the horizontal direction matters less, by the sine of the zenith angle.
    steep = survey_errors.station_covariance_m2(
        config, np.array([[10.0, 0.0, 10 * np.sqrt(3)]])
    )[0]
    assert np.sqrt(steep[1, 1]) == pytest.approx(20 * ARCSEC * 0.5, rel=1e-12)


def test_distance_errors_are_a_plus_b_ppm() -> None:
    """sigma^2 = a^2 + (b D)^2 over surveys: a in each distance, b in the scale of a survey."""
    config = station(
        **{
            "position": ["0 m", "0 m", "0 m"],
            "distance_sigma": "1 mm",
            "distance_ppm": 1.5,
            "zero_sigma": "0 m",
        },
        **{
            "centering": "0 m",
            "orientation_sigma_arcsec": 0,
            "leveling_sigma_arcsec": 0,
            "angle_sigma_arcsec": 0,
        },
    )
    places = np.array([[1000.0, 0, 0], [0, 10.0, 0]])
    own = survey_errors.station_covariance_m2(config, places)
    (scale,) = survey_errors.station_displacements_m(config, places)
    variance = np.array([own[0, 0, 0], own[1, 1, 1]]) + np.sum(scale**2, axis=1)
    np.testing.assert_allclose(variance, [1e-6 + 1.5e-3**2, 1e-6 + 1.5e-5**2], rtol=1e-12)


def test_tolerances_bound_every_part() -> None:
    config = station(angle_sigma_arcsec={"tolerance": 60}, centering={"tolerance": "0.5 mm"})
    rng = np.random.default_rng(2)
    setup = np.array(
        [survey_errors.draw_setup(config, rng.standard_normal(8)) for _ in range(2000)]
    )
    assert np.abs(setup[:, :3]).max() <= 5e-4
    assert setup[:, :3].std() == pytest.approx(5e-4 / np.sqrt(3), rel=0.03)
    claimed = survey_errors.station_covariance_m2(config, np.array([[0.8, 9.7, -0.2]]))[0]
    assert claimed[0, 0] == pytest.approx((10 * 60 * ARCSEC) ** 2 / 3, rel=1e-12)


# --- in a scene


def survey_of(**more: Any) -> SurveyErrorsConfig:
    return SurveyErrorsConfig.model_validate({"instrument": STATION, "seed": 5} | more)


def test_the_tracker_uses_the_station_s_measurements() -> None:
    """Places, covariance and common errors, over surveys: all errors together are chi-square as claimed."""
    inside = surface.build_surface(
        TypeAdapter(light.AnySurface).validate_python(
            {"kind": "sphere", "apex": "1.3 m", "radius": "1.3 m", "error": "0.4 mm"}
        )
    )
    place_m = inside.meet(
        np.zeros(3), np.random.default_rng(3).normal(size=(6, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    )
    config = survey_of(led_sigma="0.2 mm")
    own = survey_errors.led_covariance_m2(place_m, config)
    common = survey_errors.common_displacements_m(inside, place_m, config)
    assert own is not None
    assert common is not None
    claimed = np.zeros((18, 18))
    for n in range(6):
        claimed[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = own[n]
    flat = common.reshape(len(common), -1)
    claimed += flat.T @ flat
    surveys = 400
    error = [
        (
            survey_errors.assumed_leds_m(
                inside, place_m, survey_of(led_sigma="0.2 mm", seed=seed)
            )
            - place_m
        ).ravel()
        for seed in range(surveys)
    ]
    squares = np.einsum("di,ij,dj->d", error, np.linalg.inv(claimed), error)
    low, high = chi2.ppf([1e-6, 1 - 1e-6], 18 * surveys)
    assert low < squares.sum() < high


def test_the_error_across_the_line_of_sight_matches_simulated_errors() -> None:
    own_m2 = survey_errors.station_covariance_m2(station(), PLACES_M)
    normal = np.random.default_rng(2).standard_normal((DRAWS, len(PLACES_M), 3))
    error_m = np.einsum("nij,dnj->dni", np.linalg.cholesky(own_m2), normal)
    along = PLACES_M / np.linalg.norm(PLACES_M, axis=1, keepdims=True)
    across_m = error_m - np.sum(error_m * along, axis=2, keepdims=True) * along
    measured_m = np.sqrt(np.mean(np.sum(across_m**2, axis=2), axis=0) / 2)
    assert survey_errors.across_sigma_m(PLACES_M, own_m2) == pytest.approx(
        measured_m, rel=6 / np.sqrt(2 * DRAWS)
    )


def test_the_final_match_and_identification_use_the_same_gates() -> None:
    """Distances err by 1 mm along sights from beside the bearing, mostly along the line from it.

    An LED that the identification matches and the final match does not makes the tracker refuse the frame: 2 % of the
    attitudes of such a dome, when the sigma was the rms of all three axes. The final match has a radius of 4 sigma.
    """
    beside = {
        "kind": "total_station",
        "position": ["1 m", "0 m", "-0.5 m"],
        "angle_sigma_arcsec": 2,
    }
    survey = {"instrument": beside | {"distance_sigma": "1 mm"}, "seed": 1}
    scene = loader.load(
        "afit_simsat",
        {"tracker.survey": yaml.safe_dump(survey, default_flow_style=True, width=999)},
    )
    tracker = build_tracker(build_lab(scene).camera)
    assert isinstance(tracker, DomeTracker)
    index = build_dome_index(tracker.leds, tracker.lever, tracker.camera)
    assert 0.1e-3 < tracker.leds.sigma_m < 0.6e-3
    assert GATE_SIGMA * index.led_sigma < 4 * tracker.led_sigma_rad.max()


def test_without_an_instrument_the_map_claims_one_sigma_for_all() -> None:
    plain = SurveyErrorsConfig.model_validate({"led_sigma": "0.2 mm"})
    inside = surface.build_surface(
        TypeAdapter(light.AnySurface).validate_python(
            {"kind": "sphere", "apex": "1.3 m", "radius": "1.3 m"}
        )
    )
    assert survey_errors.led_covariance_m2(PLACES_M, plain) is None
    assert survey_errors.common_displacements_m(inside, PLACES_M, plain) is None


def test_the_survey_s_ellipsoid_moves_with_its_leds() -> None:
    """The setup's rigid motion, and not the sights' errors: LEDs stay on the believed sphere to the scale's error."""
    inside = surface.build_surface(
        TypeAdapter(light.AnySurface).validate_python(
            {"kind": "sphere", "apex": "1.3 m", "radius": "1.3 m"}
        )
    )
    exact = {
        "angle_sigma_arcsec": 0,
        "distance_sigma": "0 m",
        "zero_sigma": "0 m",
        "distance_ppm": 0,
    }
    config = survey_of(instrument=STATION | exact)
    place_m = inside.meet(
        np.zeros(3), np.random.default_rng(3).normal(size=(50, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    )
    center_m, axes_m = survey_errors.assumed_ellipsoid(inside, config)
    found_m = survey_errors.assumed_leds_m(inside, place_m, config)
    assert np.linalg.norm(center_m) > 1e-4
    np.testing.assert_allclose(
        np.linalg.norm(found_m - center_m, axis=1), axes_m[0], rtol=0, atol=1e-13
    )


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"tracker.survey.instrument": "{kind: laser_tracker}"}, "tracker.survey.instrument"),
        (
            {"tracker.survey.instrument": "{kind: total_station, position: [1 m, 0 m, 0 m]}"},
            "tracker.survey.instrument.angle_sigma_arcsec: missing",
        ),
        (
            {
                "tracker.survey": "{focal_length_sigma: 10 um}",
                "tracker.assumed_focal_length": "35 mm",
            },
            "survey.focal_length_sigma: conflicts with assumed_focal_length",
        ),
    ],
)
def test_an_invalid_survey_is_refused_in_one_line(
    changes: dict[str, str], complaint: str
) -> None:
    with pytest.raises(InputError) as caught:
        loader.load("afit_simsat", changes)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sky_has_a_focal_length_to_survey_and_no_leds() -> None:
    loader.load("shefex2", {"tracker.survey": "{focal_length_sigma: 10 um, seed: 4}"})
    for survey in ("{seed: 4}", "{focal_length_sigma: 10 um, led_sigma: 1 mm}"):
        with pytest.raises(InputError, match="light of kind stars has no LEDs to survey"):
            loader.load("shefex2", {"tracker.survey": survey})


def test_a_station_at_an_led_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"^tracker.survey.instrument.position: an LED is there"
    ):
        survey_errors.station_covariance_m2(
            station(position=["0 m", "0 m", "1.2 m"]), PLACES_M
        )


def test_the_focal_length_error_over_seeds_matches_its_survey_sigma() -> None:
    config = SurveyErrorsConfig.model_validate({"focal_length_sigma": {"tolerance": "20 um"}})
    error = [
        survey_errors.assumed_focal_length_m(0.035, config.model_copy(update={"seed": seed}))
        - 0.035
        for seed in range(500)
    ]
    assert np.abs(error).max() <= 20e-6
    assert np.std(error) == pytest.approx(20e-6 / np.sqrt(3), rel=0.1)
    lab = build_lab(
        loader.load("shefex2", {"tracker.survey": "{focal_length_sigma: 10 um, seed: 4}"})
    )
    camera = build_tracker(lab.camera).camera
    assert camera.focal_sigma == pytest.approx(10e-6 / 0.025, rel=1e-12)
    assert camera.focal_px != pytest.approx(lab.scene.camera.focal_px, rel=1e-6)
