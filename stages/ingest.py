"""Ingest: a capture becomes undistorted frames with poses, and the sparse points that each frame observes."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from pydantic import Field, field_validator

from cleargs.capture.config import CaptureConfig, SfmConfig
from cleargs.capture.sources import externals as capture_externals
from cleargs.files import External
from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.types import Device


class IngestConfig(SfmConfig, CaptureConfig):
    """Settings of ingest: from a capture to undistorted frames with poses and sparse points."""

    max_size: int = Field(
        960,
        ge=64,
        description="long side of the published images, px; never enlarged. Images, masks and videos of more "
        "than 2^28 pixels are refused",
    )
    feature_size: int = Field(
        960, ge=64, description="long side at which features are found, px; never enlarged, at least max_size"
    )
    rolling_shutter: bool = Field(
        True,
        description="look for the readout time of a rolling shutter in a video or numbered images, and fit "
        "poses and cameras with it; false: all rows of a frame are exposed at once",
    )
    holdout: str = Field(
        "none",
        description="test frames: none | every:N (frames 0, N, 2N, ...) | sharpest:N (the sharpest of every "
        "N registered frames in a row) | names, stems or patterns such as eval_*, separated by commas",
    )

    @field_validator("holdout", mode="before")
    @classmethod
    def _a_number_may_be_a_name(cls, value: object) -> object:
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

    @field_validator("holdout")
    @classmethod
    def _known_holdout(cls, value: str) -> str:
        # Letters before a colon name a rule. Digits do not: a frame may be named by a time of day.
        unknown = re.match(r"[A-Za-z]+:", value) and not re.fullmatch(r"(every|sharpest):[1-9]\d*", value)
        if value in ("every:1", "sharpest:1"):
            raise ValueError(f"{value} would hold out every frame")
        if unknown or not value.strip(" ,"):
            raise ValueError("expected none, every:N, sharpest:N or a list of frame names")
        return value


FEW_FRAMES, GOOD_FRAMES = 20, 30
"""Number of frames below which a warning is given, and the number that it asks for."""

VERSION = 36
CONFIG = IngestConfig
SETTINGS: tuple[str, ...] = ()
INPUTS: Mapping[str, tuple[str, ...]] = {}
TABLES = ("frames.parquet", "points.parquet", "observations.parquet", "motion.parquet")
OUTPUTS = (*TABLES, "world.json", "images", "colmap")
LEFTOVERS = ("images/*.png",)
LIBRARIES = ("pycolmap", "opencv-contrib-python-headless", "av", "pillow", "numpy", "scipy")

# Wall seconds on two cores: features per frame and per megapixel; matches per pair and per squared megapixel,
# because all features of two frames are compared. Then the maximum number of features per megapixel.
_FEATURES_S, _FEATURES_S_PER_MEGAPIXEL = 0.015, 0.7
_PAIR_S, _PAIR_S_PER_SQUARE_MEGAPIXEL = 0.0025, 0.15
_FEATURES_PER_MEGAPIXEL = 7000
# Seconds on one core: to start COLMAP's process; per megapixel of a frame, to read and undistort it, to find
# its pose (mapping), and to triangulate points at its given pose.
_START_S = 1.0
_FRAME_S, _MAPPING_S, _TRIANGULATION_S = 0.15, 1.3, 0.2
_PICTURES_AROUND = 5
"""Number of grey pictures that stay on disk for each frame of a video: the frame and those around it."""


def externals(config: IngestConfig, source: Path) -> Mapping[str, External]:
    """Return the files and folders of the capture that are read."""
    from cleargs.models.registry import installed_files

    return {**capture_externals(source, config), **installed_files("people")}


def other_libraries(device: Device, config: object) -> Mapping[str, str]:
    """Return the version of torch if it evaluates the detector of people."""
    from cleargs.models.registry import installed_files

    return {"torch": metadata.version("torch")} if installed_files("people") else {}


def preflight(config: IngestConfig) -> None:
    """Raise InputError if the detector of people is installed, but damaged. Ingest needs no model."""
    from cleargs.models.registry import installed_files

    if installed_files("people"):
        from cleargs.models.detector import load_detector

        load_detector()


def estimate(context: StageContext[IngestConfig]) -> Estimate:
    """Estimate the cost from the number of frames, their size, and the number of pairs to match."""
    from cleargs.capture.sources import frame_size, open_capture
    from cleargs.media.image import reduced_size

    from .cost import thread_factor

    config = context.config
    capture = open_capture(context.source, config)
    if capture.told:
        context.reporter.info(capture.told)
    count = len(capture.frames)
    width, height = frame_size(capture) or (1920, 1080)

    def megapixels_at(long_side: int) -> float:
        return math.prod(reduced_size(width, height, long_side)) / 1e6

    distant = count * (2 * config.overlap + config.loop_candidates)
    pairs = count * (count - 1) / 2 if count < config.exhaustive_below else distant
    megapixels = megapixels_at(max(config.feature_size, config.max_size))
    alone = _FRAME_S * megapixels * count
    parallel = 0.0
    if needs_poses := capture.model is None:
        alone += _START_S
        parallel += count * (_FEATURES_S + _FEATURES_S_PER_MEGAPIXEL * megapixels)
        matched = min(megapixels, config.max_features / _FEATURES_PER_MEGAPIXEL)
        parallel += pairs * (_PAIR_S + _PAIR_S_PER_SQUARE_MEGAPIXEL * matched**2)
        alone += (_TRIANGULATION_S if capture.posed else _MAPPING_S) * megapixels * count
    seconds = parallel * thread_factor(context.threads) + alone
    disk = count * 2 * 1.6e-3 * megapixels + (0.0005 * count if needs_poses else 0.0)
    if capture.kind == "video":
        disk += count * _PICTURES_AROUND * 1e-3 * megapixels
    return Estimate(
        minutes=seconds / 60,
        memory_gb=0.4 + 0.001 * count,
        disk_gb=disk,
        frames=count,
        megapixels=megapixels_at(config.max_size),
    )


def run(context: StageContext[IngestConfig]) -> StageResult:
    """Choose frames, rotate and reduce them, find poses or use the given ones, undistort and publish."""
    from cleargs.capture.choice import held_out, holdout_hash, select_sharp_frames
    from cleargs.capture.known_models import file_of
    from cleargs.capture.lens_report import camera_rows
    from cleargs.capture.loose_points import in_scene
    from cleargs.capture.measuring import measure_motion, write_motion
    from cleargs.capture.prepare import prepare
    from cleargs.capture.publish import publish
    from cleargs.capture.sfm import contradictions, reconstruct
    from cleargs.capture.sources import open_capture
    from cleargs.capture.summary import IngestSummary
    from cleargs.media.image import read_rgb
    from cleargs.models.registry import installed_files

    config, work, reporter = context.config, context.checkpoints, context.reporter
    capture = open_capture(context.source, config)
    reporter.info(
        f"{len(capture.frames)} of {capture.n_available} frames ({capture.kind}), "
        f"long side at most {config.max_size} px"
    )
    for note in capture.remarks:
        reporter.warn(note)
    few = len(capture.frames) < FEW_FRAMES
    if few and config.max_frames >= GOOD_FRAMES:  # a quick test, such as the demo, asks for fewer
        reporter.warn(
            f"there are only {len(capture.frames)} frames; a good scene needs {GOOD_FRAMES} or more"
        )
    long_side = max(config.feature_size, config.max_size)
    capture = select_sharp_frames(capture, long_side, reporter, by_motion=config.fps is None)
    frames = prepare(capture, work, long_side, reporter)
    if installed_files("people"):
        from cleargs.capture.movers import with_movers
        from cleargs.models.detector import load_detector

        frames = with_movers(frames, work, load_detector().boxes, reporter)
    program = (VERSION, *map(metadata.version, LIBRARIES))
    scene = reconstruct(
        frames,
        capture.model,
        work,
        config,
        context.seed,
        context.threads,
        reporter,
        known=lambda job: file_of(job, context.cache, program),
    )
    scene = scene.turned_up(frames, reporter)
    scene, motion = measure_motion(
        capture, frames, scene, work, reporter, rolling_shutter=config.rolling_shutter
    )
    registered = {image.name for image in scene.model.images.values()}
    test = held_out(
        config.holdout,
        [frame.source.name for frame in frames],
        lambda index: read_rgb(work / "images" / frames[index].image),
        [frame.image in registered for frame in frames],
    )
    if config.holdout == "none":
        test = {index for index, frame in enumerate(frames) if frame.source.test}
    outcome = scene.outcome
    loose = None
    if capture.loose is not None and outcome.method != "sfm":
        loose = in_scene(capture.loose, scene.similarity, scene.model)
        reporter.info(f"{0 if loose is None else len(loose.xyz)} points of the input start Gaussians")
    model = publish(frames, scene.model, outcome, test, work, context.out, config.max_size, reporter, loose)
    write_motion(context.out / "motion.parquet", frames, motion)
    scene.similarity.write(context.out)
    return StageResult(
        missing=contradictions(outcome, config, reporter, rolled=bool(motion.readouts)),
        summary=IngestSummary(
            kind=capture.kind,
            input=capture.told,
            poses=outcome.method,
            given_poses_missed_px=outcome.missed_px and round(outcome.missed_px, 6),
            pose_convention=outcome.convention if capture.posed else None,
            kept_out_matches_off_px={name: round(px, 6) for name, px in outcome.errors_px.items()} or None,
            kept_out=outcome.prediction and outcome.prediction.model_dump(),
            cameras=camera_rows(scene.model, frames),
            frames=len(frames),
            frames_available=capture.n_available,
            registered=len(model.images),
            placed=dict(Counter(outcome.placed[frame.image] for frame in frames)),
            test=len(test),
            holdout_hash=holdout_hash(config.holdout, (frames[index].source.name for index in test)),
            points=len(model.point_ids),
            observations=sum(len(image.point_ids) for image in model.images.values()),
            mean_reprojection_error_px=round(float(model.error.mean()), 6),
            up="found" if scene.stood else "tops of the pictures",
        ).figures()
        | motion.summary(),
    )
