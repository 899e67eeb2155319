"""Vibration against its analytic sum: rms, spectrum, rates, interpolation and active intervals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Trajectory, joined
from skysim.dynamics.jitter import (
    SPECTRA,
    Vibration,
    evaluate_sines,
    rotvec_body_rate,
)
from skysim.scene.sections.motion import JitterBandConfig, JitterLineConfig, MotionConfig

ARCSEC = np.radians(1 / 3600)
RMS = (5.0, 2.0, 0.5)


def line(
    frequency_hz: float = 40.0, rms: tuple[float, float, float] = RMS
) -> JitterLineConfig:
    return JitterLineConfig.model_validate(
        {"kind": "line", "frequency_hz": frequency_hz, "rms_arcsec": rms}
    )


def band(from_hz: float, to_hz: float, slope: float = 0.0) -> JitterBandConfig:
    return JitterBandConfig.model_validate(
        {
            "kind": "band",
            "from_hz": from_hz,
            "to_hz": to_hz,
            "rms_arcsec": RMS,
            "slope": slope,
        }
    )


def turning(
    end_s: float, rate: tuple[float, float, float] = (0.0, 0.0, 0.0), samples: int = 2
) -> Trajectory:
    """A body at a constant rate about one axis."""
    t = np.linspace(0, end_s, samples)
    rate_rad_s = np.array(rate)
    start = Rotation.from_rotvec([0.3, -1.0, 2.0])
    return Trajectory(
        t,
        start * Rotation.from_rotvec(t[:, None] * rate_rad_s),
        np.tile(rate_rad_s, (samples, 1)),
    )


def shake(calm: Trajectory, parts: tuple, rng: np.random.Generator) -> Trajectory:
    """The trajectory with a vibration that is always active."""
    return Vibration(MotionConfig(jitter=parts), rng).add_to(calm)


def shaken_by(calm: Trajectory, shaken: Trajectory, t_s: np.ndarray) -> np.ndarray:
    """(N, 3) rotation vectors from the body without to that with vibration, arcsec."""
    return (calm.attitude_at(t_s).inv() * shaken.attitude_at(t_s)).as_rotvec() / ARCSEC


def test_without_jitter_the_history_is_unchanged() -> None:
    calm = turning(1.0)
    rng = np.random.default_rng(1)
    assert shake(calm, (), rng) is calm
    assert shake(calm, (line(rms=(0.0, 0.0, 0.0)),), rng) is calm


def test_a_spectral_line_is_a_sine_of_its_rms_about_each_axis() -> None:
    calm = turning(1.0)
    t = np.arange(1000) / 1000  # forty whole periods
    phi = shaken_by(calm, shake(calm, (line(),), np.random.default_rng(2)), t)
    np.testing.assert_allclose(np.sqrt(np.mean(phi**2, axis=0)), RMS, rtol=1e-3)
    power = np.abs(np.fft.rfft(phi, axis=0)) ** 2
    np.testing.assert_allclose(power[40] / power.sum(axis=0), 1, rtol=1e-5)


def test_phases_are_random() -> None:
    """The mean of exp(i phase) over n draws is 0 within 1/sqrt(n)."""
    rng = np.random.default_rng(3)
    drawn = [SPECTRA["line"](line(), rng) for _ in range(400)]
    phasor = np.array([one.cosine_rad[0] * 1j + one.sine_rad[0] for one in drawn]) / (
        np.sqrt(2) * ARCSEC * np.array(RMS)
    )
    np.testing.assert_allclose(np.abs(phasor), 1, rtol=1e-12)
    assert np.abs(phasor.mean(axis=0)).max() < 4 / np.sqrt(400)


@pytest.mark.parametrize("slope", [-6.0, -2.0, -1.0, 0.0, 3.0])
def test_a_band_has_its_rms_and_keeps_within_its_edges(slope: float) -> None:
    sines = SPECTRA["band"](band(2.0, 49.0, slope), np.random.default_rng(4))
    rms = np.sqrt(np.sum(sines.sine_rad**2 + sines.cosine_rad**2, axis=0) / 2)
    np.testing.assert_allclose(rms, np.array(RMS) * ARCSEC, rtol=1e-12)
    frequency_hz = sines.omega_rad_s / (2 * np.pi)
    piece = 24.5 ** (1 / len(sines.omega_rad_s))
    assert 2.0 <= frequency_hz.min() <= 2.0 * piece
    assert 49.0 / piece <= frequency_hz.max() <= 49.0


@pytest.mark.long
@pytest.mark.parametrize("slope", [-2.0, -1.0, 0.0, 2.0])
def test_periodogram_of_a_band_rises_with_its_slope(slope: float) -> None:
    """Power by octave of many draws: its integral over f^slope, to 4 sigma of the draws' own scatter."""
    rng = np.random.default_rng(5)
    rate_hz = 256.0
    seconds = 8.0
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    window = np.hanning(len(t))[:, None]
    edges = np.array([4.0, 8.0, 16.0, 32.0, 64.0])
    shares = []
    for _ in range(40):
        sines = SPECTRA["band"](band(4.0, 64.0, slope), rng)
        phi = (
            evaluate_sines(t, sines.omega_rad_s, sines.sine_rad, sines.cosine_rad)[0]
            / ARCSEC
            / np.array(RMS)
        )
        power = (np.abs(np.fft.rfft(phi * window, axis=0)) ** 2).sum(axis=1)
        frequency = np.fft.rfftfreq(len(t), 1 / rate_hz)
        # Four bins: Hann leaks 1e-3 beyond.
        outside = (frequency < 4.0 - 0.5) | (frequency > 64.0 + 0.5)
        assert power[outside].sum() < 2e-3 * power.sum()
        shares.append(np.histogram(frequency, edges, weights=power)[0] / power.sum())
    # Power of an octave over that of the one below is 2^(slope + 1).
    octave = np.exp2((slope + 1) * np.arange(4))
    scatter = np.std(shares, axis=0) / np.sqrt(len(shares))
    # Within 4 sigma, and 1 % that the window carries over an octave's edge.
    assert np.all(
        np.abs(np.mean(shares, axis=0) - octave / octave.sum()) < 4 * scatter + 0.01
    )


