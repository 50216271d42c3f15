"""Write the page docs/settings.md from the models of the settings: ``python -m tools.settings_page``."""

from __future__ import annotations

from cleargs.pipeline.settings import settings_of
from cleargs.pipeline.stages import installed

INTRODUCTION = """\
# Settings

Change a setting with `cleargs run INPUT -o RUN --set g0.steps=4000`, or several in a TOML file with
`--recipe FILE.toml`. The settings of a run are stored in `RUN/run.toml` and apply until you change them.

This page is made from the source: `python -m tools.settings_page > docs/settings.md`.

## The twelve that matter first
"""

FIRST = {
    "ingest.max_frames": "more frames for a long walk, fewer for a quick run; also `--max-frames`",
    "ingest.max_size": "larger images for more detail; also `--size`",
    "ingest.fps": "a fixed number of frames per second of a video",
    "ingest.holdout": "frames kept from the training, to measure quality with `cleargs eval`; `--holdout`",
    "ingest.poses": "`sfm` if the poses of the input are wrong",
    "ingest.camera_model": "`OPENCV_FISHEYE` for a fisheye lens",
    "g0.steps": "a longer training; also `--steps`, or `--quality` for all that goes with it",
    "g0.budget": "more Gaussians for more detail, fewer for a small file",
    "g0.exposure": "`on` if the brightness of the video changes",
    "rva.tau_R": "lower if too few frames are trusted, higher if blurred ones are",
    "g0.formation.movement": "`on` if something moves and the default does not leave it out",
    "rivr.expert": "another network for repairs",
}
"""Setting -> reason to change it, for the table at the top."""

ALL = """\
## All settings

These are all settings of the five stages, as in `cleargs settings`. `seed` (default 0) is global.
"""


def page() -> str:
    """Return the page: the settings that matter first, then a table for each stage."""
    dag = installed()
    settings = {stage: settings_of(stage, dag.load(stage).CONFIG) for stage in dag.names}
    defaults = {setting.name: setting.default_text for found in settings.values() for setting in found}
    lines = [INTRODUCTION, "| setting | default | change it for |", "|---|---|---|"]
    lines += [f"| `{name}` | `{defaults[name]}` | {reason} |" for name, reason in FIRST.items()]
    lines += ["", ALL]
    for stage, found in settings.items():
        lines += [f"### {stage}", "", "| setting | default | range | meaning |", "|---|---|---|---|"]
        for setting in found:
            cells = (f"`{setting.name}`", f"`{setting.default_text}`", setting.allowed, setting.meaning)
            lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(page(), end="")
