from __future__ import annotations

import allantools
import numpy as np
import pytest
from imu_data import NOISE, START_NS, rest

from vli_calibration.allan import allan_deviation, measure_imu_noise
from vli_calibration.imu_recording import make_recording
from vli_calibration.noise_model import allan_terms, fit_noise, spectral_terms
from vli_common.errors import InputError


def test_densities_and_walks_of_half_an_hour_are_found_and_lie_in_their_intervals() -> None:
    noise = measure_imu_noise(make_recording(*rest(1800.0, 3)))
    for sensor, white, walk in (
        (noise.gyro, NOISE.gyroscope_noise_density, NOISE.gyroscope_random_walk),
        (noise.accel, NOISE.accelerometer_noise_density, NOISE.accelerometer_random_walk),
    ):
        assert sensor.fit.white == pytest.approx(white, rel=0.03)
        assert sensor.walk == pytest.approx(walk, rel=0.25)
        assert sensor.fit.white_interval[0] < white < sensor.fit.white_interval[1]
        assert sensor.fit.walk_interval[0] < walk < sensor.fit.walk_interval[1]
        assert not sensor.walk_is_bound
        assert sensor.fit.flicker == 0.0
    assert noise.section()["update_rate"] == 200.0


def test_walk_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        means = np.cumsum(rng.normal(0, 0.1, (600, 3)), axis=0) + rng.normal(0, 0.5, (600, 3))
        low, high = fit_noise(means, 1.0).walk_interval
        inside.append(low < 0.1 < high)
    assert 25 <= sum(inside) <= 30


def test_the_spectrum_of_each_noise_has_the_allan_variance_of_the_standard() -> None:
    # The Allan variance at τ = T is half the mean square of the differences: half the mean of their spectrum.
    for block_s in (0.5, 2.0):
        half_mean = 0.5 * spectral_terms(20_000, block_s).mean(axis=0)
        assert half_mean == pytest.approx(allan_terms(np.array([block_s]))[0], rel=2e-3)


def test_flicker_noise_is_noticed_and_measured() -> None:
    samples = np.stack([allantools.noise.pink(2**13) for _ in range(3)], axis=1)
    reference = allantools.oadev(samples[:, 0], rate=1.0, data_type="freq", taus=[32.0])[1][0]
    instability = reference / np.sqrt(2 * np.log(2) / np.pi)
    fit = fit_noise(samples + 0.5 * np.random.default_rng(1).standard_normal(samples.shape), 1.0)
    assert fit.flicker == pytest.approx(instability, rel=0.25)


def test_the_models_curve_runs_through_the_points_of_allantools() -> None:
    _, values = rest(1200.0, 5)
    noise = measure_imu_noise(make_recording(START_NS + np.arange(len(values)) * 5_000_000, values))
    short = noise.accel.taus_s < 10
    model = noise.accel.fit.allan_deviation(noise.accel.taus_s[short])
    assert noise.accel.deviation[short].mean(axis=1) == pytest.approx(model, rel=0.06)


def test_allan_deviation_agrees_with_allantools_at_every_tau() -> None:
    values = np.random.default_rng(0).standard_normal((20_000, 1))
    taus, deviation = allan_deviation(values, 0.005)
    expected = allantools.oadev(values[:, 0], rate=200.0, data_type="freq", taus=taus[taus < 1])[1]
    assert deviation[taus < 1, 0] == pytest.approx(expected, rel=1e-6)
    assert (np.diff(taus) > 0).all()


def test_a_constant_drift_does_not_pass_for_a_walk() -> None:
    rng = np.random.default_rng(2)
    means = rng.normal(0, 1e-3, (2400, 3)) + 1e-5 * np.arange(2400)[:, None]
    fit = fit_noise(means, 0.5)
    assert fit.drift == pytest.approx(2e-5 * np.ones(3), rel=0.05)
    assert fit.walk_interval[0] == 0.0
    assert fit.walk_interval[1] < 2e-5