def test_many_sines_are_normally_distributed() -> None:
    """The sum of so many sines is nearly normal: kurtosis 3 less 1.5 over the number of equal sines."""
    sines = SPECTRA["band"](band(1.0, 100.0), np.random.default_rng(6))
    t = np.sort(np.random.default_rng(7).uniform(0, 5000, 40_000))
    phi = evaluate_sines(t, sines.omega_rad_s, sines.sine_rad, sines.cosine_rad)[0]
    kurtosis = np.mean(phi**4, axis=0) / np.mean(phi**2, axis=0) ** 2
    np.testing.assert_allclose(kurtosis, 3, rtol=0, atol=0.2)


def test_between_the_samples_the_history_follows_the_sum() -> None:
    parts = (line(37.0), band(1.0, 60.0, -1.0))
    calm = turning(2.0, rate=(0.02, -0.01, 0.03))
    shaken = shake(calm, parts, np.random.default_rng(8))
    rng = np.random.default_rng(8)
    sines = joined([SPECTRA[part.kind](part, rng) for part in parts])
    t = np.random.default_rng(9).uniform(0, 2, 5000)
    wanted = (
        evaluate_sines(t, sines.omega_rad_s, sines.sine_rad, sines.cosine_rad)[0] / ARCSEC
    )
    error = np.abs(shaken_by(calm, shaken, t) - wanted)
    assert (error.max(axis=0) < 1e-3 * np.abs(wanted).max(axis=0)).all()
    highest_hz = sines.omega_rad_s.max() / (2 * np.pi)
    assert np.diff(shaken.t_s).max() <= 1 / (16 * highest_hz) * (1 + 1e-9)


def test_the_samples_of_the_history_without_jitter_are_kept() -> None:
    calm = turning(1.0, rate=(0.1, 0.2, 0.3), samples=7)
    shaken = shake(calm, (line(11.0),), np.random.default_rng(10))
    assert np.isin(calm.t_s, shaken.t_s).all()
    assert (np.diff(shaken.t_s) > 0).all()
    slow = shake(calm, (line(0.01),), np.random.default_rng(10))
    np.testing.assert_array_equal(slow.t_s, calm.t_s)  # fine enough as it is


