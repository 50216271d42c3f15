"""A COLMAP project: ``images/`` and a sparse model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import chosen, frame_key, image_files, is_inside, mask_externals
from cleargs.errors import InputError


def detect(source: Path, *, poses: bool) -> bool:
    """See `Layout.detect`."""
    return poses and _find_model(source) is not None


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`."""
    model = _find_model(source)
    assert model is not None
    return {"images": source / "images", **mask_externals(source), "sparse": model}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. Images without a pose are frames too: they stay in the table, marked."""
    from cleargs.capture.model import read_model

    folder = _find_model(source)
    assert folder is not None
    model = read_model(folder)
    root = source / "images"
    if not root.is_dir():
        raise InputError(f"{source} has a sparse model but no images/", hint="put the images into images/")
    posed = {image.name: image for image in model.images.values()}
    outside = [name for name in posed if not is_inside(name)]
    if outside:
        raise InputError(
            f"the COLMAP model lists images outside images/ or hidden in it, such as {outside[0]}",
            hint="put them into images/ and export the model again, or set ingest.poses=sfm",
        )
    missing = [name for name in posed if not (root / name).is_file()]
    if missing:
        raise InputError(
            f"the COLMAP model lists images that do not exist, such as {missing[0]} ({len(missing)} in all)",
            hint="put the images that the model was made from into images/, or set ingest.poses=sfm",
        )
    stored = {path.relative_to(root).as_posix() for path in image_files(root, below=True)}
    frames = []
    for name in sorted(set(posed) | stored, key=frame_key):
        image = posed.get(name)
        camera, pose = (None, None) if image is None else (model.cameras[image.camera_id], image.pose)
        frames.append(SourceFrame(name, root / name, camera=camera, pose=pose))
    taken = chosen(frames, source, config.max_frames)
    return Capture("colmap", taken, len(frames), model if len(model.point_ids) or model.dropped else None)


def _find_model(root: Path) -> Path | None:
    """The folder of the sparse model, or None."""
    for folder in (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0"):
        if any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder
    return None
