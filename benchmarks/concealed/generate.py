"""Draws the cases of the concealed benchmark: a rig, motions, an effect of a chosen size, recordings, and the truth apart.

A case folder holds what `diagnose` sees: `a.mcap`, `b.mcap` (to fit), `c.mcap` (held out), `rig.xml`, `servo.yaml`. The truth
goes to another folder; its SHA-256 with a random salt is published first.

Size of an effect: d = the held-out change that it makes, with gains, mass, inertia and friction refitted by up to 5 % to hide
it; f = the floor: measurement noise and what another friction law leaves of the same rig. sqrt(d^2 + f^2) / f is 10, 3 or 1.5
at easy, medium and hard: the size is read off one batch in which the same rig carries the effect at many sizes.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from benchmarks.concealed import plant
from dexsim.recording import Writer

TIERS = {"easy": 10.0, "medium": 3.0, "hard": 1.5, "poor": 1.2}  # poor: a decoy, excited too little to show
SECONDS = 8.0
START_NS = 1_700_000_000_000_000_000  # the same for every recording: time tells nothing
RECORDINGS = ("a", "b", "c")
SIZES = 22
REFIT = ("kp", "kd", "mass", "rotor", "coulomb", "viscous", "torque_limit", "no_load_speed")
BELIEF = 0.05  # how far each may be refitted


@dataclass(frozen=True)
class Kind:
    """An effect as the plant has it. span: its smallest and largest size; apply(true row, size) -> parameters changed."""

    effect: str  # id of the catalogue, or "" outside it
    span: tuple[float, float]
    apply: object
    report: object  # (parameters with the effect, parameters without) -> {key: value} as the catalogue names them


def _plus(name: str, unit: str | None = None):
    return lambda p, s: {name: p[name] + s * (p[unit] if unit else 1.0)}


def _less(name: str):
    return lambda p, s: {name: p[name] * (1 - s)}


KINDS: dict[str, Kind] = {
    "coulomb_friction": Kind("coulomb_friction", (0.01, 1.0), lambda p, s: {"coulomb": p["coulomb"] + s * p["weight"]}, lambda n, o: {"torque": n["coulomb"]}),
    "stribeck_friction": Kind("stribeck_friction", (0.01, 1.2), lambda p, s: {"peak": s * p["weight"], "peak_speed": p["stribeck_speed"]},
                              lambda n, o: {"peak": n["peak"], "v_s": n["peak_speed"]}),
    "viscous_friction": Kind("viscous_friction", (0.01, 1.0), lambda p, s: {"viscous": p["viscous"] + 0.2 * s * p["weight"]}, lambda n, o: {"coefficient": n["viscous"]}),
    "load_friction": Kind("load_friction", (0.02, 0.8), lambda p, s: {"load": s, "load_back": s}, lambda n, o: {"fraction": n["load"]}),
    "backlash": Kind("backlash", (0.002, 0.4), _plus("play"), lambda n, o: {"gap": n["play"]}),
    "command_delay": Kind("command_delay", (0.0005, 0.1), _plus("delay"), lambda n, o: {"delay": n["delay"] - o["delay"]}),
    "lag": Kind("lag", (0.0005, 0.1), _plus("lag"), lambda n, o: {"time_constant": n["lag"]}),
    "torque_limit": Kind("torque_limit", (0.05, 0.9), _less("torque_limit"), lambda n, o: {"torque": n["torque_limit"]}),
    "torque_speed_limit": Kind("torque_speed_limit", (0.06, 0.95), _less("no_load_speed"), lambda n, o: {"no_load_speed": n["no_load_speed"]}),
    "gain_mismatch": Kind("gain_mismatch", (0.07, 0.7), _less("kp"), lambda n, o: {"kp_factor": n["kp"] / n["kp_believed"]}),
    "inertia": Kind("inertia", (0.05, 8.0), _plus("rotor", "total"), lambda n, o: {"armature": n["rotor"] - n["rotor_believed"]}),
    "payload": Kind("payload", (0.06, 2.0), _plus("mass", "mass"), lambda n, o: {"mass": n["mass"] - n["mass_believed"]}),
    "position_offset": Kind("position_offset", (0.001, 0.5), _plus("offset"), lambda n, o: {"offset": n["offset"]}),
    "compliance": Kind("compliance", (0.02, 1.5), lambda p, s: {"spring": p["kp"] / s}, lambda n, o: {"stiffness": n["spring"]}),
    "torque_ripple": Kind("torque_ripple", (0.02, 1.5), lambda p, s: {"ripple": s * p["weight"]}, lambda n, o: {"amplitude": n["ripple"], "per_turn": n["per_turn"]}),
    "position_scale": Kind("position_scale", (0.003, 0.3), _plus("scale"), lambda n, o: {"scale": n["scale"]}),
    "deadband": Kind("deadband", (0.002, 0.3), _plus("deadband"), lambda n, o: {"width": n["deadband"]}),
    "dwell_stiction": Kind("", (0.02, 1.5), lambda p, s: {"dwell": s * p["weight"], "dwell_time": 1.5}, lambda n, o: {}),
    "cable_spring": Kind("", (0.02, 1.5), lambda p, s: {"cable": s * p["weight"], "cable_rest": 0.6}, lambda n, o: {}),
}  # fmt: skip
INSIDE = tuple(k for k, v in KINDS.items() if v.effect)
OUTSIDE = tuple(k for k, v in KINDS.items() if not v.effect)


MIX = {"effect": 14, "none": 4, "noise": 2, "outside": 2, "decoy": 2}


def plan(mix: dict[str, int], seed: int) -> list[dict]:
    """What each case holds: {kind, tier, group}, in an order that is itself drawn. mix: number of cases by group: effect (one
    of the catalogue), none, noise (nothing, the noise doubled), outside (the catalogue), decoy. Kinds and tiers take turns."""
    rng = np.random.default_rng([seed, 1])
    kinds, tiers = list(rng.permutation(INSIDE)), ("easy", "medium", "hard")
    out = []
    for group, count in mix.items():
        if group not in MIX:
            raise ValueError(f"no group '{group}'; there are {', '.join(MIX)}")
        for k in range(count):
            kind, tier = "none", "none"
            if group == "outside":
                kind, tier = OUTSIDE[k % len(OUTSIDE)], tiers[k // len(OUTSIDE) % 2]
            elif group in ("effect", "decoy"):
                # all kinds before a kind comes again, then at another tier
                kind, tier = str(kinds[k % len(kinds)]), tiers[(k + k // len(kinds)) % 3]
            out.append({"group": group, "kind": kind, "tier": tier if group != "decoy" else "poor"})
    return [out[i] for i in rng.permutation(len(out))]


def motions(rng: np.random.Generator, poor: bool) -> np.ndarray:
    """Targets of the three recordings in every millisecond, [3, M]; sent at 100 Hz and held between."""
    M = int(SECONDS * 1000)
    t = np.arange(0, SECONDS, 0.01)
    out = []
    for k in range(len(RECORDINGS)):
        if poor:  # slow and small: hardly anything shows
            c = rng.uniform(-0.1, 0.1) + 0.06 * np.sin(2 * np.pi * rng.uniform(0.1, 0.2) * t)
        else:
            knots = np.cumsum(np.r_[0.0, rng.uniform(0.4, 0.9, 60)])
            levels = np.r_[0.0, rng.uniform(-0.8, 0.8, len(knots) - 1)]
            rise = rng.uniform(0.15, 0.35)  # steps as a planner sends them: a drive that saturates all the time hides the rest
            step = np.interp(t, np.sort(np.r_[knots[1:], knots[1:] + rise]), np.r_[levels[0], np.repeat(levels[1:-1], 2), levels[-1]])
            f = np.linspace(rng.uniform(0.15, 0.3), rng.uniform(1.2, 2.5), len(t))
            chirp = rng.uniform(0.2, 0.4) * np.sin(2 * np.pi * np.cumsum(f) * 0.01) + rng.uniform(-0.3, 0.3)
            ramp = np.interp(t, knots[::2], levels[::2])
            parts = [[ramp, step, chirp], [chirp, ramp, step], [step, chirp, ramp]][k]
            third = np.minimum((3 * np.arange(len(t)) / len(t)).astype(int), 2)
            c = np.choose(third, parts)
        out.append(np.repeat(c, 10)[:M])
    return np.array(out)


def _rig(rng: np.random.Generator) -> tuple[dict, dict]:
    """(true parameters without the effect, believed ones): every nominal quantity a few percent off."""
    b = {"mass": rng.uniform(0.08, 0.3), "length": rng.uniform(0.07, 0.14), "rotor": rng.uniform(2e-4, 8e-4)}
    weight = b["mass"] * 9.81 * b["length"]
    inertia = b["mass"] * b["length"] ** 2 + b["rotor"]
    b["kp"] = weight * rng.uniform(6, 14)
    b["kd"] = 2 * rng.uniform(0.3, 0.6) * np.sqrt(b["kp"] * inertia)
    b |= {"torque_limit": weight * rng.uniform(5, 9), "no_load_speed": rng.uniform(9, 18), "coulomb": weight * rng.uniform(0.04, 0.1),
          "viscous": weight * rng.uniform(0.005, 0.02)}  # fmt: skip
    true = {k: v * (1 + rng.uniform(-0.03, 0.03)) for k, v in b.items()}
    true["length"] = b["length"]  # the moment is off with the mass already
    true |= {"motor_side": float(rng.uniform() < 0.3), "link_inertia": 0.4 * b["mass"] * 0.012**2, "weight": weight, "total": inertia,
             "stribeck_speed": rng.uniform(0.05, 0.4), "per_turn": float(rng.integers(6, 40)), "phase": rng.uniform(-3, 3)}  # fmt: skip
    true |= {f"{k}_believed": b[k] for k in ("kp", "rotor", "mass")}
    return plant.DEFAULTS | {k: float(v) for k, v in true.items()}, {k: float(v) for k, v in b.items()}


def _sized(true: dict, kind: Kind | None, ratio: float, command: np.ndarray, noise: float) -> tuple[dict, dict, np.ndarray, np.ndarray]:
    """(parameters with the effect, figures of its size, measured position [3, M], torque [3, M])."""
    base = {k: v for k, v in true.items() if k in plant.DEFAULTS}
    sizes = np.geomspace(*kind.span, SIZES) if kind else np.zeros(0)
    variants = [base] + [base | kind.apply(true, s) for s in sizes]
    first = len(variants)
    variants += [base | {k: base[k] * 1.02} for k in REFIT] + [base | {"bristle": 0.0}]
    R = len(command)
    values = {k: np.repeat([v.get(k, plant.DEFAULTS[k]) for v in variants], R) for k in plant.DEFAULTS}
    run = plant.simulate(plant.rows(R * len(variants), **values), np.tile(command, (len(variants), 1)))
    get = lambda key: np.array([v[key] for v in variants])[:, None, None]  # noqa: E731
    q = get("scale") * run["position"].reshape(len(variants), R, -1) + get("offset")  # as measured
    slopes = (q[first:-1] - q[0]).reshape(len(REFIT), -1).T / 0.02

    def hidden(d: np.ndarray) -> float:
        """Held-out RMS of a change [3, M], what a refit on all takes away taken away."""
        x = np.clip(np.linalg.lstsq(slopes, d.reshape(-1), rcond=None)[0], -BELIEF, BELIEF)
        return float(np.sqrt(np.mean((d.reshape(-1) - slopes @ x).reshape(d.shape)[-1] ** 2)))

    law = hidden(q[-1] - q[0])
    floor = float(np.hypot(noise, law))
    facts = {"floor": floor, "law": law, "noise": noise}
    if kind is None:
        return base, facts, q[0], run["torque"].reshape(q.shape)[0]
    change = np.array([hidden(q[1 + i] - q[0]) for i in range(SIZES)])
    reached = np.hypot(change, floor) / floor
    pick = int(np.argmin(np.abs(np.log(reached / ratio))))
    facts |= {"ratio": float(reached[pick]), "size": float(sizes[pick]), "before": float(np.hypot(change[pick], floor))}
    return variants[1 + pick], facts, q[1 + pick], run["torque"].reshape(q.shape)[1 + pick]


def metadata(effort: bool) -> dict[str, str]:
    """What every recording states: nothing of it depends on the effect."""
    return {"source": "real", "robot": "rig", "gravity": "0 0 -9.81", "effort_is": "torque_Nm" if effort else "none", "effort_sign": "+1"}


def build(entry: dict, number: int, seed: int, seen: Path, truth: Path) -> dict:
    """Writes one case to `seen` and its truth to `truth`; returns {name, digest}. The folder's name is drawn too."""
    rng = np.random.default_rng([seed, 2, number])
    name = hashlib.sha256(f"{seed}/{number}".encode()).hexdigest()[:8]
    true, believed = _rig(rng)
    poor = entry["group"] == "decoy"
    command = motions(rng, poor)
    quantum = 2 * np.pi / 4096
    extra = rng.uniform(2e-4, 6e-4) * (2 if entry["group"] == "noise" else 1)
    noise = float(np.hypot(quantum / np.sqrt(12), extra))
    kind = KINDS.get(entry["kind"])
    p, facts, q, tau = _sized(true, kind, TIERS.get(entry["tier"], 1.0), command, noise)
    effort = bool(rng.uniform() < 0.5)
    where = seen / name
    where.mkdir(parents=True, exist_ok=True)
    _files(where, believed, true)
    for k, letter in enumerate(RECORDINGS):
        t, angle = plant.log(q[k], rng, 100.0, 1e-3)
        torque = np.interp(t, np.arange(tau.shape[1]) * 1e-3, tau[k]) + rng.normal(0, 0.01 * true["weight"], len(t))
        angle = np.round((angle + rng.normal(0, extra, len(t))) / quantum) * quantum
        torque = np.round(torque / 1e-4) * 1e-4
        with Writer(where / f"{letter}.mcap", ["joint"], metadata(effort), START_NS) as w:
            sent = np.arange(0, command.shape[1], 10)
            samples = [(i * 1e-3, 0, command[k, i], 0.0) for i in sent] + [(x, 1, a, u) for x, a, u in zip(t, angle, torque, strict=True)]
            for x, which, a, u in sorted(samples, key=lambda s: s[:2]):
                if which:
                    w.add_state(x, np.array([a]), None, np.array([u]) if effort else None)
                else:
                    w.add_command(x, np.array([a]))
    answer = {"name": name, **entry, "effect": kind.effect if kind else "none", "floor": facts["floor"], "facts": facts,
              "parameters": kind.report(true | p, true) if kind else {}}  # fmt: skip
    answer["parameters"] = {k: float(v) for k, v in answer["parameters"].items()}
    return {"name": name, "digest": commit(answer, truth)}