def test_rates_are_the_derivative_of_the_attitude() -> None:
    """A strong vibration (1 degree) on a body that turns at 20 deg/s: central differences, error h^2 w^3 phi / 6."""
    calm = turning(0.5, rate=(0.2, -0.1, 0.25))
    shaken = shake(
        calm, (line(10.0, rms=(3600.0, 2000.0, 1000.0)),), np.random.default_rng(11)
    )
    at = shaken.t_s[1:-1]
    sines = SPECTRA["line"](
        line(10.0, rms=(3600.0, 2000.0, 1000.0)), np.random.default_rng(11)
    )

    def attitude(t_s: np.ndarray) -> Rotation:
        phi = evaluate_sines(t_s, sines.omega_rad_s, sines.sine_rad, sines.cosine_rad)[0]
        return calm.attitude_at(t_s) * Rotation.from_rotvec(phi)

    h = 1e-6
    turn = (attitude(at - h).inv() * attitude(at + h)).as_rotvec() / (2 * h)
    # Rounding: 2e-16 / h = 2e-10 a rotation, some of them; the differences: 1e-12 * 63^3 * 0.025 / 6 = 1e-9.
    np.testing.assert_allclose(shaken.rate_body_rad_s[1:-1], turn, rtol=0, atol=4e-9)
    size = np.abs(shaken.rate_body_rad_s - np.array([0.2, -0.1, 0.25])).max()
    assert size > 1.0  # the vibration's own rate is not small beside this tolerance


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.9e-4, 1.1e-4, 1e-2, 1.0, 3.0])
def test_the_jitter_s_rate_is_the_derivative_of_its_rotation_at_any_angle(
    angle_rad: float,
) -> None:
    """Rotations by complex numbers about one axis cannot see the cross terms: central differences of scipy's can."""
    phi = angle_rad * np.array([[0.6, 0.0, 0.8]])
    phi_rate = np.array([[0.3, -1.0, 0.2]])
    h = 1e-5
    before, after = (Rotation.from_rotvec(phi + side * h * phi_rate) for side in (-1, 1))
    turned = (before.inv() * after).as_rotvec() / (2 * h)
    np.testing.assert_allclose(rotvec_body_rate(phi, phi_rate), turned, rtol=0, atol=1e-9)


def test_without_its_cross_term_the_rate_is_wrong() -> None:
    """Coning: two axes a quarter period apart turn the body steadily at (1 - cos a) dphi/dt / a about the third."""
    phi = np.array([[0.01, 0.0, 0.0]])
    phi_rate = np.array([[0.0, 0.01, 0.0]])
    np.testing.assert_allclose(
        rotvec_body_rate(phi, phi_rate)[0, 2], -(1 - np.cos(0.01)), rtol=1e-11
    )