def test_a_recording_too_short_for_the_walk_gives_a_bound_and_says_how_long_is_needed() -> None:
    noise = measure_imu_noise(make_recording(*rest(90.0, 1)))
    assert noise.gyro.walk_is_bound
    assert noise.gyro.walk >= NOISE.gyroscope_random_walk
    assert 300 < noise.gyro.needed_s < 40 * 3600


def test_motion_splits_the_recording_and_the_longest_rest_is_used() -> None:
    stamps, values = rest(300.0, 2)
    values[12_000:12_200, :3] += 0.3 * np.sin(np.linspace(0, 20, 200))[:, None]
    stretch = measure_imu_noise(make_recording(stamps, values)).stretch
    assert 61.0 <= stretch.start_s < 66.0
    assert stretch.end_s == pytest.approx(300.0, abs=1.5)
    assert any(start <= 60.5 <= end for start, end in stretch.motion_s)


def test_a_slow_push_to_another_tilt_ends_the_stretch() -> None:
    stamps, values = rest(400.0, 6)
    push = np.clip((np.arange(len(values)) / 200 - 150) / 8, 0, 1)
    values[:, 3] += 0.12 * push
    stretch = measure_imu_noise(make_recording(stamps, values)).stretch
    assert 155 < stretch.start_s < 175
    assert stretch.end_s == pytest.approx(400.0, abs=1.5)


def test_a_hand_held_imu_is_refused_with_the_time_of_the_motion() -> None:
    stamps, values = rest(120.0, 2)
    seconds = np.arange(len(values)) / 200
    values[:, :3] += 0.2 * np.sin(2 * np.pi * 0.7 * seconds)[:, None]
    with pytest.raises(InputError, match=r"longest stretch at rest is '0\.0' s, expected at least 60 s \(motion at 0\.0–"):
        measure_imu_noise(make_recording(stamps, values))


def test_lost_samples_are_filled_and_long_gaps_split() -> None:
    stamps, values = rest(200.0, 4)
    lost = np.ones(len(stamps), dtype=bool)
    lost[[5_000, 9_000, 9_001]] = False
    lost[12_000:12_400] = False
    recording = make_recording(stamps[lost], values[lost])
    assert [round(length, 3) for _, length in recording.gaps()] == [0.01, 0.015, 2.005]
    stretch = measure_imu_noise(recording).stretch
    assert stretch.start_s == pytest.approx(62.0, abs=0.01)
    assert stretch.filled == 0


def test_samples_out_of_order_or_not_finite_are_dropped() -> None:
    stamps, values = rest(2.0, 0)
    stamps[100] = stamps[50]
    values[200, 3] = np.nan
    recording = make_recording(stamps, values)
    assert recording.dropped == 2
    assert (np.diff(recording.stamps_ns) > 0).all()


def test_forces_in_units_of_gravity_are_refused() -> None:
    stamps, values = rest(70.0, 0)
    values[:, 3:] /= 9.81
    with pytest.raises(InputError, match=r"accelerometer reads '0\.997' at rest, expected 9\.8 m/s²"):
        measure_imu_noise(make_recording(stamps, values))


def test_a_stuck_axis_is_named() -> None:
    stamps, values = rest(70.0, 0)
    values[:, 1] = 0.25
    with pytest.raises(InputError, match="'gyro y' never changes"):
        measure_imu_noise(make_recording(stamps, values))


@pytest.mark.slow
def test_two_hours_give_densities_within_5_and_walks_within_20_percent() -> None:
    for seed in range(10):
        noise = measure_imu_noise(make_recording(*rest(7200.0, seed)))
        assert noise.gyro.fit.white == pytest.approx(NOISE.gyroscope_noise_density, rel=0.05)
        assert noise.accel.fit.white == pytest.approx(NOISE.accelerometer_noise_density, rel=0.05)
        assert noise.gyro.walk == pytest.approx(NOISE.gyroscope_random_walk, rel=0.20)
        assert noise.accel.walk == pytest.approx(NOISE.accelerometer_random_walk, rel=0.20)