def once(job: tuple[dict, int, int, Path]) -> dict:
    """{name, digest}: the case as it was made before, or made now. job: entry of the plan, number, seed, folder."""
    entry, number, seed, root = job
    stub = root / "made" / f"{number}.json"
    if not stub.is_file():
        made = build(entry, number, seed, root / "cases", root / "truth")
        stub.parent.mkdir(parents=True, exist_ok=True)
        stub.write_text(json.dumps(made), encoding="utf-8")
    return json.loads(stub.read_text(encoding="utf-8"))


def commit(answer: dict, folder: Path) -> str:
    """Writes the truth with a fresh salt; returns the SHA-256 that binds it and tells nothing."""
    import secrets

    text = json.dumps({"salt": secrets.token_hex(16), "truth": answer}, sort_keys=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{answer['name']}.json").write_text(text, encoding="utf-8")
    return hashlib.sha256(text.encode()).hexdigest()


def reveal(path: Path, digest: str) -> dict:
    """The truth of a case; ValueError where the file is not the one that was committed to."""
    text = path.read_text(encoding="utf-8")
    if hashlib.sha256(text.encode()).hexdigest() != digest:
        raise ValueError(f"{path}: is not the truth that was published before the diagnosis")
    return json.loads(text)["truth"]


def _files(where: Path, b: dict, true: dict) -> None:
    g = "%.5g"
    (where / "rig.xml").write_text(f"""<mujoco model="rig">
  <compiler angle="radian"/>
  <worldbody>
    <body name="link">
      <joint name="joint" type="hinge" axis="0 1 0" armature="{g % b["rotor"]}" range="-3 3"/>
      <geom name="bob" type="sphere" size="0.012" pos="0 0 {g % -b["length"]}" mass="{g % b["mass"]}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
""", encoding="utf-8")  # fmt: skip
    names = {"kp": "kp", "kd": "kd", "torque_limit": "torque_limit", "no_load_speed": "no_load_speed", "coulomb": "coulomb_friction", "viscous": "viscous_friction"}
    servo = {"drive": "torque", "joints": {"*": {ours: float(g % b[k]) for k, ours in names.items()}}, "loop_rate": 1000,
             "loop_encoder": "motor" if true["motor_side"] else "joint", "position_encoder": "joint"}  # fmt: skip
    (where / "servo.yaml").write_text(yaml.safe_dump(servo, sort_keys=False), encoding="utf-8")
