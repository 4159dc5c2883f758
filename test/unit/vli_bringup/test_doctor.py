"""The doctor says what will spoil a scan, and nothing of a sensor that is well."""

from __future__ import annotations

import numpy as np
import pytest

from vli_bringup.cli import main
from vli_bringup.diagnosis import live
from vli_bringup.diagnosis.camera import CameraCheck
from vli_bringup.diagnosis.findings import Finding, Level, to_text, worst
from vli_bringup.diagnosis.imu import ImuCheck, quietest_noise
from vli_bringup.diagnosis.stamps import check_stamps
from vli_bringup.settings import Settings
from vli_common.calibration import Calibration, ImuCalibration
from vli_common.camera import make_camera
from vli_common.node.transport import SHARED_MEMORY_PROFILE, UDP_PROFILE
from vli_common.types import EncodedImage, ImuSample

MS = 1_000_000
CAMERA = make_camera("none", (200.0, 200.0, 160.0, 120.0), (), (320, 240))
CALIBRATION = Calibration(CAMERA, 60.0, np.eye(4), 0, ImuCalibration(200.0, 2e-3, 3e-4, 2e-4, 2e-5), None)
RNG = np.random.default_rng(0)
TEXTURE = RNG.integers(20, 200, (12, 16)).astype(np.uint8).repeat(20, 0).repeat(20, 1)


def texts(findings, level):
    return [finding.text for finding in findings if finding.level is level]


def image(stamp_ns, pixels):
    return EncodedImage(stamp_ns, pixels.tobytes(), "mono8", pixels.shape[1], pixels.shape[0], pixels.shape[1])


