"""Oscillators of LED controllers and timing of the camera: phases drift and differ between runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude
from estimator.filter.mekf import Update
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Sources
from skysim.scene import loader
from skysim.scene.sections.leds import ClockConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import build_lab, exposure_window, time_tag_error_s
from skysim.sources.dome.codes import Clocks, filtered_share
from skysim.sources.dome.led import lit_moments_s

AT_REST = {"motion.maneuver": "[{kind: hold, duration: 60 s}]", "exposure.time": "10.5 ms"}


def pulsed_sources(count: int) -> Sources:
    """LEDs of three controllers, lit for a fifth to four fifths of a millisecond."""
    rng = np.random.default_rng(1)
    zeros = np.zeros(count)
    return Sources(
        id=np.arange(count),
        place=np.zeros((count, 4)),
        normal=np.zeros((count, 3)),
        radius_m=zeros,
        strength=zeros + 1,
        period_s=zeros + 1e-3,
        start_s=rng.uniform(0, 1e-3, count),
        on_s=rng.uniform(2e-4, 8e-4, count),
        clock=np.arange(count) % 3,
        magnitude=zeros,
    )


def test_an_led_is_lit_by_its_controller_s_own_clock() -> None:
    """Against tau(t) = tau_0 + (1 + y) t + d t^2 / 2, in steps of a microsecond."""
    leds = pulsed_sources(12)
    clocks = Clocks(
        np.array([10.0, 20.003, 1234.5]),
        np.array([5e-3, -2e-3, 0.0]),
        np.array([1.3e-6, 0.0, -3.1e-6]),
    )
    # No whole number of periods, nor are the phases by the drift: 318.5 and -759.5.
    middle_s = 700.00037
    t_s = middle_s + np.arange(-5e-3, 5e-3, 1e-6)
    tau = (
        clocks.on_s
        + (1 + clocks.offset) * t_s[:, None]
        + clocks.drift_s * t_s[:, None] ** 2 / 2
    )
    lit = np.mod(tau[:, leds.clock] - leds.start_s, leds.period_s) < leds.on_s
    trains = clocks.pulses_at(leds, middle_s)
    for n in range(len(leds)):
        on_s = lit_moments_s(
            t_s[0], t_s[-1], trains.period_s[n], trains.start_s[n], trains.on_s[n]
        )[0]
        # Ten pulses, each counted to a microsecond or so.
        assert on_s == pytest.approx(lit[:, n].sum() * 1e-6, abs=1.5e-5)
        states = (
            np.array(
                [
                    lit_moments_s(
                        t,
                        t + 1e-9,
                        *(x[n] for x in (trains.period_s, trains.start_s, trains.on_s)),
                    )[0]
                    for t in t_s[::97]
                ]
            )
            > 5e-10
        )
        assert np.mean(states == lit[::97, n]) > 0.98  # the others lie at an edge


@pytest.mark.parametrize("filter_s", [2e-4, 1e-3, 5e-3])
def test_a_filtered_led_has_the_mean_of_its_filter_s_voltage(filter_s: float) -> None:
    """Against RC V' = u - V, each edge solved on its own, from a voltage of the mean on for forty time constants."""
    leds = pulsed_sources(6)
    exposures = [(0.5, 0.5031), (0.51, 0.5104), (0.52, 0.52001)]
    for n in range(len(leds)):
        on_s = leds.on_s[n]
        duty = leds.on_s[n] * 1e3
        edges_s = leds.start_s[n] + np.arange(0, 530)[:, None] * 1e-3 + np.array([0, on_s])
        t_s = np.unique(np.concatenate([edges_s.ravel(), *exposures]))
        lit = np.mod(t_s[:-1] + 1e-9 - leds.start_s[n], 1e-3) < on_s
        voltage = [duty]
        integral = [0.0]
        for step_s, u in zip(np.diff(t_s), lit, strict=True):
            voltage.append(u + (voltage[-1] - u) * np.exp(-step_s / filter_s))
            # The integral of u - (u - V0) exp(-t / RC)
            integral.append(
                integral[-1]
                + u * step_s
                - (u - voltage[-2]) * filter_s * -np.expm1(-step_s / filter_s)
            )
        for begin_s, end_s in exposures:
            expected = (
                np.interp(end_s, t_s, integral) - np.interp(begin_s, t_s, integral)
            ) / (end_s - begin_s)
            share = filtered_share(leds, np.full(6, filter_s), begin_s, end_s)[n]
            assert share == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_slow_filter_s_ripple_matches_the_data_books() -> None:
    """Peak to peak D (1 - D) T / RC, for RC >> T."""
    leds = pulsed_sources(20)
    filter_s = np.full(20, 0.05)
    voltage = np.array(
        [filtered_share(leds, filter_s, t, t + 1e-7) for t in 3 + np.arange(0, 1e-3, 2e-6)]
    )
    duty = leds.on_s * 1e3
    assert voltage.mean(axis=0) == pytest.approx(duty, rel=1e-4)
    assert np.ptp(voltage, axis=0) == pytest.approx(duty * (1 - duty) * 1e-3 / 0.05, rel=1e-2)


