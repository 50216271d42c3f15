"""The key of a stage: one digest of everything that decides its results, and of nothing else.

Not in a key: paths, host, time, number of threads, log level.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal, cast

from pydantic import BaseModel

from cleargs.plugins import Socket, plugin
from cleargs.record import Record

SCHEMA = 1
"""Raised when the way keys are made changes: every old result becomes a miss."""

PRECISION = "float32"
"""Precision of the parameters that the stages train and publish."""


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces: equal values give equal text. NaN and infinities are refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


class KeyParts(Record):
    """What goes into the key of one stage."""

    stage: str
    version: int
    config: dict[str, Any]
    """The stage's own section, without the fields marked by `key_config` as outside the key."""
    inputs: dict[str, dict[str, str | None]]
    """Upstream stage -> declared path -> digest of its content; None where an optional path is absent."""
    externals: dict[str, str]
    """Role -> digest of the content of a file or folder outside the store."""
    seed: int
    device: Literal["cpu", "cuda"]
    libraries: dict[str, str]
    precision: str = PRECISION
    schema_version: int = SCHEMA

    @property
    def key(self) -> str:
        """sha256 of the canonical JSON, hexadecimal."""
        return hashlib.sha256(canonical_json(self.model_dump(mode="json")).encode()).hexdigest()


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


def library_versions(distributions: tuple[str, ...], device: Literal["cpu", "cuda"]) -> dict[str, str]:
    """What of each distribution computes on ``device``: its installed version; "absent" without one.

    ``triton`` compiles kernels for a GPU and counts there only. ``onnxruntime`` is what was installed under
    any of its names, with the provider that runs the networks.
    """
    versions = {}
    for name in distributions:
        if name == "onnxruntime":
            versions[name] = _onnxruntime(device)
        elif name != "triton" or device == "cuda":
            versions[name] = _version(name)
    return versions


def plugin_versions(config: BaseModel, prefix: str = "") -> dict[str, str]:
    """What other packages bring to the settings: "DISTRIBUTION for SETTING=NAME" -> installed version.

    A field that may name such a part is declared with ``json_schema_extra={"plugin": SOCKET}``.
    """
    versions: dict[str, str] = {}
    for name, field in type(config).model_fields.items():
        value, extra = getattr(config, name), field.json_schema_extra
        if isinstance(value, BaseModel):
            versions |= plugin_versions(value, f"{prefix}{name}.")
        elif isinstance(extra, dict) and "plugin" in extra and value != field.default:
            found = plugin(cast(Socket, extra["plugin"]), value)
            if found is not None:
                distribution, version = found.distribution
                versions[f"{distribution} for {prefix}{name}={value}"] = version
    return versions


ONNXRUNTIMES = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino")
"""Distributions that bring the module onnxruntime, each with providers of its own."""


def installed_onnxruntimes() -> list[str]:
    """Those that are installed, with their versions."""
    return [f"{name} {found}" for name in ONNXRUNTIMES if (found := _version(name)) != "absent"]


@cache
def _onnxruntime(device: Literal["cpu", "cuda"]) -> str:
    installed = installed_onnxruntimes()
    if device == "cuda":
        # Imported, as only a trial says whether the provider loads.
        from cleargs.models.onnx import network_device

        device = network_device(device, lambda warning: None)
    return ", ".join([*(installed or ["absent"]), f"on {device}"])


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "absent"


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
    old_settings, new_settings = dict(settings(old.config)), dict(settings(new.config))
    for name in sorted(old_settings.keys() | new_settings.keys()):
        before, after = old_settings.get(name, "(none)"), new_settings.get(name, "(none)")
        if before != after:
            lines.append(f"setting {new.stage}.{name}: {_show(before)} -> {_show(after)}")
    for where, before, after in (
        ("input", _input_digests(old), _input_digests(new)),
        ("external", old.externals, new.externals),
    ):
        for name in sorted(before.keys() | after.keys()):
            if before.get(name) != after.get(name):
                changed = _changed_files(old_files.get(name, {}), new_files.get(name, {}))
                lines.append(f"{where} {name}{changed}")
    for name in sorted(old.libraries.keys() | new.libraries.keys()):
        before, after = old.libraries.get(name, "(none)"), new.libraries.get(name, "(none)")
        if before != after:
            lines.append(f"library {name}: {before} -> {after}")
    for name in ("seed", "device", "precision", "schema_version"):
        if getattr(old, name) != getattr(new, name):
            lines.append(f"{name.replace('_', ' ')}: {getattr(old, name)} -> {getattr(new, name)}")
    return lines


def _input_digests(parts: KeyParts) -> dict[str, str | None]:
    return {
        f"{stage}/{path}": digest for stage, paths in parts.inputs.items() for path, digest in paths.items()
    }


def settings(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of each setting in nested tables."""
    for name, value in config.items():
        if isinstance(value, dict):
            yield from settings(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _show(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _changed_files(old: Mapping[str, str], new: Mapping[str, str], limit: int = 3) -> str:
    """The first few changed files as ": a.png changed, b.png added"; " changed" for a single file."""
    names = sorted(name for name in old.keys() | new.keys() if name and old.get(name) != new.get(name))
    if not names:
        return " changed"
    words = {(True, True): "changed", (True, False): "removed", (False, True): "added"}
    shown = [f"{name} {words[name in old, name in new]}" for name in names[:limit]]
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ": " + ", ".join(shown) + more