def camera_findings(frames, calibration=CALIBRATION, period_ns=1_000_000_000 // 60):
    check = CameraCheck(calibration, Settings())
    for index, pixels in enumerate(frames):
        check.add(image(1000 * MS + index * period_ns, pixels))
    return list(check.findings())


def alternating(long=TEXTURE, count=60):
    return [long if index % 2 == 0 else long // 20 for index in range(count)]


def imu_samples(count=1000, noise=1.0, gyro=(0.0, 0.0, 0.0)):
    rate, accel = 2e-4 * np.sqrt(200) * noise, 2e-3 * np.sqrt(200) * noise
    return [
        ImuSample(1000 * MS + 5 * MS * k, np.array(gyro) + rate * RNG.normal(size=3), [0, 0, 9.81] + accel * RNG.normal(size=3))
        for k in range(count)
    ]


def imu_findings(samples, calibration=CALIBRATION):
    check = ImuCheck(calibration, "/imu")
    for sample in samples:
        check.add(sample)
    return list(check.findings())


def test_a_well_exposed_alternating_camera_is_good():
    findings = camera_findings(alternating())
    assert worst(findings) is Level.GOOD
    assert "30 long and 30 short" in " ".join(finding.text for finding in findings)


def test_a_stream_that_does_not_alternate_is_told_with_the_mode_that_works():
    findings = camera_findings([TEXTURE] * 150)
    assert any("do not alternate" in text and "--mode vi" in text for text in texts(findings, Level.PROBLEM))


def test_images_of_another_size_than_the_calibration_are_a_problem():
    findings = camera_findings(alternating(TEXTURE[:200]))
    assert any("320 x 200, the calibration is for 320 x 240" in text for text in texts(findings, Level.PROBLEM))


def test_a_scene_without_texture_is_a_problem_and_a_dark_or_saturated_one_is_told():
    assert any("corners to track" in text for text in texts(camera_findings(alternating(TEXTURE * 0 + 90)), Level.PROBLEM))
    assert any("saturated" in text for text in texts(camera_findings(alternating(TEXTURE * 0 + 255)), Level.WARNING))
    dark = camera_findings(alternating((TEXTURE // 20 + 6).astype(np.uint8)))
    assert any("are dark" in text for text in texts(dark, Level.WARNING))


def test_what_cannot_be_decoded_is_counted():
    check = CameraCheck(CALIBRATION, Settings())
    for index in range(10):
        check.add(EncodedImage(index * 16 * MS + 1, b"no image", "jpeg", compressed=True))
    assert any("10 of 10 images cannot be decoded" in text for text in texts(check.findings(), Level.PROBLEM))


@pytest.mark.parametrize(
    ("stamps", "level", "words"),
    [
        ([k * 5 * MS + MS for k in range(100)], Level.GOOD, "100 messages, 200.0 a second"),
        ([k * 10 * MS + MS for k in range(100)], Level.WARNING, "100.0 a second, the calibration says 200"),
        ([k * 5 * MS + MS for k in range(100) if k not in (40, 41, 70)], Level.WARNING, "3 messages missing"),
        ([k * 5 * MS + MS for k in [*range(50), *range(48, 100)]], Level.WARNING, "do not increase"),
        ([k * 5 * MS + (k % 2) * 3 * MS for k in range(1, 100)], Level.WARNING, "jitter"),
        ([0] * 50, Level.PROBLEM, "every stamp is 0"),
        ([], Level.PROBLEM, "0 messages came"),
    ],
)
def test_stamps_are_judged_by_rate_gaps_and_order(stamps, level, words):
    findings = list(check_stamps("IMU", stamps, 200.0, "imu0.update_rate"))
    assert any(words in text for text in texts(findings, level)), findings


def test_an_imu_at_rest_with_the_calibrated_noise_is_good():
    assert worst(imu_findings(imu_samples())) is Level.GOOD


def test_a_noisier_imu_than_calibrated_is_told():
    assert sum("times as noisy" in text for text in texts(imu_findings(imu_samples(noise=6)), Level.WARNING)) == 2


def test_an_imu_in_g_is_a_problem():
    samples = [ImuSample(item.stamp_ns, item.gyro, item.accel / 9.81) for item in imu_samples()]
    assert any("that is g" in text for text in texts(imu_findings(samples), Level.PROBLEM))


def test_a_clipped_axis_is_told():
    swing = [np.array([2.0 * np.sin(0.02 * k), 0.0, 0.0]) for k in range(1000)]
    samples = [ImuSample(item.stamp_ns, item.gyro + turn, item.accel) for item, turn in zip(imu_samples(), swing, strict=True)]
    assert not texts(imu_findings(samples), Level.WARNING)
    clipped = [ImuSample(item.stamp_ns, np.clip(item.gyro, -1.5, 1.5), item.accel) for item in samples]
    assert any("gyro x reads exactly 1.5" in text for text in texts(imu_findings(clipped), Level.WARNING))


def test_slow_motion_does_not_look_like_noise():
    time_s = np.arange(2000) / 200
    motion = np.stack([np.sin(2 * np.pi * 0.5 * time_s)] * 3, axis=1)
    noise = 1e-3 * RNG.normal(size=motion.shape)
    assert quietest_noise(motion + noise, 200.0) == pytest.approx(1e-3 / np.sqrt(200), rel=0.3)


def test_the_worst_findings_come_last():
    text = to_text([Finding(Level.PROBLEM, "b", "two"), Finding(Level.GOOD, "a", "one")])
    assert [line.split()[0] for line in text.splitlines()] == ["ok", "PROBLEM"]


def test_the_demo_recording_is_fit_for_a_scan(repository, capsys):
    demo = repository / "bags" / "demo"
    assert main(["doctor", str(demo / "bag"), "--calib", str(demo / "calibration.yaml")]) == 0
    out = capsys.readouterr().out
    assert "in 100 % of the short frames" in out
    assert out.endswith("fit for a scan\n")


def test_a_wrong_calibration_is_found_out(repository, tmp_path, capsys):
    demo = repository / "bags" / "demo"
    text = (demo / "calibration.yaml").read_text().replace("update_rate: 200.0", "update_rate: 100.0")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(text)
    assert main(["doctor", str(demo / "bag"), "--calib", str(wrong), "--duration", "3"]) == 0
    assert "correct 'imu0.update_rate'" in capsys.readouterr().out


def test_it_wants_a_bag_or_a_live_sensor(capsys):
    assert main(["doctor"]) == 2
    assert main(["doctor", "none.mcap"]) == 2
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.parametrize(("profile", "told"), [(UDP_PROFILE, []), (SHARED_MEMORY_PROFILE, ["sockets"])])
def test_sockets_that_linux_keeps_small_are_told_with_the_command_that_lets_them_grow(monkeypatch, profile, told):
    monkeypatch.setattr(live, "local_profile", lambda: profile)
    findings = live.socket_findings()
    assert [finding.subject for finding in findings] == told
    assert all("sysctl -w net.core.rmem_max=4194304" in finding.text for finding in findings)
