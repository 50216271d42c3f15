"""ClearGS: clean 3D Gaussian Splatting scenes from handheld videos of mixed quality."""

from importlib import import_module

__version__ = "0.2.0"

# Modules are imported on first use, so that `import cleargs` is fast. __init__.pyi declares the types.
_HOMES = {
    "run": "api",
    **dict.fromkeys(("open_run", "Run", "StageResults", "open_prepared", "Prepared"), "run_results"),
    **dict.fromkeys(("initialise", "train", "render_view", "save", "load"), "api_scenes"),
    **dict.fromkeys(("export", "film"), "api"),
    **dict.fromkeys(("score_frames", "score", "restore", "deblur"), "api_images"),
    **dict.fromkeys(("evaluate_scene", "write_report"), "api"),
    "make_capture": "synth.synthetic_capture",
    "Camera": "splat.camera",
    "CleargsError": "errors",
    "G0Config": "scene.config",
    "Gaussians": "splat.gaussians",
    "Scene": "splat.scene",
    "TrainConfig": "splat.config",
    "TrainingView": "splat.views",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
