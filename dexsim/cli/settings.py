"""Settings of a run: Hydra's groups and files, then the user's overrides, with names and types checked here.

Hydra composes the group files (``task=grasp servo=ideal``) and parses the command line; the overrides themselves
(``worlds=64 agent.algorithm.learning_rate=1e-3``) are applied by :func:`override`, because they must work the same on
a config from the files and on one out of a checkpoint, and because a wrong name must be answered with the valid ones.
"""

from __future__ import annotations

import copy
import difflib
import functools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from dexsim import door
from dexsim.errors import UserError
from dexsim.tasks import registry
from dexsim.typed import finite

TERMS = ("observations", "terminations", "commands", "events")
"""Parts of a task's settings that its declared terms have."""
WORDS = ("auto", "unknown", "inf", "null")  # strings that a number's place may hold


@dataclass
class Request:
    """A command line taken apart: group choices (``task=grasp``) and value overrides (``worlds=64``), in order."""

    choices: dict[str, str] = field(default_factory=dict)
    values: list[Override] = field(default_factory=list)


def groups(config_dir: Path) -> dict[str, list[str]]:
    """Return the config groups and their options: the folders under ``dexsim/configs/`` and the YAML files in them."""
    found = {d.name: sorted(f.stem for f in d.glob("*.yaml")) for d in sorted(config_dir.iterdir()) if d.is_dir()}
    return {name: options for name, options in found.items() if options}


def parse(argv: list[str], config_dir: Path) -> Request:
    """Take a command line apart. Raises UserError for text that is no ``key=value`` and for an unknown group option."""
    request, known, parser = Request(), groups(config_dir), OverridesParser.create()
    for text in argv:
        if text.startswith("-"):
            plain = text.lstrip("-")
            hint = f"write {plain}" if "=" in plain else "settings are written key=value, without dashes"
            raise UserError(f"unknown option {text!r}: {hint} (--help lists them)")
        if "=" not in text and not text.startswith("~"):
            raise UserError(f"{text!r} is not a setting: write it as key=value (--help lists them)")
        try:
            item = parser.parse_override(text)
        except HydraException as error:
            key, _, value = text.partition("=")
            a_list = value[:1] == "[" and value[-1:] == "]"
            plain = value[1:-1] if a_list else value
            try:  # paths with spaces, umlauts or brackets are what was typed
                quoted = ",".join(f"'{_escaped(x)}'" for x in (plain.split(",") if a_list else [plain]))
                as_typed = f"{key}=[{quoted}]" if a_list else f"{key}={quoted}"
                item = parser.parse_override(text if plain[:1] in tuple("[{(\"'$") else as_typed)
            except HydraException:
                said = " ".join(str(error).split())[:200]
                raise UserError(f"cannot read {text!r}: {said}; lists are written [a,b], text 'a b'") from None
        if item.is_sweep_override():
            raise UserError(
                f"{text!r} gives several values: one run takes one value for each setting (--multirun runs them all)"
            )
        if item.key_or_group in known and item.type == OverrideType.CHANGE:
            request.choices[item.key_or_group] = _option(item, known[item.key_or_group])
        else:
            request.values.append(item)
    return request


def _escaped(text: str) -> str:
    """Return a text as it stands between single quotes."""
    return text.strip().replace("\\", "\\\\").replace("'", "\\'")


def _option(item: Override, options: list[str]) -> str:
    group, name = item.key_or_group, str(item.value())
    if name in options:
        return name
    if group == "task":
        registry.find(name)  # of an installed package, or a class; raises UserError for no task
        return name
    if name.endswith((".yaml", ".yml")) and group == "servo":
        raise UserError(f"servo={name}: a file of your own is given as servo_file={name}")
    raise UserError(f"{group}={name}: no such option; {group} can be {', '.join(options)}{_guess(name, options)}")


def from_files(config_dir: Path, choices: dict[str, str]) -> DictConfig:
    """Compose ``dexsim/configs/config.yaml`` with these group choices; ``choices`` in the result records all of
    them."""
    found = [(str(f), f.stat()) for f in sorted(config_dir.rglob("*.yaml")) if f.is_file()]
    stamps = tuple((name, s.st_mtime_ns, s.st_size) for name, s in found)
    own = choices.get("task")
    if own is None or own in groups(config_dir).get("task", ()):
        return copy.deepcopy(_composed(config_dir, tuple(choices.items()), stamps))
    made = registry.load(registry.find(own)).config()
    others = [(k, v) for k, v in choices.items() if k != "task"]
    cfg = copy.deepcopy(_composed(config_dir, (("~task", ""), *others), stamps))
    OmegaConf.set_struct(cfg, False)
    for group, values in made.items():
        if group == "task" or group not in choices:
            cfg[group] = values
    cfg.choices["task"] = made["task"]["name"]
    OmegaConf.set_struct(cfg, True)
    return cfg


