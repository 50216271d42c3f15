"""The examples of the folder ``examples`` and of the docstrings run on a tiny capture."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import runpy
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from plyfile import PlyData

import cleargs as cg
from cleargs.cli.main import invoke
from cleargs.errors import CleargsError
from cleargs.handover import gsplat_order
from cleargs.media.image import write_mask
from cleargs.progress import SilentReporter
from cleargs.synth.synthetic_capture import make_capture

EXAMPLES = Path(__file__).parents[1] / "examples"
NERFSTUDIO = EXAMPLES.parent / ".oracles/python"
COLOURS = ("red", "green", "blue")

TINY = """\
[g0]
steps = 30
min_points = 300
budget = 400

[rivr]
rounds = 1
distil.steps = 5

[consolidate]
distil.steps = 5
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a capture of eight frames, a recipe and a run."""
    folder = tmp_path_factory.mktemp("examples")
    make_capture(folder / "room", "mixed", frames=8, width=96, height=54, seed=0, reporter=SilentReporter())
    (folder / "tiny.toml").write_text(TINY)
    cg.run(folder / "room", folder / "run", recipe=str(folder / "tiny.toml"))
    return folder


def docstring_examples() -> dict[str, str]:
    """Name of a public function or method -> code of its section ``Example:``."""
    found = {}
    for name in cg.__all__:
        public = getattr(cg, name)
        methods = vars(public).values() if inspect.isclass(public) else ()
        for function in (public, *filter(inspect.isfunction, methods)):
            _, section, code = (inspect.getdoc(function) or "").partition("Example:\n")
            if section:
                found[function.__qualname__] = dedent(code)
    return found


DOCSTRING_EXAMPLES = docstring_examples()


def test_every_public_function_has_an_example() -> None:
    functions = {name for name in cg.__all__ if inspect.isfunction(getattr(cg, name))}
    assert functions and functions <= DOCSTRING_EXAMPLES.keys()


@pytest.mark.parametrize("name", DOCSTRING_EXAMPLES)
def test_examples_of_docstrings(name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    exec(DOCSTRING_EXAMPLES[name], {"cg": cg})


def example(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> str:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_run_and_read(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (place / "room", place / "run", place / "tiny.toml")
    out = example("run_and_read.py", monkeypatch, capsys, *arguments)
    assert "consolidate {" in out and "weight" in out and out.rstrip().endswith("Gaussians")


def test_train_a_scene(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = place / "own.ply"
    example("train_a_scene.py", monkeypatch, capsys, place / "run", made, 20)
    assert cg.load(made).gaussians.num >= 5000 and cg.load(made).gaussians.sh_degree == 1


def test_rate_frames(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = example("rate_frames.py", monkeypatch, capsys, place / "room" / "images", place / "best.png")
    assert out.count("reliability") == 8 and (place / "best.png").is_file()


def test_deblur_a_frame(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = example("deblur_a_frame.py", monkeypatch, capsys, place / "run", 3, place / "frame.png")
    assert ("explains" in out) != (place / "frame.png").is_file()


def test_evaluate_scenes(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (place / "run", place / "room" / "truth" / "observed")
    out = example("evaluate_scenes.py", monkeypatch, capsys, *arguments)
    assert [line.split()[0] for line in out.splitlines()] == ["g0", "rivr", "consolidate"]
    assert all("psnr" in line for line in out.splitlines())


def test_other_trainers_find_images_and_model_in_one_folder(place: Path, tmp_path: Path) -> None:
    """Read it as gsplat does (pycolmap, ``sparse/0`` next to ``images``), and as nerfstudio does."""
    capture = cg.open_prepared(cg.open_run(place / "run")["ingest"])
    folder = capture.to_nerfstudio(tmp_path / "data")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    names = {image.name for image in model.images.values()}
    assert names == {path.name for path in (folder / "images").iterdir()} and len(names) == 8
    assert len(model.points3D) == len(capture.points.xyz)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    placed = {image.name: image.cam_from_world().inverse().matrix() for image in model.images.values()}
    for frame in frames:
        pose = np.array(frame["transform_matrix"]) * [1, -1, -1, 1]  # from OpenGL axes
        assert np.allclose(pose[:3], placed[Path(frame["file_path"]).name], atol=1e-9)
        assert (folder / frame["file_path"]).is_file() and (frame["w"], frame["h"]) == (96, 54)
    with pytest.raises(CleargsError):
        capture.to_nerfstudio(folder)


def test_other_trainers_hold_out_the_same_frames(place: Path, tmp_path: Path) -> None:
    """By the rules of nerfstudio 1.1.5 (lists of names) and of gsplat (every Nth by name)."""
    capture = cg.open_prepared(cg.open_run(place / "run")["ingest"])
    frames = [replace(f, split="test" if f.frame_id in (1, 6) else "train") for f in capture.frames]
    weights = {frame.frame_id: 0.5 for frame in frames[1:]}
    held = replace(capture, frames=frames).to_nerfstudio(tmp_path / "data", weights)
    meta, facts = (json.loads((held / name).read_text()) for name in ("transforms.json", "split.json"))
    files = {facts["names"][file] for file in meta["test_filenames"]}
    assert files == {capture.frames[k].name for k in (1, 6)}
    assert meta["val_filenames"] == meta["test_filenames"]
    assert len(meta["train_filenames"]) == 5, "frame 0 has no weight"
    listed = {*meta["train_filenames"], *meta["test_filenames"]}
    assert {frame["file_path"] for frame in meta["frames"]} == listed
    vertices = PlyData.read(held / meta["ply_file_path"])["vertex"]
    assert np.allclose(vertices["x"], capture.points.xyz[:, 0])
    assert (vertices["red"] == capture.points.rgb[:, 0]).all()
    model = pycolmap.Reconstruction(str(held / "sparse/0"))
    names = sorted(image.name for image in model.images.values())
    assert {f"images/{name}" for name in names[:: facts["test_every"]]} == set(meta["test_filenames"])
    assert not facts["not_in_sparse"] and len(model.points3D) == len(capture.points.xyz)


@pytest.mark.skipif(
    not (NERFSTUDIO / "nerfstudio").is_dir(), reason="nerfstudio's parser is not installed (make oracles)"
)
def test_nerfstudios_own_parser_finds_the_same_capture(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The split, the cameras, the masks and the first points, as `ns-train splatfacto` gets them."""
    monkeypatch.syspath_prepend(NERFSTUDIO)
    shutil.copytree(place / "run", tmp_path / "run", symlinks=True)
    capture = cg.open_prepared(tmp_path / "run" / "ingest")
    write_mask(capture.folder / "dust.png", np.arange(96 * 54).reshape(54, 96) % 5 > 0)
    frames = [
        replace(
            f, split="test" if f.frame_id in (1, 6) else "train", mask="dust.png" if not f.frame_id else ""
        )
        for f in capture.frames
    ]
    data = replace(capture, frames=frames).to_nerfstudio(tmp_path / "data")

    def read(path: str) -> SimpleNamespace:  # in place of Open3D, which is large
        vertex = PlyData.read(path)["vertex"]
        points = np.column_stack([vertex[name] for name in "xyz"])
        return SimpleNamespace(points=points, colors=np.column_stack([vertex[c] for c in COLOURS]) / 255)

    monkeypatch.setitem(sys.modules, "open3d", SimpleNamespace(io=SimpleNamespace(read_point_cloud=read)))
    module = importlib.import_module("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    parser = module.NerfstudioDataParserConfig(data=data, load_3D_points=True).setup()
    for split, numbers in {"train": [0, 2, 3, 4, 5, 7], "val": [1, 6], "test": [1, 6]}.items():
        found = parser.get_dataparser_outputs(split)
        names = {path.name for path in found.image_filenames}
        facts = json.loads((data / "split.json").read_text())["names"]
        assert {facts[f"images/{name}"] for name in names} == {capture.frames[k].name for k in numbers}
        assert all(path.is_file() for path in [*found.image_filenames, *found.mask_filenames])
        assert len(found.cameras) == len(numbers) and float(found.cameras.fx[0]) == pytest.approx(
            capture.cameras()[0].fx
        )
        assert len(found.metadata["points3D_xyz"]) == len(capture.points.xyz)
        assert (found.metadata["points3D_rgb"].numpy() == capture.points.rgb).mean() > 0.9  # it rounds down


def test_frames_repeat_by_their_weights_for_trainers_that_know_none(place: Path, tmp_path: Path) -> None:
    capture = cg.open_prepared(cg.open_run(place / "run")["ingest"])
    frames = [replace(f, split="test" if f.frame_id == 2 else "train") for f in capture.frames]
    weights = {frame.frame_id: 0.25 * (frame.frame_id % 4 + 1) for frame in frames}
    made = replace(capture, frames=frames).to_nerfstudio(tmp_path / "data", weights, repeat=4)
    meta, facts = (json.loads((made / name).read_text()) for name in ("transforms.json", "split.json"))
    times = [list(facts["names"].values()).count(frame.name) for frame in frames]
    assert times == [1, 2, 1, 4, 1, 2, 3, 4], "a held-out frame is not repeated"
    assert len(meta["train_filenames"]) == 17 and len(meta["test_filenames"]) == 1
    model = pycolmap.Reconstruction(str(made / "sparse/0"))
    names = sorted(image.name for image in model.images.values())
    assert names == sorted(path.name for path in (made / "images").iterdir()) and len(names) == 18
    assert [f"images/{name}" for name in names[:: facts["test_every"]]] == meta["test_filenames"]
    poses = {entry["file_path"]: entry["transform_matrix"] for entry in meta["frames"]}
    same = [file for file, name in facts["names"].items() if name == frames[3].name]
    assert all(poses[file] == poses[same[0]] for file in same)


def test_frames_can_be_deblurred_for_other_trainers(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, made = place / "run", [str(tmp_path / "a"), str(tmp_path / "b")]
    assert invoke(["export", str(run), "--capture", made[0]]) == 0
    assert invoke(["export", str(run), "--capture", made[1], "--deblurred", "--repeat", "2"]) == 0
    facts = json.loads(Path(made[1], "split.json").read_text())
    deblurred = [name for name in facts["names"] if not name.endswith("-2.png")]
    found = {name: cg.deblur(cg.open_run(run), k) for k, name in enumerate(deblurred)}
    changed = [Path(made[0], name).read_bytes() != Path(made[1], name).read_bytes() for name in deblurred]
    assert changed == [image is not None for image in found.values()]
    assert invoke(["export", str(run), "-o", str(tmp_path / "x.ply"), "--deblurred"]) == 2
    assert "--capture" in capsys.readouterr().err


def test_options_of_a_scene_are_refused_for_a_capture(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They had no effect, without a word. A folder that exists was called a fault of the disk."""
    words = ["export", str(place / "run"), "--capture", str(tmp_path / "data"), "--metres", "0-1=2", "--up=y"]
    assert invoke(words) == 2 and "leave out --up, --metres" in capsys.readouterr().err
    (tmp_path / "data").mkdir()
    assert invoke(words[:4]) == 2 and "data exists already" in capsys.readouterr().err


@pytest.mark.parametrize("held", ["10000000" * 4, "0100100", "0111000000", "1010101011", "000"])
def test_every_nth_image_is_one_that_was_held_out(held: str, place: Path) -> None:
    some = cg.open_prepared(cg.open_run(place / "run")["ingest"]).frames[0]
    frames = [replace(some, frame_id=k, split="test" if x == "1" else "train") for k, x in enumerate(held)]
    every, order, extra = gsplat_order(frames)
    assert sorted(f.frame_id for f in order + extra) == list(range(len(held)))
    if "1" not in held or held.count("1") > held.count("0"):
        assert every is None
    else:
        assert every is not None
        assert all((f.split == "test") == (k % every == 0) for k, f in enumerate(order))
        assert len(extra) <= held.count("1") // 2 and all(f.split == "test" for f in extra)
    if held.startswith("1000"):
        assert every == 8 and order == frames


@pytest.fixture
def lichtfeld(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The parts of LichtFeld Studio's module that its page "Plugin Developer Guide" describes."""
    loaded: list[tuple[str, bool]] = []
    module = SimpleNamespace(
        classes=[],
        loaded=loaded,
        ui=SimpleNamespace(Panel=object, PanelSpace=SimpleNamespace(MAIN_PANEL_TAB=3)),
        log=SimpleNamespace(info=lambda text: None),
        load_file=lambda path, is_dataset=False: loaded.append((path, is_dataset)),
    )
    module.register_class, module.unregister_class = module.classes.append, module.classes.remove
    monkeypatch.setitem(sys.modules, "lichtfeld", module)  # type: ignore[arg-type]
    monkeypatch.syspath_prepend(EXAMPLES / "lichtfeld")
    return module


class DrawnPanel:
    """LichtFeld's ``ui``, with a user who types a path and presses the button ``pressed``."""

    def __init__(self, source: Path | str, pressed: str = "") -> None:
        self.source, self.pressed, self.texts = str(source), pressed, list[str]()

    def input_text(self, label: str, value: str) -> tuple[bool, str]:
        return False, str(Path(sys.executable).with_name("cleargs"))

    def path_input(self, label: str, value: str, folder_mode: bool = True) -> tuple[bool, str]:
        return True, self.source

    def slider_int(self, label: str, value: int, low: int, high: int) -> tuple[bool, int]:
        return True, 2

    def checkbox(self, label: str, value: bool) -> tuple[bool, bool]:
        return False, value

    def button(self, label: str) -> bool:
        return label == self.pressed

    def button_styled(self, label: str, style: str) -> bool:
        return label == self.pressed

    def text_wrapped(self, text: str) -> None:
        self.texts.append(text)

    text_disabled = text_wrapped


def test_the_plugin_of_lichtfeld_opens_the_frames_of_a_run(
    place: Path, tmp_path: Path, lichtfeld: SimpleNamespace
) -> None:
    """With a stand-in for LichtFeld's module, since the program needs an NVIDIA GPU."""
    plugin = importlib.import_module("cleargs_frames")
    manifest = tomllib.loads((EXAMPLES / "lichtfeld/cleargs_frames/pyproject.toml").read_text())
    assert {"name", "version", "description"} <= manifest["project"].keys()
    required = {"hot_reload", "plugin_api", "lichtfeld_version", "required_features"}
    assert manifest["tool"]["lichtfeld"].keys() == required
    plugin.on_load()
    panel = lichtfeld.classes[0]()
    shutil.copytree(place / "run", tmp_path / "run", symlinks=True)
    panel.draw(DrawnPanel(tmp_path / "run", "Prepare and open"))
    panel._job.join()
    panel.draw(DrawnPanel(tmp_path / "run"))
    data = tmp_path / "run-data"
    assert lichtfeld.loaded == [(str(data), True)]
    assert (data / "sparse/0/images.bin").is_file() and len(list((data / "images").iterdir())) > 8
    panel.draw(ui := DrawnPanel(tmp_path / "nothing.mp4", "Prepare and open"))
    panel._job.join()
    panel.draw(ui := DrawnPanel(tmp_path / "nothing.mp4"))
    assert any("nothing.mp4" in text and "hint:" in text for text in ui.texts)
    plugin.on_unload()
    assert lichtfeld.classes == []


def test_a_capture_as_a_dataset(place: Path) -> None:
    run = cg.open_run(place / "run")
    capture = cg.open_prepared(run["ingest"])
    loader = torch.utils.data.DataLoader(capture.dataset(run["rva"].weights()), batch_size=2)
    batch = next(iter(loader))
    assert batch["image"].shape == (2, 3, 54, 96) and batch["image"].dtype == torch.float32
    assert 0.0 <= float(batch["image"].min()) < float(batch["image"].max()) <= 1.0
    assert batch["mask"].all() and 0 < float(batch["weight"].min()) <= 1
    camera = capture.cameras()[int(batch["frame_id"][0])]
    assert np.allclose(batch["camera_to_world"][0, :3, 3], camera.centre, atol=1e-6)


def test_a_scene_to_gsplat_and_back(place: Path) -> None:
    scene = cg.open_run(place / "run").scene()
    arguments = scene.to_gsplat()
    assert float(arguments["scales"].min()) > 0 and 0 < float(arguments["opacities"].max()) < 1
    camera = next(iter(cg.open_prepared(cg.open_run(place / "run")["ingest"]).cameras().values()))
    images = [cg.render_view(one, camera).image for one in (scene, cg.Scene.from_gsplat(**arguments))]
    assert torch.allclose(*images, atol=1e-4) and float(images[0].max()) > 0.2


def test_objects_are_short_in_a_notebook(place: Path) -> None:
    run = cg.open_run(place / "run")
    capture, scene = cg.open_prepared(run["ingest"]), run.scene()
    for found in (run, run["rva"], capture, scene, scene.gaussians):
        assert len(repr(found)) < 300 and "tensor(" not in repr(found)
    assert run._repr_html_().count("<tr>") == 6


def test_the_notebook(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run all cells in order, without Jupyter."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = json.loads((EXAMPLES / "walkthrough.ipynb").read_text())
    code = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    exec(code[0], names)
    names.update(CAPTURE=place / "room", RUN=place / "run", RECIPE=str(place / "tiny.toml"))
    for cell in code[1:]:
        exec(cell, names)
    assert isinstance(names["scene"], cg.Scene)


def test_the_examples_of_the_pages(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of docs/api.md are the docstrings'. Pages call the run of a user `walk`."""
    monkeypatch.chdir(place)
    (place / "walk").symlink_to("run")
    pages = [page for page in (EXAMPLES.parent / "docs").glob("*.md") if page.name != "api.md"]
    codes = [code for page in pages for code in re.findall(r"(?ms)^```python\n(.*?)^```", page.read_text())]
    assert codes
    for code in codes:
        exec(code, {})
