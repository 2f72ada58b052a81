"""Which classes agent settings may name: rsl-rl imports and calls whatever its settings name, so a checkpoint that
names code of its own would run it. Names come from the lists here, unless the user types them on the command line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any

from dexsim.errors import UserError
from dexsim.typed import number

MODELS = ("MLPModel", "RNNModel", "CNNModel")
PARTS = ("actor", "critic", "student", "teacher")
DISTRIBUTIONS = ("GaussianDistribution", "HeteroscedasticGaussianDistribution", "BetaDistribution")
ALLOWED: dict[str, tuple[str, ...]] = {
    "class_name": ("OnPolicyRunner", "DistillationRunner"),
    **{f"{part}.class_name": MODELS for part in PARTS},
    **{f"{part}.distribution_cfg.class_name": DISTRIBUTIONS for part in PARTS},
    "algorithm.class_name": ("PPO", "Distillation"),
    "algorithm.symmetry_cfg.data_augmentation_func": ("dexsim.learning.symmetry:augmented",),
    "logger": ("tensorboard",),  # the others send what they log to another machine
}
"""Settings below `agent` that name code, and the names that need no typing; a setting that is not here has none."""
LEAVES = ("class_name", "data_augmentation_func", "logger", "_target_")
"""Last parts of the settings that rsl-rl, or Hydra, turns into code, wherever they stand."""

MOST_LAYERS, MOST_UNITS, MOST_WEIGHTS = 32, 16_384, 1 << 27
"""Of a network."""

Typed = frozenset[tuple[str, Any]]
"""Settings (whole dotted name, value) that the user typed on the command line."""


def check(agent: dict[str, Any], typed: Iterable[tuple[str, Any]] = (), where: str = "agent settings") -> None:
    """Raise UserError where a setting of `agent` names code that is neither on the lists above nor in `typed`.

    where: whose settings these are (a checkpoint's path), for the message.
    """
    trusted = set(typed)
    for key, value in leaves(agent):
        last = key.rpartition(".")[2]
        if last not in LEAVES or value is None:
            continue
        allowed = ALLOWED.get(key, ())
        if value in allowed or (f"agent.{key}", value) in trusted:
            continue
        text = str(value)[:120]
        known = f"dexsim takes {', '.join(allowed)} from a file" if allowed else "dexsim takes none from a file"
        raise UserError(f"{where}: agent.{key}={text} names code to run, and {known}; only if you trust it, type"
                        f" agent.{key}={text} on the command line")


def check_sizes(agent: dict[str, Any], where: str = "agent") -> None:
    """Raise UserError where a part would be no network, or one that no memory holds. where: before the key."""
    for part in PARTS:
        group, key = agent.get(part), f"{where}.{part}"
        if not isinstance(group, dict):
            continue
        sizes = group.get("hidden_dims") or [1]
        if not isinstance(sizes, list) or not len(sizes) <= MOST_LAYERS or group.get("hidden_dims") == []:
            raise UserError(
                f"{key}.hidden_dims={group['hidden_dims']}: must be a list of 1 to {MOST_LAYERS} whole numbers,"
                " e.g. [512,256,128]"
            )
        for size in sizes:
            number(f"{key}.hidden_dims", size, 1, MOST_UNITS, exact=True)
        for name, most in (("rnn_hidden_dim", MOST_UNITS), ("rnn_num_layers", MOST_LAYERS)):
            if group.get(name) is not None:
                number(f"{key}.{name}", group[name], 1, most, exact=True)
        if (weights := sum(a * b for a, b in pairwise(sizes))) > MOST_WEIGHTS:
            raise UserError(f"{key}.hidden_dims={sizes}: {weights:,.0f} weights; at most {MOST_WEIGHTS:,} are learned")


def leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of every single value below a nest of dicts and lists; a logger's own mapping is
    looked into too."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for name, value in items:
        key = f"{prefix}{name}"
        if isinstance(value, (dict, list, tuple)):
            yield from leaves(value, f"{key}.")
        else:
            yield key, value