@functools.lru_cache(maxsize=16)
def _composed(config_dir: Path, choices: tuple[tuple[str, str], ...], stamps: tuple) -> DictConfig:
    """Return what files of these stamps give: reading them takes some tenths of a second, and who trains or plays
    several times in one process chooses the same again."""
    overrides = [group if group.startswith("~") else f"{group}={option}" for group, option in choices]
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=str(config_dir.resolve())):
            cfg = compose("config", overrides=overrides, return_hydra_config=True)
            chosen = {k: v for k, v in cfg.hydra.runtime.choices.items() if "/" not in k}
    except (HydraException, OmegaConfBaseException, yaml.YAMLError) as error:
        raise UserError(f"config files in {config_dir}: {_first_line(error)}") from None
    OmegaConf.set_struct(cfg, False)
    del cfg["hydra"]
    cfg["choices"] = chosen
    OmegaConf.set_struct(cfg, True)
    return cfg


def choose(cfg: DictConfig, config_dir: Path, choices: dict[str, str]) -> DictConfig:
    """Exchange whole groups of a config that came out of a checkpoint for options of the config files."""
    task = choices.get("task", "")
    if door.is_named(task) and OmegaConf.select(cfg, "task.class") == task:
        choices = {k: v for k, v in choices.items() if k != "task"}  # said only so that it may be imported
    if not choices:
        return cfg
    fresh = from_files(config_dir, choices)
    OmegaConf.set_struct(cfg, False)
    for group in choices:
        cfg[group] = fresh[group]
        cfg.setdefault("choices", {})[group] = fresh.choices[group]
    OmegaConf.set_struct(cfg, True)
    return cfg


def override(cfg: DictConfig, items: list[Override]) -> DictConfig:
    """Apply value overrides in place. Raises UserError naming the valid settings for an unknown one.

    ``key=value`` needs the key to exist; ``+key=value`` adds one; ``~key`` removes one.
    """
    for item in items:
        key = item.key_or_group
        if key.partition(".")[0] == "choices":
            raise UserError(f"{key}: a record of the groups chosen; choose one with task=..., servo=... (--help)")
        if item.type == OverrideType.DEL:
            _parent(cfg, key)  # raises when it is not there
            owner, _, last = key.rpartition(".")
            if not owner:
                raise UserError(f"~{key}: every run has this setting; give it a value, {key}=...")
            node = OmegaConf.select(cfg, owner) if owner else cfg
            OmegaConf.set_struct(node, False)
            node.pop(last)
            continue
        value = item.value()
        finite(value, key)
        if item.type == OverrideType.CHANGE and not _there(cfg, key) and (usual := _of_term(cfg, key)) is not None:
            _check_type(key, usual, value)
            OmegaConf.update(cfg, key, value, merge=False, force_add=True)
            continue
        if item.type != OverrideType.CHANGE and isinstance(group := cfg.get(key), DictConfig):
            raise UserError(
                f"+{key}: is there already, a group of settings ({', '.join(f'{key}.{k!s}' for k in group)}): give"
                " those one by one, or choose another group without the +"
            )
        if item.type == OverrideType.CHANGE or _there(cfg, key):
            try:
                _check_type(key, OmegaConf.select(_parent(cfg, key), key.rpartition(".")[2]), value)
            except InterpolationResolutionError as error:
                raise UserError(f"{key}={value}: {_first_line(error)}") from None
        try:
            OmegaConf.update(cfg, key, value, merge=False, force_add=item.type != OverrideType.CHANGE)
        except (ValueError, TypeError):  # a name where a list has numbers
            parts = key.split(".")
            owners = (".".join(parts[:n]) for n in range(1, len(parts)))
            # the outermost list: nothing below it can be asked for by a name
            a_list = next((o for o in owners if isinstance(OmegaConf.select(cfg, o), ListConfig)), None)
            if a_list is None:
                raise
            raise UserError(f"{key}: {a_list} is a list, whose values are numbered: {a_list}.0=..., or [..]") from None
    return cfg


def _of_term(cfg: DictConfig, key: str) -> Any:
    """Return the usual value of a term's setting that the task's class declares and the settings do not list; None
    for any other. Raises UserError for a term that the task has not."""
    if key.split(".")[0] != "task" or key.split(".")[1] not in TERMS or key.count(".") not in (2, 3):
        return None
    declared = OmegaConf.create({"task": registry.task_class(resolve(cfg)).declared()})
    node = _parent(declared, key)
    return OmegaConf.select(node, key.rpartition(".")[2])


def typed(request: Request) -> frozenset[tuple[str, Any]]:
    """Return the words that were typed as values, (dotted name, word), those inside a typed mapping one by one."""
    return frozenset((key, value) for key, value in _leaves(request) if isinstance(value, str))


def given(request: Request) -> tuple[str, ...]:
    """Return the names of the settings that were given a value, those inside a typed mapping one by one."""
    return tuple(key for key, _ in _leaves(request))


def _leaves(request: Request) -> Iterator[tuple[str, Any]]:
    """Give dotted names and values; a range ({log: [low, high]}) is a value."""
    todo = [(i.key_or_group, i.value()) for i in reversed(request.values) if i.type != OverrideType.DEL]
    while todo:
        key, value = todo.pop()
        if isinstance(value, dict) and "log" not in value:
            todo += [(f"{key}.{name}", inner) for name, inner in reversed(value.items())]
        else:
            yield key, value


