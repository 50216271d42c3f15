"""HTML pages from templates, with data that cannot end a script."""

from __future__ import annotations

import json
from importlib.resources import files
from shlex import quote
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from rich.filesize import decimal

import cleargs
from cleargs.manifest import plain_json
from cleargs.report.formatting import duration


def page_html(template: str | Template, **values: Any) -> bytes:
    """Render ``template``, or the template of the report with this name. The values are escaped."""
    return page_environment().get_template(template).render(version=cleargs.__version__, **values).encode()


def json_in_html(value: Any) -> Markup:
    """Return ``value`` as JSON without characters that could end its script element."""
    text = json.dumps(plain_json(value), ensure_ascii=True, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)


def page_environment() -> Environment:
    """Return the Jinja environment of the report's templates, with their filters and globals."""
    environment = Environment(
        loader=PackageLoader("cleargs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    static = files("cleargs.report").joinpath("static")
    environment.filters |= {"json": json_in_html, "duration": duration, "bytes": decimal, "shell": quote}
    environment.globals["static"] = lambda name: Markup(static.joinpath(name).read_text(encoding="utf-8"))
    return environment
