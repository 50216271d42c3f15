"""A phone's image processing, the moving balloon, and walks with stretches of blur."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from cleargs.errors import InputError
from cleargs.progress import SilentReporter
from cleargs.rva.geometry import cumulative_motion, cut_into_bins
from cleargs.stages.rva import RvaConfig
from cleargs.synth.image_motion import track_motion
from cleargs.synth.movers import Balloon
from cleargs.synth.optics import Shutter
from cleargs.synth.path import FPS, HandheldPath, frame_times
from cleargs.synth.phone import LAG_S, METERING_SHARE, Tone, auto_exposure, encode_and_decode, tone_of
from cleargs.synth.protocols import PROTOCOLS, REFERENCE_WIDTH, plan_faults
from cleargs.synth.raycast import RoomWorld, room_setup
from cleargs.synth.room import make_room
from cleargs.synth.synthetic_capture import make_capture

WIDTH, HEIGHT, SEED = 96, 54, 3
UNRELIABLE = 7.0
"""px at width 640. R falls below its threshold at 3 to 4 px at width 320 (docs/experiments/rva.md)."""


def rgb(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_COLOR_RGB).astype(np.float64)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(np.float64) - b) ** 2)))


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phone") / "a"
    make_capture(folder, "phone", frames=6, width=WIDTH, height=HEIGHT, seed=SEED, reporter=SilentReporter())
    return folder


def test_the_tone_curve_rises_from_black_to_white() -> None:
    values = np.linspace(0, 1, 257)
    for seed in range(5):
        curve = tone_of(seed).tone(values)
        assert (np.diff(curve) > 0).all()
        assert curve[0] == pytest.approx(0, abs=1e-12) and curve[-1] == pytest.approx(1)
        # The curve differs from sRGB by much more than rounding to 8 bits.
        assert np.abs(curve - values).max() > 0.03
    np.testing.assert_array_equal(Tone().tone(values), values)


def test_sharpening_overshoots_at_edges_only() -> None:
    image = np.full((20, 40, 3), 0.4)
    image[:, 20:] = 0.6
    sharpened = Tone(sharpening=0.5).apply(image)
    assert sharpened[10, 19, 1] < 0.38 and sharpened[10, 20, 1] > 0.62
    np.testing.assert_allclose(sharpened[:, [0, -1]], image[:, [0, -1]], atol=1e-12)


def test_automatic_exposure_lags_behind_the_light() -> None:
    step, change = 1 / FPS, 40
    light = np.where(np.arange(80) < change, 0.4, 0.1)  # two stops darker
    gains = auto_exposure(light, step)
    assert gains.mean() == pytest.approx(0, abs=1e-12)
    asked = 2 * METERING_SHARE
    reached = gains - gains[0]
    assert reached[change - 1] == pytest.approx(0)
    assert reached[change] == pytest.approx(asked * (1 - np.exp(-step / LAG_S)))
    assert 0 < reached[change] < 0.4 * asked < reached[change + 6] < asked
    assert reached[-1] == pytest.approx(asked, rel=1e-4)


def test_the_video_shows_the_frames_with_codec_artifacts(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (80, 160, 3)), (0, 0), 1.5)
    texture = (texture - texture.mean()) * 4 + 128
    frames = [
        np.clip(texture[4:76, 4 * k : 4 * k + 128] + rng.normal(0, 2, (72, 128, 3)), 0, 255).astype(np.uint8)
        for k in range(6)
    ]
    shown = encode_and_decode(tmp_path / "a.mp4", frames, FPS)
    again = encode_and_decode(tmp_path / "b.mp4", frames, FPS)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    for frame, decoded, other in zip(frames, shown, again, strict=True):
        np.testing.assert_array_equal(decoded, other)
        # 4:2:0 and the rate cost quality; at 480x270 PSNR is 34 to 42 dB.
        assert 22 < psnr(frame, decoded) < 45
        assert np.abs((frame.astype(np.float64) - decoded).mean((0, 1))).max() < 4


def test_the_true_faults_of_every_frame_are_written(phone: Path) -> None:
    rows = pq.read_table(phone / "truth" / "frames.parquet").to_pylist()
    tone = tone_of(SEED)
    for row in rows:
        assert (row["tone_contrast"], row["tone_pivot"]) == (tone.contrast, tone.pivot)
        assert row["sharpening"] == tone.sharpening > 0
        assert row["codec_bits_per_pixel"] > 0 and row["noise"] > 0 and row["readout_s"] > 0
        assert row["shutter_share"] == pytest.approx(row["exposure_s"] * FPS)
        assert row["shutter_share"] == pytest.approx(PROTOCOLS["phone"].shutter)
    gains = [row["exposure_ev"] for row in rows]
    assert np.mean(gains) == pytest.approx(0, abs=1e-9) and np.ptp(gains) > 0.01
    masks = [rgb(phone / "truth" / "moving" / f"{number:06d}.png")[..., 0] for number in range(len(rows))]
    shares = [row["moving_share"] for row in rows]
    assert [np.mean(mask == 255) for mask in masks] == pytest.approx(shares) and max(shares) > 0


def test_equal_seeds_film_the_same(phone: Path, tmp_path: Path) -> None:
    make_capture(
        tmp_path / "b", "phone", frames=6, width=WIDTH, height=HEIGHT, seed=SEED, reporter=SilentReporter()
    )
    first, second = (
        {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (phone, tmp_path / "b")
    )
    assert first == second


def test_the_balloon_is_in_the_frames_and_not_in_the_truth(phone: Path) -> None:
    inside, outside = [], []
    for number in range(6):
        name = f"{number:06d}.png"
        error = np.abs(rgb(phone / "images" / name) - rgb(phone / "truth/observed/images" / name)).mean(2)
        seen = rgb(phone / "truth" / "moving" / name)[..., 0] > 0
        inside.append(error[seen])
        outside.append(error[~seen])
    assert np.concatenate(inside).mean() > 2 * np.concatenate(outside).mean()


def test_only_the_balloon_moves_within_an_exposure() -> None:
    setup, room = room_setup(6, WIDTH, HEIGHT, SEED), make_room(SEED)
    world, balloon = RoomWorld(room), Balloon(room, SEED)
    path = HandheldPath(setup.course, 6, SEED)
    pose = path.poses(np.array([0.5]))
    index = np.zeros((8, HEIGHT), np.intp) + np.arange(8)[:, None]
    poses = np.repeat(pose, 8, 0)
    empty = world.render(Shutter(poses, index), setup.lens)
    (resting, share_at_rest), (moving, share_moving) = (
        world.film(balloon, Shutter(poses, index, times), setup.lens)
        for times in (np.full(8, 0.5), 0.5 + np.linspace(-0.2, 0.2, 8))
    )
    assert share_moving.min() >= 0 and share_moving.max() <= 1 + 1e-9
    assert (share_moving > 0).sum() > 1.2 * (share_at_rest > 0).sum() > 0
    assert share_moving.sum() == pytest.approx(share_at_rest.sum(), rel=0.3)  # its distance changes
    assert np.abs(resting - empty)[share_at_rest > 0.99].mean() > 0.05
    # Elsewhere only its shadow changes the image, in a small part of it.
    assert np.median(np.abs(moving - empty)[share_moving == 0]) < 0.01


def test_other_protocols_have_no_moving_object(tmp_path: Path) -> None:
    make_capture(tmp_path / "a", "sharp", frames=2, width=32, height=18, seed=0, reporter=SilentReporter())
    assert not (tmp_path / "a" / "truth" / "moving").exists()
    rows = pq.read_table(tmp_path / "a" / "truth" / "frames.parquet").to_pylist()
    assert {(row["moving_share"], row["tone_contrast"], row["codec_bits_per_pixel"]) for row in rows} == {
        (0.0, 0.0, 0.0)
    }
    with pytest.raises(InputError, match="33x18"):
        make_capture(
            tmp_path / "b", "phone", frames=2, width=33, height=18, seed=0, reporter=SilentReporter()
        )


def test_a_stretch_leaves_bins_without_sharp_frames() -> None:
    setup = room_setup(96, WIDTH, HEIGHT, SEED)
    path = HandheldPath(setup.course, 96, SEED, stretched=True)
    times = frame_times(96)
    poses = path.poses(times)
    motions = [
        track_motion(path, float(time), setup.world.depth(pose, setup.lens), setup.lens)
        for time, pose in zip(times, poses, strict=True)
    ]
    faults = plan_faults(PROTOCOLS["gs2e-stretches"], motions, [1.0] * 96, FPS, SEED)
    blur = np.array([motion.blur(fault.exposure) for motion, fault in zip(motions, faults, strict=True)])
    blurred = blur * REFERENCE_WIDTH / WIDTH > UNRELIABLE
    bins = cut_into_bins(cumulative_motion(poses[:, :, 3], poses[:, :, 2], RvaConfig()), 8).index
    spoilt = [number for number in np.unique(bins) if blurred[bins == number].all()]
    assert len(spoilt) >= 1
    calm = path.hand.shake_strength(times) < 0.01
    assert calm.sum() > 48 and (~blurred[calm]).mean() > 0.9
