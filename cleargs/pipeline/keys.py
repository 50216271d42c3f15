"""The key of a stage: a digest of everything that decides its results, and of nothing else.

Not in a key: paths, host, time, number of threads, log level.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, cast

from pydantic import BaseModel

from cleargs.errors import listed
from cleargs.manifest import KeyParts
from cleargs.pipeline.settings import fields_of, flattened
from cleargs.pipeline.stage import Stage
from cleargs.plugins import ExtensionPoint, installed_version, package_of, plugins
from cleargs.types import Device

UPSTREAM_PREFIX = "of "
"""Prefix of a table in the key that holds the settings of another stage."""


def key_config(config: BaseModel) -> dict[str, Any]:
    """Return the settings that are part of the key, as JSON values.

    A field with ``json_schema_extra={"key": False}`` is left out. Such a setting only names a file, whose
    content is part of the key through the stage's ``externals``.
    """
    kept: dict[str, Any] = {}
    plain = config.model_dump(mode="json")
    for name, field in type(config).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("key") is False:
            continue
        value = getattr(config, name)
        kept[name] = key_config(value) if isinstance(value, BaseModel) else plain[name]
    return kept


def stage_key_config(stage: Stage, name: str, sections: Mapping[str, BaseModel]) -> dict[str, Any]:
    """Return the settings in the key of the stage ``name``, with one table per stage in `Stage.SETTINGS`."""
    inherited = {f"{UPSTREAM_PREFIX}{other}": key_config(sections[other]) for other in stage.SETTINGS}
    return {**key_config(sections[name]), **inherited}


def library_versions(stage: Stage, device: Device, config: BaseModel) -> dict[str, str]:
    """Return name -> installed version of the libraries that affect results of ``stage`` on ``device``."""
    versions = {name: installed_version(name) for name in stage.LIBRARIES}
    other = getattr(stage, "other_libraries", None)
    return versions if other is None else versions | other(device, config)


def plugin_versions(config: BaseModel) -> dict[str, str]:
    """Return "DISTRIBUTION for SETTING=NAME" -> installed version, for each plugin that the settings name.

    A field that may name a plugin is declared with ``json_schema_extra={"plugin": EXTENSION_POINT}``.
    """
    versions: dict[str, str] = {}
    for name, field, value in fields_of(config):
        extra = field.json_schema_extra
        if isinstance(extra, dict) and "plugin" in extra and value != field.default:
            external = plugins(cast(ExtensionPoint, extra["plugin"]))
            for part in value if isinstance(value, tuple) else (value,):
                if part in external:
                    distribution, version = package_of(external[part])
                    versions[f"{distribution} for {name}={part}"] = version
    return versions


def differences(
    old: KeyParts,
    new: KeyParts,
    old_files: Mapping[str, Mapping[str, str]],
    new_files: Mapping[str, Mapping[str, str]],
) -> list[str]:
    """Return one readable line per difference between two keys.

    ``old_files`` and ``new_files`` are "STAGE/PATH" (an input) or role (an external) -> file -> digest, so
    that a line can name the files that changed.
    """
    lines = []
    if old.version != new.version:
        lines.append(f"stage version: {old.version} -> {new.version}")
    for name, before, after in _changes(dict(flattened(old.config)), dict(flattened(new.config))):
        own = f"{new.stage}.{name}".removeprefix(f"{new.stage}.{UPSTREAM_PREFIX}")
        lines.append(f"setting {own}: {_show(before)} -> {_show(after)}")
    inputs = [("input", name) for name, _, _ in _changes(_input_digests(old), _input_digests(new))]
    externals = [("external", name) for name, _, _ in _changes(old.externals, new.externals)]
    for where, name in inputs + externals:
        lines.append(f"{where} {name}{_changed_files(old_files.get(name, {}), new_files.get(name, {}))}")
    for name, before, after in _changes(old.libraries, new.libraries):
        lines.append(f"library {name}: {before} -> {after}")
    for name in ("seed", "device", "precision", "schema_version"):
        if getattr(old, name) != getattr(new, name):
            lines.append(f"{name.replace('_', ' ')}: {getattr(old, name)} -> {getattr(new, name)}")
    return lines


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, old value and new value of each entry that differs; "(none)" replaces a missing value."""
    for name in sorted(old.keys() | new.keys()):
        before, after = old.get(name, "(none)"), new.get(name, "(none)")
        if before != after:
            yield name, before, after


def _input_digests(parts: KeyParts) -> dict[str, str]:
    return {
        f"{stage}/{path}": digest
        for stage, paths in parts.inputs.items()
        for path, digest in paths.items()
        if digest is not None
    }


def _show(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _changed_files(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Return the first few changed files as ": a.png changed, b.png added"; " changed" for a single file."""
    names = [name for name, _, _ in _changes(old, new) if name]
    if not names:
        return " changed"
    words = {(True, True): "changed", (True, False): "removed", (False, True): "added"}
    return ": " + listed([f"{name} {words[name in old, name in new]}" for name in names])
