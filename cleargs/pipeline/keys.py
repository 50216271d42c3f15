"""The key of a stage: one digest of everything that decides its results, and of nothing else.

Not in a key: paths, host, time, number of threads, log level.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, cast

from pydantic import BaseModel

from cleargs.manifest import KeyParts
from cleargs.pipeline.settings import fields_of, flattened
from cleargs.pipeline.stage import Device, Stage
from cleargs.plugins import ExtensionPoint, installed_version, package_of, plugins

UPSTREAM = "of "
"""How the name of a table begins that holds the settings of another stage."""


def key_config(config: BaseModel) -> dict[str, Any]:
    """The settings that enter the key, as JSON values.

    A field declared with ``Field(..., json_schema_extra={"key": False})`` stays out. That is for settings
    that only name a file, whose content enters the key through the stage's ``externals``.
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
    """The settings that enter the key of the stage ``name``, those of other stages in tables of their own."""
    inherited = {f"{UPSTREAM}{other}": key_config(sections[other]) for other in stage.SETTINGS}
    return {**key_config(sections[name]), **inherited}


def library_versions(stage: Stage, device: Device) -> dict[str, str]:
    """What computes in ``stage`` on ``device``: name -> installed version."""
    versions = {name: installed_version(name) for name in stage.LIBRARIES}
    other = getattr(stage, "other_libraries", None)
    return versions if other is None else versions | other(device)


def plugin_versions(config: BaseModel) -> dict[str, str]:
    """What other packages bring to the settings: "DISTRIBUTION for SETTING=NAME" -> installed version.

    A field that may name such a part is declared with ``json_schema_extra={"plugin": SOCKET}``.
    """
    versions: dict[str, str] = {}
    for name, field, value in fields_of(config):
        extra = field.json_schema_extra
        if isinstance(extra, dict) and "plugin" in extra and value != field.default:
            found = plugins(cast(ExtensionPoint, extra["plugin"])).get(value)
            if found is not None:
                distribution, version = package_of(found)
                versions[f"{distribution} for {name}={value}"] = version
    return versions


def differences(
    old: KeyParts,
    new: KeyParts,
    old_files: Mapping[str, Mapping[str, str]],
    new_files: Mapping[str, Mapping[str, str]],
) -> list[str]:
    """What changed between two sets of parts, one readable line each; empty when the keys are equal.

    ``old_files`` and ``new_files`` map "STAGE/PATH" (inputs) or a role (externals) to the digests of the
    single files behind it, so that a change names the file.
    """
    lines = []
    if old.version != new.version:
        lines.append(f"stage version: {old.version} -> {new.version}")
    for name, before, after in _changes(dict(flattened(old.config)), dict(flattened(new.config))):
        own = name.removeprefix(UPSTREAM) if name.startswith(UPSTREAM) else f"{new.stage}.{name}"
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
    """Name, value before and value after of each entry that differs; "(none)" where it is not there."""
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


def _changed_files(old: Mapping[str, str], new: Mapping[str, str], limit: int = 3) -> str:
    """The first few changed files as ": a.png changed, b.png added"; " changed" for a single file."""
    names = [name for name, _, _ in _changes(old, new) if name]
    if not names:
        return " changed"
    words = {(True, True): "changed", (True, False): "removed", (False, True): "added"}
    shown = [f"{name} {words[name in old, name in new]}" for name in names[:limit]]
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ": " + ", ".join(shown) + more