@pytest.mark.slow
def test_filtered_leds_do_not_flicker() -> None:
    """A tenth of full light, exposed for one and a half pulses: frames differ by a third, filtered by a hundredth."""
    scatter = []
    for low_pass in ("", ", filter: {time_constant: 20 ms, error: {tolerance: 0.1}}"):
        layout = "{kind: poisson_disk, spacing: 60 mm, cap_deg: 20, levels: [0.1], hardware_seed: 5}"
        drive = {
            "light.led.drive": f"{{kind: pwm{low_pass}}}",
            "light.layout": layout,
            "exposure.time": "1.5 ms",
        }
        lab = build_lab(
            loader.load(
                "afit_simsat_ideal", AT_REST | drive | {"camera.detector.noise": "false"}
            )
        )
        truths = [render_at_rest(lab.camera, Rotation.identity(), k)[1] for k in range(6)]
        electrons = np.array([truth.sources.electrons for truth in truths])
        scatter.append((electrons.std(axis=0) / electrons.mean(axis=0)).mean())
    assert 0.2 < scatter[0] < 0.5
    assert 0 < scatter[1] < 0.02


def test_clock_offsets_belong_to_the_hardware_and_phases_to_the_run() -> None:
    config = ClockConfig(offset_ppm=40, drift_ppm_h=2)
    first, again, other = (Clocks.draw(config, 5000, 7, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.on_s, again.on_s)
    np.testing.assert_array_equal(first.offset, other.offset)
    assert np.abs(first.on_s - other.on_s).min() > 1e-3
    # Standard deviations of 5000 draws are known to 1 %.
    assert first.offset.std() == pytest.approx(40e-6, rel=0.04)
    assert first.drift_s.std() == pytest.approx(2e-6 / 3600, rel=0.04)


def test_flicker_differs_from_frame_to_frame_and_from_run_to_run() -> None:
    """10.5 ms of pulses of 1 ms: light varies by up to half a pulse in ten, in every LED that is dimmed."""
    frames = []
    for seed in ("1", "2"):
        lab = build_lab(loader.load("afit_simsat", AT_REST | {"seed": seed}))
        for index in (0, 40, 80):
            sources = render_at_rest(lab.camera, lab.start, index)[1].sources
            frames.append(
                dict(zip(sources.id.tolist(), sources.electrons.tolist(), strict=True))
            )
    ids = sorted(set.intersection(*map(set, frames)))
    electrons = np.array([[frame[n] for n in ids] for frame in frames])
    dimmed = electrons.std(axis=0) > 1e-6 * electrons.mean(axis=0)
    assert dimmed.sum() >= 5
    for a in range(len(frames)):
        for b in range(a):
            assert np.abs(electrons[a, dimmed] / electrons[b, dimmed] - 1).max() > 1e-3


@pytest.mark.slow
def test_exposure_starts_and_time_tags_have_the_declared_errors() -> None:
    keys = {
        "trigger_jitter": "400 us",
        "time_tag_offset": "1 ms",
        "time_tag_jitter": "200 us",
    }
    scene = loader.load(
        "afit_simsat", {f"exposure.{key}": value for key, value in keys.items()}
    )
    indices = range(2000)
    late_s = np.array(
        [exposure_window(scene, k).open_s - scene.exposure.first_s - k / 2 for k in indices]
    )
    assert 0 <= late_s.min() < 1e-6
    assert 399e-6 < late_s.max() < 400e-6
    # Uniform: deviation 1 / sqrt 12.
    assert late_s.mean() == pytest.approx(200e-6, abs=4 * 115e-6 / np.sqrt(2000))
    error_s = np.array([time_tag_error_s(scene, k) for k in indices])
    assert error_s.mean() == pytest.approx(1e-3, abs=4 * 200e-6 / np.sqrt(2000))
    assert error_s.std() == pytest.approx(200e-6, rel=0.07)
    assert abs(np.corrcoef(late_s, error_s)[0, 1]) < 0.1
    lab = build_lab(scene)
    frame, truth = render_at_rest(lab.camera, lab.start)
    assert frame.t_mid_s - truth.t_s == pytest.approx(time_tag_error_s(scene, 0), abs=1e-12)
    assert truth.t_s == pytest.approx(exposure_window(scene, 0).middle_s, abs=1e-12)


def test_the_filter_allows_for_the_tag_s_error_along_the_motion() -> None:
    """sigma^2 w w^T: 1 ms at 5 deg/s is 18 arcseconds about the axis of rotation, and nothing about the others."""
    overrides = {"filter.time_tag_sigma": "1 ms"}
    covariance = []
    for changes in (overrides, {}):
        flight = open_flight(
            loader.load("simsat_bump", {"filter.time_tag_sigma": "0 s"} | changes)
        )
        navigation = flight.motion.navigation
        assert navigation is not None
        assert navigation.filter is not None
        given: list[np.ndarray] = []
        navigation.filter = Recorder(np.radians([0.0, 0.0, 5.0]), given)
        navigation.update_filter(0.0, solution(np.eye(3) * 1e-12))
        covariance.append(given[0])
    added = covariance[0] - covariance[1]
    np.testing.assert_allclose(
        added, np.diag([0, 0, (np.radians(5) * 1e-3) ** 2]), rtol=0, atol=1e-20
    )
    assert np.sqrt(added[2, 2]) / ARCSEC_RAD == pytest.approx(18, abs=0.01)


class Recorder:
    """A filter of a known rate that records the covariance it is given."""

    def __init__(self, rate_rad_s: np.ndarray, given: list[np.ndarray]) -> None:
        self.rate_rad_s = rate_rad_s
        self.given = given

    def update(
        self,
        _t_s: float,
        _measured: Rotation,
        covariance_rad2: np.ndarray,
        _systematic: None,
        _head: int,
    ) -> Update:
        self.given.append(covariance_rad2)
        return Update("used", np.zeros(3), 0.0)


def solution(covariance_rad2: np.ndarray) -> Attitude:
    """An attitude of that covariance in camera axes."""
    return Attitude("solved", Rotation.identity(), covariance_rad2)


def test_filtered_light_is_the_mean_over_an_exposure_about_its_middle() -> None:
    """Half of the exposure before and after it; without filters the pulses themselves."""
    leds = pulsed_sources(12)
    clocks = Clocks(np.array([10.0, 20.003, 1234.5]), np.zeros(3), np.zeros(3))
    filter_s = 2e-4
    middle_s = 3.00017
    pulses = clocks.pulses_at(leds, middle_s)
    for exposure_s in (3e-4, 2.3e-3):
        found = replace(clocks, filter_s=filter_s).lights_at(leds, middle_s, exposure_s)
        share = filtered_share(
            pulses, filter_s, middle_s - exposure_s / 2, middle_s + exposure_s / 2
        )
        np.testing.assert_allclose(found.strength, share * leds.strength)
        np.testing.assert_array_equal(found.on_s, found.period_s)
        np.testing.assert_array_equal(
            clocks.lights_at(leds, middle_s, exposure_s).on_s, pulses.on_s
        )
