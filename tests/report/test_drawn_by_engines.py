"""Exported scenes, drawn by PlayCanvas' engine and by Spark (`make oracles`) in a browser without a GPU."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.chromium import CHROMIUM, NO_CHROMIUM, TIMEOUT_MS
from numpy.typing import NDArray
from report_run import camera, wall

from cleargs.splat.camera import Camera
from cleargs.splat.formats import write_scene
from cleargs.splat.render import Viewer
from cleargs.splat.spz import SpzVersion
from cleargs.splat.transforms import transform_scene

PACKAGES = Path(__file__).parents[2] / ".oracles/node_modules"
ENGINES = ("playcanvas/build/playcanvas.min.mjs", "@sparkjsdev/spark/dist/spark.module.js")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.alone,
    pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM),
    pytest.mark.skipif(
        not all((PACKAGES / engine).is_file() for engine in ENGINES),
        reason="npm's packages are not installed (make oracles)",
    ),
]

SIZE = 320, 180
DIFFERENCE = 10.0
"""Maximum mean absolute difference from our image, in levels of 255. Measured: 4.5 in PlayCanvas, 7 in Spark.
The mirrored image differs by 41."""
ADDRESS = "http://engines.invalid/"  # answered from the disk: modules do not load from file: addresses
PAGE = """<!doctype html><style>body { margin: 0; background: #000 } canvas { display: block }</style>
<script type="importmap">{"imports": {
  "playcanvas": "/playcanvas/build/playcanvas.min.mjs",
  "playcanvas-spz": "/playcanvas/scripts/esm/parsers/spz-parser.mjs",
  "three": "/three/build/three.module.js",
  "three/addons/": "/three/examples/jsm/",
  "@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js"
}}</script>
<canvas width="320" height="180"></canvas>
<script type="module">
const canvas = document.querySelector("canvas");
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const frame = () => new Promise(requestAnimationFrame);

window.playcanvas = async (content, name, pose, fov) => {
  const pc = await import("playcanvas");
  const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false } });
  app.start();
  const { SpzParser } = await import("playcanvas-spz");
  app.loader.getHandler("gsplat").addParser(new SpzParser(app));
  pc.WasmModule.setConfig("ZstdDecoderModule", { fallbackUrl: "/zstd.js" }); // its own decoder is not on npm
  const eye = new pc.Entity();
  eye.addComponent("camera", {
    clearColor: new pc.Color(0, 0, 0), fov, nearClip: 0.01, farClip: 100, toneMapping: pc.TONEMAP_NONE,
  });
  const place = new pc.Mat4().set(pose);
  eye.setPosition(place.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(place));
  app.root.addChild(eye);
  const url = URL.createObjectURL(new Blob([bytes(content)]));
  const asset = new pc.Asset("scene", "gsplat", { url, filename: name });
  app.assets.add(asset);
  await new Promise((resolve, reject) => {
    asset.ready(resolve);
    asset.on("error", reject);
    app.assets.load(asset);
  });
  const entity = new pc.Entity();
  entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
  for (let number = 0; number < 30; number++) await frame();
};

