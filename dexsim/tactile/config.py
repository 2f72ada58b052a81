"""Settings of touch, checked once: every wrong key or value is one clear error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

from dexsim import typed
from dexsim.errors import UserError
from dexsim.tactile.kernel import LAWS
from dexsim.tactile.pads import PadConfig, pad_configs

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


@dataclass(frozen=True)
class TactileConfig:
    """See dexsim/configs/tactile/default.yaml for what each key means."""

    sum: str = "solver"
    law: str = "hertz"
    stiffness: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    rubber: Mapping[str, float] = field(default_factory=lambda: {"thickness": 2.0e-3, "c10": 4.0e4, "c01": 1.0e4})
    reach: float = 1.0e-3
    lift: bool = True
    others: bool = True
    feel_others: bool = False
    raw: bool = False
    shear: bool = False
    full_scale: int = 255
    period: float = 0.02
    params: Mapping[str, Range] = field(default_factory=dict)
    pads: Mapping[str, PadConfig] = field(default_factory=dict)

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
    known = {f.name for f in fields(TactileConfig)} - {"params"}
    out: dict = {"params": {}}
    for key, value in cfg.items():
        if key in COLUMNS:
            out["params"][key] = _range(key, value)
        elif key not in known:
            raise UserError(f"tactile.{key}: unknown setting; valid ones: {', '.join(sorted(known | set(COLUMNS)))}")
        else:
            out[key] = value
    for key, options in (("sum", ("solver", "spring")), ("law", tuple(LAWS))):
        if key in out and out[key] not in options:
            raise UserError(f"tactile.{key}={out[key]}: must be one of {', '.join(options)}")
    for key in ("lift", "others", "feel_others", "raw", "shear"):
        if key in out and not isinstance(out[key], bool):
            raise UserError(f"tactile.{key}={out[key]}: must be true or false")
    for key, low, high in (("reach", 1e-6, 1e-2), ("period", 1e-4, 1.0)):
        if key in out:
            out[key] = _number(key, out[key], low, high)
    if "full_scale" in out:
        out["full_scale"] = int(_number("full_scale", out["full_scale"], 1, 2**24))
    if "stiffness" in out:
        out["stiffness"] = _stiffness(out["stiffness"])
    if "rubber" in out:
        limits = {"thickness": (1e-5, 0.1), "c10": (0.0, 1e12), "c01": (0.0, 1e12)}
        rubber = dict(TactileConfig().rubber)
        for k, v in dict(out["rubber"]).items():
            if k not in limits:
                raise UserError(f"tactile.rubber.{k}: unknown; valid: {', '.join(limits)}")
            rubber[k] = _number(f"rubber.{k}", v, *limits[k])
        if rubber["c10"] + rubber["c01"] <= 0.0:
            raise UserError("tactile.rubber: c10 + c01 must be positive [Pa]")
        out["rubber"] = rubber
    if "pads" in out:
        out["pads"] = pad_configs(out["pads"])
    done = TactileConfig(**out)
    if done.feel_others and not done.others:
        raise UserError("tactile.feel_others=true needs tactile.others=true")
    return done


def stiffness_of(cfg: TactileConfig, kinds: Sequence[str]) -> list[float]:
    """Return the foundation stiffness of each pad by its kind, in the unit of the force law (`STIFFNESS_UNITS`)."""
    given = cfg.stiffness.get(cfg.law, {})
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


def _stiffness(value: object) -> dict[str, dict[str, float]]:
    if not isinstance(value, Mapping):
        raise UserError(f"tactile.stiffness={value}: must map a law ({', '.join(LAWS)}) to a value by kind of pad")
    out: dict[str, dict[str, float]] = {}
    for law, by_kind in value.items():
        if law not in LAWS:
            raise UserError(f"tactile.stiffness.{law}: unknown law; valid: {', '.join(LAWS)}")
        by_kind = by_kind if isinstance(by_kind, Mapping) else {"all": by_kind}
        out[law] = {str(k): _number(f"stiffness.{law}.{k}", v, 1e-9, 1e15) for k, v in by_kind.items()}
    return out


def _number(key: str, value: object, low: float, high: float) -> float:
    return typed.number(f"tactile.{key}", value, low, high)


def _range(key: str, value: object) -> Range:
    unit, low, high, _ = COLUMNS[key]
    pair = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value, value]
    if len(pair) != 2:
        raise UserError(f"tactile.{key}={value}: must be a number or [low, high] ({unit})")
    a, b = (_number(key, v, low, high) for v in pair)
    if a > b:
        raise UserError(f"tactile.{key}={value}: low must not exceed high ({unit})")
    return a, b
