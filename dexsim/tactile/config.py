"""Settings of touch, checked once: every wrong key or value is one clear error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import msgspec

from dexsim import typed
from dexsim.errors import UserError
from dexsim.tactile.pads import PadConfig, pad_configs, plain, value_range

Range = tuple[float, float]

STIFFNESS_UNITS = {"linear": "N/m^3", "hertz": "N/m^2.5", "mooney_rivlin": "1"}

# Per-world parameters, resampled at each episode: name -> (unit, lowest, highest allowed, value at which it is absent).
COLUMNS: dict[str, tuple[str, float, float, float]] = {
    "stiffness_scale": ("1", 1e-3, 1e3, 1.0),
    "threshold": ("N", 0.0, 10.0, 0.0),
    "noise": ("N", 0.0, 10.0, 0.0),
    "lsb": ("N", 0.0, 10.0, 0.0),
    "delay": ("s", 0.0, 1.0, 0.0),
    "hysteresis": ("1", 0.0, 2.0, 0.0),
    "hysteresis_time": ("s", 1e-3, 100.0, 0.1),
    "shear_stiffness": ("N/m^3", 0.0, 1e15, 1.0e8),
    "friction": ("1", 0.0, 10.0, 0.8),
    "gain_spread": ("1", 0.0, 1.0, 0.0),
    "dead": ("1", 0.0, 1.0, 0.0),
}


Law = Literal["linear", "hertz", "mooney_rivlin"]
Stiffness = Annotated[float, msgspec.Meta(ge=1e-9, le=1e15)]
Modulus = Annotated[float, msgspec.Meta(ge=0, le=1e12)]


class Rubber(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thickness [m] and constants [Pa] of a skin's rubber, for law mooney_rivlin."""

    thickness: Annotated[float, msgspec.Meta(ge=1e-5, le=0.1)] = 2.0e-3
    c10: Modulus = 4.0e4
    c01: Modulus = 1.0e4

    def __getitem__(self, name: str) -> float:
        return float(getattr(self, name))


class TactileConfig(msgspec.Struct, frozen=True):
    """See dexsim/configs/tactile/default.yaml for what each key means."""

    sum: Literal["solver", "spring"] = "solver"
    law: Law = "hertz"
    stiffness: dict[Law, dict[str, Stiffness] | Stiffness] = {}
    rubber: Rubber = Rubber()
    reach: Annotated[float, msgspec.Meta(ge=1e-6, le=1e-2)] = 1.0e-3
    lift: bool = True
    others: bool = True
    feel_others: bool = False
    raw: bool = False
    shear: bool = False
    full_scale: Annotated[int, msgspec.Meta(ge=1, le=2**24)] = 255
    period: Annotated[float, msgspec.Meta(ge=1e-4, le=1.0)] = 0.02
    params: dict[str, Range] = {}
    pads: dict[str, PadConfig] = {}

    def range(self, name: str) -> Range:
        return self.params.get(name, (COLUMNS[name][3],) * 2)

    def used(self, name: str) -> bool:
        """Return whether an effect can be present at all: code for absent ones is not compiled."""
        return self.range(name) != (COLUMNS[name][3],) * 2

    @property
    def measured(self) -> bool:
        """Return whether what the sensor reports differs from the clean forces."""
        effects = ("threshold", "noise", "lsb", "delay", "hysteresis", "gain_spread", "dead")
        return self.shear or self.feel_others or bool(self.pads) or any(self.used(n) for n in effects)


def tactile_config(cfg: Mapping | TactileConfig | None) -> TactileConfig:
    """Check and complete settings (a mapping such as Hydra's `cfg.tactile`)."""
    if isinstance(cfg, TactileConfig):
        return cfg
    cfg = dict(cfg or {})
    known = {*TactileConfig.__struct_fields__, *COLUMNS} - {"params"}
    for key in cfg:
        if key not in known:
            raise UserError(f"tactile.{key}: unknown setting; valid ones: {', '.join(sorted(known))}")
    params = {key: value_range(f"tactile.{key}", cfg.pop(key), *COLUMNS[key][:3]) for key in COLUMNS if key in cfg}
    pads = pad_configs(cfg.pop("pads")) if "pads" in cfg else {}
    done = typed.convert({"tactile": plain(cfg)}, dict[str, TactileConfig], "settings")["tactile"]
    if done.rubber.c10 + done.rubber.c01 <= 0.0:
        raise UserError("tactile.rubber: c10 + c01 must be positive [Pa]")
    if done.feel_others and not done.others:
        raise UserError("tactile.feel_others=true needs tactile.others=true")
    return msgspec.structs.replace(done, params=params, pads=pads)


def stiffness_of(cfg: TactileConfig, kinds: Sequence[str]) -> list[float]:
    """Return the foundation stiffness of each pad by its kind, in the unit of the force law (`STIFFNESS_UNITS`)."""
    stated = cfg.stiffness.get(cfg.law, {})
    given = stated if isinstance(stated, dict) else {"all": stated}
    out = []
    for kind in kinds:
        if kind not in given and "all" not in given:
            unit = STIFFNESS_UNITS[cfg.law]
            raise UserError(
                f"tactile.stiffness.{cfg.law}: no value [{unit}] for pads of kind '{kind}'; given for:"
                f" {', '.join(given) or 'none'} (key 'all' holds for every kind)"
            )
        out.append(given[kind] if kind in given else given["all"])
    return out
