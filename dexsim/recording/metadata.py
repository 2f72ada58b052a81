"""What is known about a recording: from its own metadata record, a file beside it, the command line, or a default."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import yaml

from dexsim import files, typed, yaml_text
from dexsim.actuator.columns import did_you_mean
from dexsim.errors import UserError
from dexsim.recording.schema import (
    DEFAULTS,
    EFFORT_IS,
    KEYS,
    METADATA,
    TACTILE_UNIT,
    UNIT_KEYS,
    Finding,
    brief,
    note,
    numbers,
)
from dexsim.recording.units import split

VALID = (*KEYS, *UNIT_KEYS)
WORDS = {"effort_is": EFFORT_IS, "tactile_unit": TACTILE_UNIT, "schema": ("1",), "source": ("real", "sim")}
WORDS |= {key: tuple(units) for key, units in UNIT_KEYS.items()}
Stated = msgspec.defstruct("Stated", [(key, Literal[WORDS[key]] if key in WORDS else str, "") for key in VALID])
"""What is stated about a recording, as text by key."""
Written = dict[str, str | bool | float | dict[str, Any] | list[Any] | None]
"""A file of metadata beside a recording: plain values, lists of such, and a servo.yaml under `servo`."""


def collect(
    path: Path, own: Mapping[str, str], given: Mapping[str, Any], units: Mapping[str, str] = MappingProxyType({})
) -> tuple[dict[str, str], dict[str, str], list[Finding]]:
    """Return stated metadata (no defaults yet) and units: `given` and `units` win over the file beside the recording,
    that over its own record.

    Each key that one source overrides in another is a finding. Raises UserError for unknown keys or a bad file.
    """
    beside_path = path.with_name(path.name + ".yaml")
    # not Path's, which raises where a recording's name leaves no room for the ending
    beside = _read(beside_path) if os.path.isfile(beside_path) else {}
    beside, beside_units = split(beside)
    stated = {k: str(v) for k, v in own.items() if k in VALID}
    unknown = [f"metadata key '{k}' is not one of this format's; ignored" for k in own if k not in VALID]
    findings = [note("metadata_unknown", text, "info") for text in unknown]
    for source, values in ((str(beside_path), beside), ("meta.*", given)):
        for key, value in values.items():
            if key not in VALID:
                raise UserError(
                    f"{source}: metadata key '{key}' does not exist.{did_you_mean(key, VALID)}"
                    f" Valid: {', '.join(VALID)}"
                )
            text = _text(value)
            if stated.get(key, text) != text:
                said = f"{key}: '{brief(stated[key])}' as recorded, '{brief(text)}' by {source}; the latter is used"
                findings.append(note("metadata_override", said, "info"))
            stated[key] = text
    _check(path, stated)
    old = {key.removesuffix("_unit"): stated.pop(key) for key in UNIT_KEYS if key in stated}
    return stated, old | beside_units | dict(units), findings


def complete(stated: dict[str, str], has_effort: bool, has_tactile: bool) -> list[Finding]:
    """Fill in the defaults (in place); one finding for each key that matters and was not stated."""
    usual = {"effort_is": "torque_Nm" if has_effort else "none"} | DEFAULTS
    missing = {key: value for key, value in usual.items() if key not in stated}
    stated |= missing
    matter = ["gravity", *("effort_is", "effort_sign") * has_effort]
    matter += ["tactile_unit", "tactile_lsb", "tactile_axis_sign"] * has_tactile
    return [
        note("missing_metadata", f"{key} is not stated; '{value}' is assumed (state it with meta.{key}=...)",
             "warning" if key in matter else "info")
        for key, value in missing.items() if key not in ("servo", "notes")
    ]  # fmt: skip


def own_record(records: list[Any]) -> dict[str, str]:
    """Return the `dexsim` record among an MCAP file's metadata records; {} where there is none."""
    return next((dict(r.metadata) for r in records if r.name == METADATA), {})


def _read(path: Path) -> dict[str, Any]:
    raw = yaml_text.parse(files.text(path, "metadata"), path)
    if raw is None:
        return {}
    return typed.convert(raw, Written, path, f"it must map metadata keys to values; valid keys: {', '.join(VALID)}")


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return yaml.safe_dump(value, sort_keys=False)
    if isinstance(value, (list, tuple)):
        return ",".join(str(v) for v in value)
    return str(value)


def _check(path: Path, stated: Mapping[str, str]) -> None:
    typed.convert(dict(stated), Stated, f"{path}: metadata", "correct it with meta.KEY=...")
    for key, count in (("gravity", 3), ("tactile_axis_sign", 3), ("tactile_lsb", 1)):
        if key in stated and stated[key] != "unknown":
            numbers(stated[key], count, key, str(path))
    if stated.get("servo"):
        if not isinstance(yaml_text.parse(stated["servo"], f"{path}: metadata servo"), dict):
            raise UserError(f"{path}: metadata servo must map keys of servo.yaml to values")
