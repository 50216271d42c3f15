"""The shots that are asked for of a run: a still, its path, a turntable, given poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cleargs.capture.poses import Similarity
from cleargs.capture.tables import Frame, load_frames
from cleargs.errors import InputError
from cleargs.manifest import linked_manifest
from cleargs.media import MAX_PIXELS
from cleargs.render.output import Shot
from cleargs.render.paths import framed, smooth_path, turntable
from cleargs.render.pose_files import World, read_poses
from cleargs.splat.camera import Camera
from cleargs.splat.views import view_of

Size = tuple[int, int]


class CaptureShots:
    """Makes shots from the frames in ``ingest``, which have a pose.

    Pictures are of ``size``, or where that is None of the frames' size, an odd width or height one larger
    where ``even``. Raises InputError when no frame has a pose.
    """

    def __init__(self, ingest: Path, size: Size | None, *, even: bool, side_by_side: bool) -> None:
        self._ingest, self._size, self._even, self._beside = ingest, size, even, side_by_side
        self._all = load_frames(ingest)
        self._frames = [frame for frame in self._all if frame.registered]
        if not self._frames:
            raise InputError("no frame of this capture has a pose", hint="see cleargs show RUN ingest")
        self._cameras = [view_of(frame, ingest, 0.0).camera for frame in self._frames]
        self._lens = self._cameras[len(self._cameras) // 2]

    def still(self, frame_id: int | None) -> list[Shot]:
        """At the pose of a frame; None: of the one in the middle of the capture."""
        index = len(self._frames) // 2
        if frame_id is not None:
            numbers = [frame.frame_id for frame in self._frames]
            if frame_id not in numbers:
                there = any(frame.frame_id == frame_id for frame in self._all)
                raise InputError(
                    f"frame {frame_id} {'has no pose' if there else 'is not in this capture'}",
                    hint=f"choose one from {numbers[0]} to {numbers[-1]}",
                )
            index = numbers.index(frame_id)
        return self._shots([self._cameras[index]], [self._frames[index]])

    def path(self, count: int) -> list[Shot]:
        """``count`` pictures along the smoothed path of the capture, at equal steps."""
        path = smooth_path(self._cameras, count)
        cameras = [replace(self._lens, world_to_camera=pose) for pose in path.poses]
        return self._shots(cameras, [self._frames[index] for index in path.nearest])

    def turntable(self, count: int) -> list[Shot]:
        """``count`` pictures of a full turn around what the cameras look at."""
        poses = turntable(self._cameras, count)
        return self._shots([replace(self._lens, world_to_camera=pose) for pose in poses])

    def poses(self, path: Path, world: World | None) -> list[Shot]:
        """A picture at each pose that the file ``path`` lists; see `read_poses`."""
        manifest = linked_manifest(self._ingest.parent, self._ingest.name)
        noted = None if manifest is None else manifest.summary.get("similarity")
        similarity = Similarity.from_json(noted, self._ingest)
        return self._shots(read_poses(path, self._lens, similarity, world))

    def _shots(self, cameras: Sequence[Camera], filmed: Sequence[Frame] = ()) -> list[Shot]:
        """All of one size, each with the frame beside it where that is asked for."""
        width, height = self._size or (cameras[0].width, cameras[0].height)
        if self._size is None and self._even:
            width, height = width + width % 2, height + height % 2
        if width * height > MAX_PIXELS:
            raise InputError(f"{width}x{height} pixels are too many", hint="give a smaller --size")
        images = [self._ingest / frame.image for frame in filmed] if self._beside else [None] * len(cameras)
        return [
            Shot(framed(camera, width, height), image) for camera, image in zip(cameras, images, strict=True)
        ]
