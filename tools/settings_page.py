"""Write the page docs/settings.md from the models of the settings: ``python -m tools.settings_page``."""

from __future__ import annotations

from cleargs.pipeline.dag import installed
from cleargs.pipeline.settings import settings_of

INTRODUCTION = """\
# Settings

All settings of the five stages, as in `cleargs settings`. Change one with
`cleargs run INPUT -o RUN --set g0.steps=4000`, or several in a TOML file with `--recipe FILE.toml`. The
settings of a run are stored in `RUN/run.toml` and apply until you change them. `seed` (default 0) is global.

This page is made from the source: `python -m tools.settings_page > docs/settings.md`.
"""


def page() -> str:
    """Return the page, with a table for each stage."""
    dag = installed()
    lines = [INTRODUCTION]
    for stage in dag.names:
        lines += [f"## {stage}", "", "| setting | default | range | meaning |", "|---|---|---|---|"]
        for setting in settings_of(stage, dag.load(stage).CONFIG):
            cells = (f"`{setting.name}`", f"`{setting.default_text}`", setting.allowed, setting.meaning)
            lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(page(), end="")
