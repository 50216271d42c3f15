"""What the pages have in common: templates, and JSON for their scripts."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

import cleargs
from cleargs.manifest import plain_json
from cleargs.report.charts import weight_colour
from cleargs.report.report_json import PAGE


def write_page(folder: Path, template: str | Template, **values: Any) -> None:
    """Write ``index.html`` into ``folder`` from one of the templates; all text in ``values`` is escaped."""
    html = page_environment().get_template(template).render(version=cleargs.__version__, **values)
    (folder / PAGE).write_bytes(html.encode())


def json_in_html(value: Any) -> Markup:
    """``value`` as JSON that is inert inside a script element, whatever its strings hold."""
    text = json.dumps(plain_json(value), ensure_ascii=True, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)


def page_environment() -> Environment:
    """Return the templates of the report, with the filters and globals that they use."""
    environment = Environment(
        loader=PackageLoader("cleargs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["json"] = json_in_html
    environment.globals["static"] = _static
    environment.globals["weight_colour"] = weight_colour
    return environment


def _static(name: str) -> Markup:
    """A style sheet or script of ours, to stand in the page as it is."""
    return Markup(files("cleargs.report").joinpath("static", name).read_text(encoding="utf-8"))
