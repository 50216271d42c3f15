"""Exported scenes in the viewer of the report."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from colmap_model import write_sparse
from helpers.chromium import CHROMIUM, NO_CHROMIUM, TIMEOUT_MS
from helpers.level_camera import level_camera
from report_run import FinishedRun

from cleargs.capture.tables import load_frames
from cleargs.cli.main import invoke
from cleargs.report.web_scene import viewer_pose, write_viewer
from cleargs.scene.views import camera_of
from cleargs.splat.camera import Camera
from cleargs.splat.render import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]

SIZE = 320, 180
FRAME = 3
DIFFERENCE = 12.0
"""Maximum mean absolute difference from our image, in levels of 255, as in the tests of the report. Another
camera's image differs by 35."""

PAGE = """<!doctype html><style>
body { margin: 0 } #live, .sse-viewer, .sse-viewer > canvas { position: absolute; width: 100%; height: 100% }
</style>
<div id="live"></div><script src="viewer.js"></script><script>
"use strict";
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const address = (part, type) => URL.createObjectURL(new Blob([part], { type }));
window.show = async (content, name, settings) => {
  const stream = new Blob([bytes(packed.viewer)]).stream().pipeThrough(new DecompressionStream("gzip"));
  const module = await import(address(await new Response(stream).arrayBuffer(), "text/javascript"));
  const viewer = await module.createViewer({
    container: document.querySelector("#live"),
    settings,
    contentUrl: address(bytes(content), "application/octet-stream"),
    contentFilename: name, renderer: "webgl", ui: false, noanim: true,
  });
  if (!viewer.state.loaded) await new Promise((resolve) => viewer.events.once("loaded:changed", resolve));
  for (let frame = 0; frame < 4; frame++) {
    viewer.app.renderNextFrame = true;
    await new Promise((resolve) => viewer.app.once("frameend", resolve));
  }
};
</script>"""


def settings(camera: Camera) -> dict[str, Any]:
    """Minimal settings of the viewer (version 2 of its schema) with the pose of its camera."""
    effects = ("sharpness", "bloom", "grading", "vignette", "fringing")
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": True,
        "background": {"color": [0, 0, 0]},
        "postEffectSettings": {name: {"enabled": False} for name in effects},
        "animTracks": [],
        "cameras": [{"initial": viewer_pose(camera)}],
        "annotations": [],
        "startMode": "default",
    }


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    run = FinishedRun(tmp_path_factory.mktemp("export"))
    write_sparse(run.folder / "ingest")
    return run


@pytest.mark.parametrize("kind", ["ply", "compressed.ply", "sog"])
def test_the_viewer_shows_what_was_exported(
    run: FinishedRun, browser: Any, kind: str, tmp_path: Path
) -> None:
    file = tmp_path / f"wall.{kind}"
    assert invoke(["export", str(run.folder), "-o", str(file)]) == 0
    (tmp_path / "page.html").write_text(PAGE)
    write_viewer(tmp_path)
    camera = camera_of(load_frames(run.folder / "ingest")[FRAME])
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.set_default_timeout(TIMEOUT_MS)
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((tmp_path / "page.html").as_uri())
    content = base64.b64encode(file.read_bytes()).decode()
    page.evaluate(
        "([content, name, settings]) => show(content, name, settings)", [content, file.name, settings(camera)]
    )
    png = page.screenshot()
    page.close()
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB).astype(np.float64)
    ours = Viewer(run.scenes["consolidate"]).view(level_camera(camera, *SIZE)).astype(np.float64)
    assert complaints == [] and shown.shape == ours.shape and shown.std() > 20
    assert np.abs(shown - ours).mean() < DIFFERENCE