window.spark = async (content, name, pose, fov) => {
  const THREE = await import("three");
  const { SparkRenderer, SplatMesh } = await import("@sparkjsdev/spark");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  const eye = new THREE.PerspectiveCamera(fov, canvas.width / canvas.height, 0.01, 100);
  eye.matrix.fromArray(pose);
  eye.matrix.decompose(eye.position, eye.quaternion, eye.scale);
  const scene = new THREE.Scene();
  const mesh = new SplatMesh({ fileBytes: bytes(content), fileName: name });
  scene.add(new SparkRenderer({ renderer }), mesh);
  await mesh.initialized;
  for (let number = 0; number < 30; number++) {
    renderer.render(scene, eye);
    await frame();
  }
};
window.ready = true;
</script>"""
PLACES = {
    "three": ("https://cdn.jsdelivr.net/npm/three@{}/", "."),
    "@sparkjsdev/spark": ("https://sparkjs.dev/releases/spark/{}/", "dist"),
}
"""Package -> its address in docs/viewers.md, with the version, and the folder that is there."""
ZSTD = """window.ZstdDecoderModule = async () => {
  const { decompress } = await import("/fzstd/esm/index.mjs");
  return { decompress: (source, size) => decompress(source, new Uint8Array(size)) };
};"""
WRITTEN = {"": ("text/html", PAGE), "zstd.js": ("text/javascript", ZSTD)}


def drawn(browser: Any, engine: str, file: Path, view: Camera) -> NDArray[np.float64]:  # [H, W, 3]
    """Return the picture that an engine draws of a file, with the pose of a camera."""
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.set_default_timeout(TIMEOUT_MS)
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def answer(route: Any) -> None:
        path = route.request.url.removeprefix(ADDRESS)
        if path in WRITTEN:
            route.fulfill(content_type=WRITTEN[path][0], body=WRITTEN[path][1])
        else:
            route.fulfill(path=PACKAGES / path)

    page.route(f"{ADDRESS}**", answer)
    page.goto(ADDRESS)
    page.wait_for_function("window.ready")
    turned = np.diag([1.0, -1.0, -1.0, 1.0])  # the engines' cameras look along -z, with y up
    pose = np.linalg.inv(view.world_to_camera) @ turned
    if file.suffix == ".spz":  # the file has these axes
        pose = turned @ pose
    fov = float(np.degrees(2 * np.arctan(view.height / 2 / view.fy)))
    content = base64.b64encode(file.read_bytes()).decode()
    arguments = [content, file.name, pose.T.ravel().tolist(), fov]
    page.evaluate(f"(given) => window.{engine}(...given)", arguments)
    png = page.screenshot()
    page.close()
    assert complaints == []
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB).astype(np.float64)


@pytest.mark.parametrize(
    ("engine", "kind", "spz_version"),
    [("playcanvas", "sog", 3), ("playcanvas", "spz", 4), ("spark", "spz", 3)],
)
def test_an_engine_draws_the_scene_as_we_do(
    browser: Any, engine: str, kind: str, spz_version: SpzVersion, tmp_path: Path
) -> None:
    scene, small = wall(2, sh_degree=3), camera(1)
    write_scene(tmp_path / f"wall.{kind}", scene, kind, spz_version=spz_version)
    focal = small.fx * SIZE[0] / small.width
    view = Camera(*SIZE, focal, focal, SIZE[0] / 2, SIZE[1] / 2, small.world_to_camera)
    theirs = drawn(browser, engine, tmp_path / f"wall.{kind}", view)
    ours = Viewer(scene).view(view).astype(np.float64)
    assert theirs.shape == ours.shape and theirs.std() > 20
    assert np.abs(theirs - ours).mean() < DIFFERENCE


def test_the_page_of_the_documentation_draws_an_export(browser: Any, tmp_path: Path) -> None:
    """As it stands, with the versions that it names, from the disk in place of their addresses."""
    text = (PACKAGES.parents[1] / "docs/viewers.md").read_text(encoding="utf-8")
    (html,) = re.findall(r"(?ms)^```html\n(.*?)^```", text)
    first = camera(1)
    pose = {"rotation": first.world_to_camera[:3, :3], "translation": first.world_to_camera[:3, 3]}
    scene = transform_scene(wall(2, sh_degree=3), scale=1.0, **pose)  # as `--for web` places it
    write_scene(tmp_path / "walk.spz", scene, "spz")
    version = {name: json.loads((PACKAGES / name / "package.json").read_text())["version"] for name in PLACES}
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def answer(route: Any) -> None:
        url = route.request.url
        if url == ADDRESS:
            return route.fulfill(content_type="text/html", body=html)
        if url == f"{ADDRESS}walk.spz":
            return route.fulfill(path=tmp_path / "walk.spz")
        for name, (begin, folder) in PLACES.items():
            begin = begin.format(version[name])
            if url.startswith(begin):
                return route.fulfill(path=PACKAGES / name / folder / url.removeprefix(begin))
        complaints.append(f"asked for {url}")
        return route.abort()

    page.route("**/*", answer)
    page.goto(ADDRESS)
    side = SIZE[1] / 2 / np.tan(np.radians(30))
    ours = (
        Viewer(scene).view(Camera(*SIZE, side, side, SIZE[0] / 2, SIZE[1] / 2, np.eye(4))).astype(np.float64)
    )
    difference, limit = np.inf, 1.5 * DIFFERENCE  # measured: 11.4
    assert np.abs(ours[:, ::-1] - ours).mean() > 2 * limit
    for _ in range(60):
        page.wait_for_timeout(250)
        png = page.screenshot()
        theirs = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB).astype(np.float64)
        difference = np.abs(theirs - ours).mean()
        if complaints or difference < limit:
            break
    page.close()
    assert complaints == [] and difference < limit