@pytest.mark.parametrize("angle", [1e-6, 3e-5, 0.99e-4, 1.01e-4, 1e-3])
def test_the_rate_across_a_small_rotation_has_the_sine_term(angle: float) -> None:
    """Across phi the rate's own part is sin a / a of it; the terms add up to it within rounding, below 1e-4 rad too."""
    across = rotvec_body_rate(np.array([[angle, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]))[
        0, 1
    ]
    assert 1 - across == pytest.approx(angle**2 / 6 - angle**4 / 120, rel=0, abs=3e-16)


def test_jitter_does_not_change_the_mean_attitude() -> None:
    calm = turning(10.0, rate=(0.0, 0.05, 0.0))
    shaken = shake(calm, (line(20.0), band(5.0, 50.0)), np.random.default_rng(12))
    mean = shaken_by(calm, shaken, np.arange(10_000) / 1000).mean(axis=0)
    # A sine's mean over T is below a / (pi f T); 128 of them in quadrature, and the line has whole periods.
    assert (np.abs(mean) < 4 * np.array(RMS) / (np.pi * 5.0 * 10.0)).all()


def test_the_same_random_stream_gives_the_same_jitter() -> None:
    calm = turning(0.2)
    first, again, other = (
        shake(calm, (band(1.0, 30.0),), np.random.default_rng(s)) for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.rate_body_rad_s, again.rate_body_rad_s)
    assert not np.array_equal(first.rate_body_rad_s, other.rate_body_rad_s)


def test_too_many_samples_are_refused_in_one_line() -> None:
    with pytest.raises(
        InputError, match=r"^motion\.jitter: 1e\+06 Hz over 60 s needs 960,000,001 .*$"
    ):
        shake(turning(60.0), (line(1e6),), np.random.default_rng(1))


# For a while only


def shaking(*while_s: float, parts: object = None, always: object = ()) -> MotionConfig:
    """Holds of a second, and between them the vibration for each of the given durations."""
    hold = {"kind": "hold", "duration": "1 s"}
    parts = parts or [{"kind": "line", "frequency_hz": 40, "rms_arcsec": RMS}]
    maneuver: list[object] = [hold]
    for one_s in while_s:
        maneuver += [{"kind": "jitter", "duration": f"{one_s} s", "components": parts}, hold]
    return MotionConfig.model_validate({"maneuver": maneuver, "jitter": always})


LOUD = [{"kind": "line", "frequency_hz": 7, "rms_arcsec": [3600, 1800, 900]}]
NOISE = [{"kind": "band", "from_hz": 5, "to_hz": 60, "rms_arcsec": RMS}]


def test_a_vibration_interval_has_its_rms_between_rise_and_fall() -> None:
    """Four seconds from 1 s: a rise of 0.4 s, then 128 whole periods of 40 Hz."""
    calm = turning(6.0, samples=601)
    shaken = Vibration(shaking(4.0), np.random.default_rng(13)).add_to(calm)
    phi = shaken_by(calm, shaken, 1.4 + np.arange(6400) / 2000)
    np.testing.assert_allclose(np.sqrt(np.mean(phi**2, axis=0)), RMS, rtol=1e-3)
    for begin, end in ((1.0, 1.4), (4.6, 5.0)):
        # The mean square of 10x^3 - 15x^4 + 6x^5 is 181/462, and what the sine's square leaves of its own swing over
        # a rise of T is at most 1 / (2 omega T), 0.005.
        edge = shaken_by(calm, shaken, np.linspace(begin, end, 2000, endpoint=False))
        np.testing.assert_allclose(
            np.mean(edge**2, axis=0), np.square(RMS) * 181 / 462, rtol=1.3e-2
        )


def test_a_long_vibration_interval_rises_within_a_second() -> None:
    calm = turning(32.0, samples=3201)
    shaken = Vibration(shaking(30.0), np.random.default_rng(14)).add_to(calm)
    for begin in (2.0, 29.0):
        phi = shaken_by(calm, shaken, begin + np.arange(2000) / 2000)
        np.testing.assert_allclose(np.sqrt(np.mean(phi**2, axis=0)), RMS, rtol=1e-3)


def test_there_is_no_vibration_outside_its_interval() -> None:
    calm = turning(8.0, rate=(0.1, 0.2, -0.1), samples=801)
    rng = np.random.default_rng(15)
    vibration = Vibration(shaking(2.0, 3.0), rng)
    shaken = vibration.add_to(calm)
    t = np.random.default_rng(16).uniform(0, 8, 4000)
    outside = (t < 1) | ((t > 3) & (t < 4)) | (t > 7)
    phi, rate = vibration.evaluate(np.sort(t[outside]))
    np.testing.assert_array_equal([phi, rate], np.zeros((2, outside.sum(), 3)))
    # Rounding: 1e-15 rad is 2e-10 arcsec.
    assert np.abs(shaken_by(calm, shaken, t[outside])).max() < 1e-9
    assert (np.abs(shaken_by(calm, shaken, t[~outside])).max(axis=0) > RMS).all()
    silent = (shaken.t_s <= 1) | ((shaken.t_s >= 3) & (shaken.t_s <= 4)) | (shaken.t_s >= 7)
    np.testing.assert_allclose(
        shaken.rate_body_rad_s[silent], [[0.1, 0.2, -0.1]] * silent.sum(), rtol=1e-14
    )
    # No finer where it is calm.
    np.testing.assert_allclose(np.diff(shaken.t_s[shaken.t_s <= 1]), 0.01, rtol=1e-9)


def test_two_intervals_of_the_same_vibration_have_independent_phases() -> None:
    vibration = Vibration(shaking(2.0, 2.0), np.random.default_rng(17))
    t = np.linspace(1.5, 2.5, 1000, endpoint=False)
    # 120 periods later
    first = vibration.evaluate(t)[0]
    second = vibration.evaluate(t + 3.0)[0]
    assert (
        np.sqrt(np.mean((first - second) ** 2, axis=0)) > 0.05 * ARCSEC * np.array(RMS)
    ).any()


@pytest.mark.parametrize("always", [(), LOUD])
def test_the_vibration_within_its_interval_has_its_stated_derivative(
    always: list[object],
) -> None:
    """The envelope's own slope included: central differences of phi over the rise, the middle and the fall."""
    vibration = Vibration(shaking(2.0, parts=LOUD, always=always), np.random.default_rng(18))
    h = 1e-6
    t = np.sort(np.random.default_rng(19).uniform(0.9, 3.1, 3000))
    before = vibration.evaluate(t - h)[0]
    after = vibration.evaluate(t + h)[0]
    rate = vibration.evaluate(t)[1]
    # h^2 / 6 times a third derivative of some (2 pi 7 + 4 / 0.2)^3 * 0.05 rad = 1e4 rad/s3 at the most
    np.testing.assert_allclose((after - before) / (2 * h), rate, rtol=0, atol=4e-9)
    assert np.abs(rate).max() > 0.5


def test_the_rate_with_vibration_is_the_derivative_of_the_attitude() -> None:
    """At its samples by central differences of lab_from_body exp(phi); between them it follows that too."""
    calm = turning(4.0, rate=(0.2, -0.1, 0.25), samples=4001)
    vibration = Vibration(shaking(2.0, parts=LOUD), np.random.default_rng(20))
    shaken = vibration.add_to(calm)
    h = 1e-6
    at = shaken.t_s[(shaken.t_s > 0.9) & (shaken.t_s < 3.1)][::7]

    def body(t_s: np.ndarray) -> Rotation:
        return calm.attitude_at(t_s) * Rotation.from_rotvec(vibration.evaluate(t_s)[0])

    turned = (body(at - h).inv() * body(at + h)).as_rotvec() / (2 * h)
    rate = np.array([shaken.rate_at(t) for t in at])
    np.testing.assert_allclose(rate, turned, rtol=0, atol=4e-9)
    between = np.sort(np.random.default_rng(21).uniform(0.9, 3.1, 3000))
    error = np.linalg.norm(
        (shaken.attitude_at(between).inv() * body(between)).as_rotvec(), axis=1
    )
    assert error.max() < 1e-4 * np.radians(1.0) * np.sqrt(2)


def test_a_short_vibration_interval_is_sampled_for_its_envelope() -> None:
    """A tenth of a period of 0.5 Hz: only the rise and fall, 10 ms each, set the samples."""
    calm = turning(2.2, samples=3)
    slow = [{"kind": "line", "frequency_hz": 0.5, "rms_arcsec": RMS}]
    vibration = Vibration(shaking(0.1, parts=slow), np.random.default_rng(22))
    shaken = vibration.add_to(calm)
    t = np.linspace(0.95, 1.15, 4000)
    wanted = vibration.evaluate(t)[0] / ARCSEC
    assert (
        np.abs(shaken_by(calm, shaken, t) - wanted) < 1e-4 * np.sqrt(2) * np.array(RMS)
    ).all()
    assert (np.abs(wanted).max(axis=0) > 0).all()


def test_a_flight_in_pieces_has_the_jitter_of_the_whole() -> None:
    """A history that turns and speeds up, cut at samples into uneven pieces, inside and outside of the while."""
    t = np.arange(0, 3.0 + 5e-4, 1e-3)
    rate = np.outer(1 + t, [0.1, 0.0, 0.2])
    angle = np.outer(t + t**2 / 2, [0.1, 0.0, 0.2])
    vibration = Vibration(
        shaking(1.0, parts=NOISE + LOUD, always=NOISE), np.random.default_rng(23)
    )
    whole = vibration.add_to(Trajectory(t, Rotation.from_rotvec(angle), rate))
    cuts = [0, 10, 700, 1003, 1995, len(t) - 1]
    for first, last in itertools.pairwise(cuts):
        now = slice(first, last + 1)
        piece = vibration.add_to(
            Trajectory(t[now], Rotation.from_rotvec(angle[now]), rate[now])
        )
        same = (whole.t_s >= t[first]) & (whole.t_s <= t[last])
        np.testing.assert_array_equal(piece.t_s, whole.t_s[same])
        np.testing.assert_allclose(
            piece.rate_body_rad_s, whole.rate_body_rad_s[same], rtol=0, atol=1e-12
        )
        at = np.random.default_rng(24).uniform(t[first], t[last], 300)
        assert (
            np.abs((whole.attitude_at(at).inv() * piece.attitude_at(at)).as_rotvec()).max()
            < 1e-12
        )


def test_a_piece_without_vibration_is_unchanged() -> None:
    vibration = Vibration(shaking(1.0), np.random.default_rng(25))
    piece = turning(0.9)
    assert vibration.add_to(piece) is piece
    assert Vibration(MotionConfig(), np.random.default_rng(25)).components == ()


def test_too_many_samples_of_a_vibration_are_refused_with_its_time() -> None:
    fast = [{"kind": "line", "frequency_hz": 1e6, "rms_arcsec": RMS}]
    vibration = Vibration(shaking(1.0, parts=fast, always=NOISE), np.random.default_rng(26))
    flight = turning(3.0, samples=3001)
    with pytest.raises(
        InputError,
        match=r"^motion\.maneuver jitter at 1 s: 1.*e\+06 Hz over 1 s needs 16,0.*$",
    ):
        vibration.add_to(flight)
    with pytest.raises(InputError, match=r"; allowed: 5,000,000, 16 a period$"):
        vibration.subdivisions(flight.t_s)
    vibration.add_to(turning(0.5))  # before its time