def apply_preset(cfg: DictConfig, name: str, items: list[Override]) -> DictConfig:
    """Merge ``task.presets.<name>`` (a partial config) over cfg, then the user's overrides again over that."""
    presets = OmegaConf.select(cfg, "task.presets") or {}
    if name == "none":
        return cfg
    if name not in presets:
        if not presets or name in ("cpu", "cuda"):
            return cfg  # the task has no wish for this kind of machine
        raise UserError(f"preset={name}: no such preset; this task has auto, none, {', '.join(presets)}")
    wishes = OmegaConf.to_container(presets[name])
    if isinstance(wishes, dict) and "agent" in wishes:  # what learns may be of another kind
        wishes["agent"] = _there_too(wishes["agent"], cfg.get("agent"))
    try:
        merged = OmegaConf.merge(cfg, wishes)
    except OmegaConfBaseException as error:
        raise UserError(f"task.presets.{name}: {_first_line(error)}") from None
    assert isinstance(merged, DictConfig)  # as both were
    gone = [i for i in items if i.type == OverrideType.DEL and OmegaConf.select(merged, i.key_or_group) is None]
    return override(merged, [i for i in items if i not in gone])


def _there_too(wishes: Any, own: Any) -> Any:
    """Return the part of nested settings that others have as well."""
    if not isinstance(wishes, dict) or not isinstance(own, DictConfig):
        return wishes
    return {k: _there_too(v, own.get(k)) for k, v in wishes.items() if k in own}


def resolve(cfg: DictConfig) -> dict[str, Any]:
    """Return the plain dict that the library gets: interpolations resolved, nothing missing."""
    try:
        plain = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise UserError(f"settings: {_first_line(error)}") from None
    assert isinstance(plain, dict)  # of a mapping
    return {str(name): value for name, value in plain.items()}


def _parent(cfg: DictConfig, key: str) -> DictConfig | ListConfig:
    """Return the node that holds ``key``. Raises UserError naming what there is where the path breaks off."""
    node, parts = cfg, key.split(".")
    for depth, part in enumerate(parts):
        inside = isinstance(node, ListConfig) and part.isdigit() and int(part) < len(node)
        if not inside and not (isinstance(node, DictConfig) and part in node):
            where = ".".join(parts[:depth])
            names = (
                [f"{where}.{k!s}" if where else str(k) for k in node if k != "choices"]
                if isinstance(node, DictConfig)
                else []
            )
            valid = (
                f"{where or 'the settings'} {'has' if where else 'are'}: {', '.join(names)}"
                if names
                else f"{where} is a single value"
            )
            everything = _every_key(cfg)
            raise UserError(f"unknown setting {key!r}{_guess(key, everything)}; {valid}")
        if depth == len(parts) - 1:
            return node
        node = node[int(part) if isinstance(node, ListConfig) else part]
        if not isinstance(node, (DictConfig, ListConfig)):
            raise UserError(f"unknown setting {key!r}: {'.'.join(parts[: depth + 1])} is a single value")
    raise AssertionError("unreachable")


def _every_key(cfg: DictConfig, prefix: str = "") -> list[str]:
    keys = []
    for key in map(str, cfg):
        keys.append(f"{prefix}{key}")
        if not OmegaConf.is_interpolation(cfg, key) and isinstance(cfg[key], DictConfig):
            keys += _every_key(cfg[key], f"{prefix}{key}.")
    return keys


def _guess(name: str, valid: list[str]) -> str:
    """Return  "; did you mean ...?" for the nearest name: by the whole path, else by its last part ('' when none is
    near)."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.8)
    if not near:
        last = {v.rpartition(".")[2]: v for v in reversed(valid)}
        near = [last[n] for n in difflib.get_close_matches(name.rpartition(".")[2], list(last), n=1, cutoff=0.75)]
    return f" (did you mean {near[0]}?)" if near else ""


def _there(cfg: DictConfig, key: str) -> bool:
    try:
        return OmegaConf.select(cfg, key) is not None
    except OmegaConfBaseException:  # a name where a list has numbers
        return False


def _check_type(key: str, old: Any, new: Any) -> None:
    """Refuse what can only be a slip: text or a truth value for a number, a single value for a group of settings."""
    if isinstance(old, DictConfig) and not isinstance(new, dict):
        # a random value may be written as a dict, {value, low, high} or {log: [low, high]}; then a plain number or a
        # list may take its place
        if set(old) <= {"value", "low", "high", "unit", "log"} and not isinstance(new, str):
            return
        raise UserError(f"{key} is a group of settings ({', '.join(f'{key}.{k!s}' for k in old)}), not a single value")
    if isinstance(old, bool) and not isinstance(new, bool):
        raise UserError(f"{key}={new}: must be true or false")
    if isinstance(old, (int, float)) and not isinstance(old, bool):
        if isinstance(new, bool) or (isinstance(new, str) and new not in WORDS and "${" not in new):
            raise UserError(f"{key}={str(new).lower() if isinstance(new, bool) else new}: must be a number, like {old}")


def _first_line(error: Exception) -> str:
    return " ".join(line.strip() for line in str(error).strip().splitlines()[:3])
