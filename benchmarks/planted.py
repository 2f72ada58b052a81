"""Planted effects: every joint effect of the catalogue, hidden in recordings of our own simulator, and found again.

    python -m benchmarks.planted [cases=0] [first=0] [seed=1] [workers=1] [out=out/planted] [effects=a,b] [limit=0]

One round is every entry of PLANTS once, its size drawn round robin from three tiers, and a few cases with nothing
planted; `cases` counts along the rounds (0: one round). This is the sanity check of `diagnose`: the data come from the
simulator that trains policies, C MuJoCo with the servo kernel, at 0.2 ms or (play, elasticity) 0.1 ms, with an
encoder's quantum, noise and a jittered clock. Every believed figure is off by a draw from the very tolerance that the
tool states for it (`_off`): gains, limits, friction, inertia and gravity by a normal deviate of 2.5 % cut at 5 %, delay
and filters by fractions of a period or of 3 ms. Of a case's four recordings one is held out that leads the others
neither in error nor in speed nor in torque. Size of an effect: what a refit of all that the tool refits with every
hypothesis leaves of it, in the recordings fitted and in the one held out, in the search's own plant without noise, is
8, 4 or 2 times the measurement noise. The floor of a case is that noise and, in squares, what the held-out recording
differs by when it is made again from one encoder count away; a case in which that is more than twice the noise is drawn
anew. limit: seconds after which no further case is waited for (0: all are). Resumable; prints a table and one JSON
line.
"""

from __future__ import annotations

import json
import multiprocessing as mp
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from benchmarks.options import options
from dexsim.console.ending import guard
from dexsim.errors import UserError

TIERS = {"large": 8.0, "medium": 4.0, "small": 2.0}
NONE_EACH = 6  # cases with nothing planted in a round
SECONDS = 7.0
QUANTUM = 2 * np.pi / 4096
SETTINGS = {"cases": 0, "first": 0, "seed": 1, "workers": 1, "out": "out/planted", "effects": "", "limit": 0}
REFIT = (
    "kp",
    "kd",
    "torque_limit",
    "no_load_speed",
    "coulomb_friction",
    "viscous_friction",
    "inertia_scale",
    "gravity_scale",
)
RATE = 1000  # Hz: of the loop


@dataclass(frozen=True)
class Plant:
    """An effect as it is planted. change(rig, size) -> plant columns added to ("+name"), multiplied ("*name") or set;
    span: smallest and largest size; truth(rig, size) -> {key: value} as the catalogue reports it. needs: what of the
    rig or the recording it cannot be seen without."""

    effect: str
    span: tuple[float, float]
    change: object
    truth: object
    needs: str = ""


def _less(column: str, key: str):
    return lambda r, s: {f"*{column}": 1 - s}, lambda r, s: {key: r[column] * (1 - s)}


PLANTS: dict[str, Plant] = {
    "coulomb_friction": Plant("coulomb_friction", (0.01, 1.0), lambda r, s: {"+coulomb_friction": s * r["weight"]},
                              lambda r, s: {"torque": r["coulomb_friction"] + s * r["weight"]}),
    "coulomb_friction one way": Plant("coulomb_friction", (0.002, 1.0), lambda r,
                                      s: {"+coulomb_friction": s * r["weight"], "friction_asymmetry": 0.8},
                                      lambda r,
                                      s: {"torque": r["coulomb_friction"] + s * r["weight"], "asymmetry": 0.8}),
    "stribeck_friction": Plant("stribeck_friction", (0.01, 1.2), lambda r,
                               s: {"stribeck_peak": s * r["weight"], "stribeck_speed": 0.25},
                               lambda r, s: {"peak": s * r["weight"], "v_s": 0.25}),
    "viscous_friction": Plant("viscous_friction", (0.01, 1.0), lambda r,
                              s: {"+viscous_friction": 0.2 * s * r["weight"]},
                              lambda r, s: {"coefficient": r["viscous_friction"] + 0.2 * s * r["weight"]}),
    "load_friction": Plant("load_friction", (0.02, 0.8), lambda r,
                           s: {"load_friction": s, "load_friction_backdriven": 1.4 * s},
                           lambda r, s: {"fraction": s, "fraction_backdriven": 1.4 * s}),
    "backlash": Plant("backlash", (0.003, 0.3), lambda r, s: {"backlash": s}, lambda r, s: {"gap": s}),
    "compliance": Plant("compliance", (0.03, 2.0), lambda r, s: {"softness": s / r["kp"]}, lambda r,
                        s: {"stiffness": r["kp"] / s}),
    "command_delay": Plant("command_delay", (0.002, 0.1), lambda r, s: {"+delay": s}, lambda r,
                           s: {"delay": s + r["off"]["+delay"]}),
    "lag": Plant("lag", (0.0007, 0.1), lambda r, s: {"+lag": s}, lambda r, s: {"time_constant": s + r["off"]["+lag"]}),
    "lag of the speed": Plant("lag", (0.004, 0.1), lambda r, s: {"+speed_lag": s}, lambda r,
                              s: {"time_constant": s + r["off"]["+speed_lag"]}, "damped"),
    "setpoint at a speed": Plant("setpoint_profile", (0.02, 0.93), lambda r, s: {"profile_speed": 8 * (1 - s)},
                                 lambda r, s: {"speed": 8 * (1 - s)}),
    "setpoint at a speed and acceleration": Plant("setpoint_profile", (0.02, 0.93), lambda r,
                                                  s: {"profile_speed": 8 * (1 - s),
                                                      "profile_acceleration": 80 * (1 - s) / s},
                                                  lambda r, s: {"speed": 8 * (1 - s),
                                                                "acceleration": 80 * (1 - s) / s}),
    "torque_limit": Plant("torque_limit", (0.05, 0.9), *_less("torque_limit", "torque")),
    "torque_speed_limit": Plant("torque_speed_limit", (0.06, 0.93), *_less("no_load_speed", "no_load_speed")),
    "supply_sag": Plant("supply_sag", (0.02, 0.9), lambda r, s: {"sag": s / (2 * r["weight"])}, lambda r,
                        s: {"sag": s / (2 * r["weight"])}, "pair voltage"),
    "torque_ripple": Plant("torque_ripple", (0.01, 1.0), lambda r,
                           s: {"torque_ripple": s * r["weight"], "ripple_per_turn": r["teeth"], "ripple_phase": 1.0},
                           lambda r, s: {"amplitude": s * r["weight"], "per_turn": r["teeth"]}),
    "thermal of the torque constant": Plant("thermal", (0.0006, 0.03), lambda r, s: {"thermal_torque": -s}, lambda r,
                                            s: {"per_degree": -s, "of": "torque_constant"},
                                            "warm"),
    "thermal of the friction": Plant("thermal", (0.002, 0.04), lambda r, s: {"thermal_friction": -s}, lambda r,
                                     s: {"per_degree": -s, "of": "friction"},
                                     "warm rough"),
    "joint_coupling": Plant("joint_coupling", (0.002, 0.4), lambda r, s: {"coupling": s}, lambda r,
                            s: {"ratio": s, "from_joint": "other"}, "pair"),
    "position_offset": Plant("position_offset", (0.002, 0.5), lambda r, s: {"position_offset": s}, lambda r,
                             s: {"offset": s}),
    "position_scale": Plant("position_scale", (0.005, 0.3), lambda r, s: {"position_scale": 1 + s}, lambda r,
                            s: {"scale": 1 + s}),
    "eccentric encoder": Plant("position_scale", (0.002, 0.2), lambda r,
                               s: {"eccentric_sin": 0.8 * s, "eccentric_cos": 0.6 * s},
                               lambda r, s: {"eccentricity": s}),
    "payload": Plant("payload", (0.06, 2.0), lambda r, s: {"payload": s * r["mass"]}, lambda r,
                     s: {"mass": s * r["mass"]}),
    "tilted gravity": Plant("payload", (0.005, 0.6), lambda r, s: {"tilt_y": s}, lambda r, s: {"tilt": [0.0, s, 0.0]}),
    "inertia": Plant("inertia", (0.06, 5.0), lambda r, s: {"+armature": s * r["inertia"]}, lambda r,
                     s: {"armature": s * r["inertia"]}),
    "gain_mismatch kp": Plant("gain_mismatch", (0.06, 0.7), lambda r, s: {"*kp": 1 - s}, lambda r,
                              s: {"kp_factor": (1 - s) * r["off"]["*kp"]}),
    "gain_mismatch kd": Plant("gain_mismatch", (0.06, 8.0), lambda r, s: {"*kd": 1 + s}, lambda r,
                              s: {"kd_factor": (1 + s) * r["off"]["*kd"]}, "damped"),
    "deadband": Plant("deadband", (0.002, 0.3), lambda r, s: {"deadband": s}, lambda r, s: {"width": s}),
    "current_sensor": Plant("current_sensor", (0.08, 0.6), lambda r,
                            s: {"effort_gain": 1 - s, "effort_offset": 0.3 * s * r["weight"]},
                            lambda r, s: {"gain": 1 - s, "offset": 0.3 * s * r["weight"]}, "effort"),
}  # fmt: skip
# dry friction that turns with the motion, not before it
STICKS = 'solimpfriction="0.999 0.9999 0.001 0.5 2" solreffriction="0.002 1"'
# draws of a case, of which the first counts whose floor is within so many times the noise (no joint that rattles)
DRAWS, REPEATS = 4, 2.0
STEP, FINE = 2e-4, 1e-4  # s: of the engine; with play or elasticity
SERVO = ("kp", "kd", "torque_limit", "no_load_speed", "coulomb_friction", "viscous_friction")


def plan(seed: int, effects: set[str]) -> list[dict]:
    """Return one round after another: {kind, tier}; kind '' has nothing planted."""
    names = [n for n, p in PLANTS.items() if not effects or p.effect in effects or n in effects]
    tiers, out = list(TIERS), []
    for turn in range(40):
        order = np.random.default_rng([seed, 1, turn]).permutation(len(names) + (0 if effects else NONE_EACH))
        for k in order:
            kind = names[k] if k < len(names) else ""
            out.append({"kind": kind, "tier": tiers[(k + turn) % 3] if kind else "none"})
    return out


def rig(rng: np.random.Generator, needs: str) -> dict:
    """Return the believed figures of a pendulum of random size on a servo, of which there are two where `pair` is
    needed."""
    b = {"mass": rng.uniform(0.08, 0.3), "length": rng.uniform(0.07, 0.14), "rotor": rng.uniform(2e-4, 8e-4)}
    b["weight"] = b["mass"] * 9.81 * b["length"]
    b["inertia"] = b["mass"] * b["length"] ** 2 + b["rotor"]
    b["voltage"] = "voltage" in needs or (rng.uniform() < 0.25 and "damped" not in needs)
    b["torque_limit"] = b["weight"] * rng.uniform(4, 8)
    b["no_load_speed"] = rng.uniform(9, 18)
    spring = b["weight"] * rng.uniform(6, 14)
    b["kp"] = spring / (b["torque_limit"] if b["voltage"] else 1.0)
    b["kd"] = 0.0 if b["voltage"] else 2 * rng.uniform(0.3, 0.6) * np.sqrt(spring * b["inertia"])
    rough = rng.uniform(0.2, 0.4) if "rough" in needs else rng.uniform(0.04, 0.1)
    b |= {"coulomb_friction": b["weight"] * rough, "viscous_friction": b["weight"] * rng.uniform(0.005, 0.02)}
    b["teeth"] = float(rng.integers(3, 24))
    b["joints"] = ("joint", "other") if "pair" in needs else ("joint",)
    b["motor_loop"] = bool(rng.uniform() < 0.3)
    return b


NO_CONTACT = 'contype="0" conaffinity="0"'


def model_xml(b: dict, true: dict | None = None) -> str:
    """Return the pendulum(s) as MJCF; a second one hangs beside the first and shares nothing with it but the supply.
    true: by joint what differs from `b`, and a payload [kg] at the believed centre."""

    def load(kg: float) -> str:
        return (
            f"""<geom type="sphere" size="0.001" pos="0 0 {-b["length"]:.6g}" mass="{kg:.6g}" {NO_CONTACT}/>"""
            if kg
            else ""
        )

    rows = [(k, j, {**b, **(true or {}).get(j, {})}) for k, j in enumerate(b["joints"])]
    bodies = "".join(
        f"""
    <body name="link_{j}" pos="0 {0.3 * k:g} 0">
      <joint name="{j}" type="hinge" axis="0 1 0" armature="{x["rotor"]:.6g}" range="-3 3" {STICKS}/>
      <geom name="bob_{j}" type="sphere" size="0.012" pos="0 0 {-x["length"]:.6g}" mass="{x["mass"]:.6g}"
        {NO_CONTACT}/>{load(x.get("payload", 0.0))}
    </body>"""
        for k, j, x in rows
    )
    return f"""<mujoco model="rig"><compiler angle="radian"/>
<option timestep="0.001" integrator="implicitfast"/><worldbody>{bodies}
</worldbody></mujoco>
"""


def servo(b: dict) -> dict:
    """Return the believed servo table. How the simulator's drives brake is not left to be guessed: nothing of it is
    hidden."""
    brakes = {} if b["voltage"] else {"braking_slope": 1.0}
    return {"drive": "voltage" if b["voltage"] else "torque", "joints": {"*": {k: float(b[k]) for k in SERVO} | brakes},
            "loop_rate": RATE,
            "loop_encoder": "motor" if b["motor_loop"] else "joint", "position_encoder": "joint"}  # fmt: skip


def motion(rng: np.random.Generator, kind: int) -> np.ndarray:
    """Return the targets sent at 100 Hz [K]."""
    t = np.arange(0.0, SECONDS, 0.01)
    knots = np.cumsum(np.r_[0.0, rng.uniform(0.4, 0.9, 40)])
    levels = np.r_[0.0, rng.uniform(-0.9, 0.9, len(knots) - 1)]
    ramp = np.interp(t, knots[::2], levels[::2])
    rise = rng.uniform(0.12, 0.3)
    step = np.interp(
        t, np.sort(np.r_[knots[1:], knots[1:] + rise]), np.r_[levels[0], np.repeat(levels[1:-1], 2), levels[-1]]
    )
    f = np.linspace(rng.uniform(0.15, 0.3), rng.uniform(1.5, 3.0), len(t))
    chirp = rng.uniform(0.2, 0.4) * np.sin(2 * np.pi * np.cumsum(f) * 0.01) + rng.uniform(-0.3, 0.3)
    parts = [[ramp, step, chirp], [chirp, ramp, step], [step, chirp, ramp], [ramp, chirp, step]][kind % 4]
    return np.choose(np.minimum((3 * np.arange(len(t)) / len(t)).astype(int), 2), parts)


def _runs(b: dict, rng: np.random.Generator, needs: str) -> list:
    """Return four runs with commands, times and temperature, the measured motion still to be simulated."""
    from dexsim.actuator.table import ServoTable
    from dexsim.gap.read import Run

    out, J = [], len(b["joints"])
    t_cmd = np.arange(0.0, SECONDS, 0.01)
    warm = rng.permutation(4)
    for k in range(4):
        cmd = np.stack([motion(rng, k + j) for j in range(J)], 1)
        n = int(SECONDS / 0.01) - 3
        t = 0.005 + (np.arange(n) + 0.5) * 0.01 + np.clip(rng.normal(0, 6e-4, n), -4e-3, 4e-3)
        t = t[rng.uniform(size=n) > 0.005]
        run = Run(f"{'abcd'[k]}.mcap", b["joints"], t_cmd, cmd, t,
                  np.stack([np.interp(t, t_cmd, c) for c in cmd.T], 1), ServoTable.from_dict(servo(b)),
                  np.array([0.0, 0.0, -9.81]))  # fmt: skip
        if "warm" in needs or rng.uniform() < 0.2:
            run.temperature = np.repeat((25 + 8.0 * warm[k] + 6.0 * t / SECONDS)[:, None], J, 1)
        out.append(run)
    if any(r.temperature is None for r in out):
        for r in out:
            r.temperature = None
    return out


def _apply(params: np.ndarray, change: dict) -> np.ndarray:
    """Return the plant parameters [..., C] with the changes made."""
    from dexsim.gap.plant.columns import INDEX

    out = params.copy()
    for key, value in change.items():
        c = INDEX[key.lstrip("+*")]
        out[..., c] = out[..., c] * value if key[0] == "*" else out[..., c] + value if key[0] == "+" else value
    return out


def _simulate(b: dict, runs: list, changes: list[dict], dt: float, passes: int) -> tuple[list, np.ndarray, np.ndarray]:
    """Return (cases, position [H, n], torque [H, n]) of the first joint under each of the changes, all joints moving
    as the first change of the first joint makes them."""
    import mujoco

    from dexsim.gap.plant.case import build

    model = mujoco.MjModel.from_xml_string(model_xml(b))
    for _ in range(passes):
        for r in runs:
            r.qs = None
            r.smooth()
        cases = build(model, runs, dt=dt)
        for j, case in enumerate(cases):
            p = _apply(case.plant.base()[None], changes[0] if j == 0 else b["off"])
            q, tau = case.plant.simulate(p, case.plant.windows(None))
            for i, r in enumerate(runs):
                r.q[:, j] = q[0, case.plant.rows(i)]
                if r.torque is None:
                    r.torque = np.zeros_like(r.q)
                r.torque[:, j] = tau[0, case.plant.rows(i)]
    first = cases[0].plant
    H = [_apply(first.base(), c) for c in changes]
    q, tau = first.simulate(np.stack(H), first.windows(None))
    return cases, q, tau


def _by_mujoco(b: dict, runs: list, change: dict) -> float:
    """Simulates the runs by C MuJoCo with the servo that trains: the first joint with the change, another as far off as
    `b` says.
    Returns by how much [rad] the first joint's last run repeats worse than it is measured: it is done again from one
    encoder count away."""
    import mujoco

    from dexsim.actuator.columns import INDEX as SERVO_INDEX
    from dexsim.actuator.table import ServoTable
    from dexsim.gap.judge.full_model import World, free_runs
    from dexsim.gap.plant.case import REFERENCE

    table = servo(b)
    true = {}
    for joint, mine in zip(b["joints"], (change, b["off"]), strict=False):
        columns = dict(table["joints"]["*"])
        for key, value in mine.items():
            name = key.lstrip("+*")
            if name in SERVO_INDEX:
                believed = columns.get(name, 0.0)
                columns[name] = float(
                    believed * value if key[0] == "*" else believed + value if key[0] == "+" else value
                )
        if mine.get("coupling"):
            columns["coupling_from"] = 1
        table["joints"][joint] = columns
        # mass and length such that gravity is off by its factor and the inertia, the rotor's share too, by its own
        gravity, inertia = mine.get("*gravity_scale", 1.0), mine.get("*inertia_scale", 1.0)
        true[joint] = {"mass": b["mass"] * gravity**2 / inertia, "length": b["length"] * inertia / gravity,
                       "payload": mine.get("payload", 0.0),
                       "rotor": b["rotor"] * inertia + mine.get("+armature", 0.0)}  # fmt: skip
    spec = mujoco.MjSpec.from_string(model_xml(b, true))
    tilt = change.get("tilt_y", 0.0)
    spec.option.gravity = [-9.81 * np.sin(tilt), 0.0, -9.81 * np.cos(tilt)]
    drives, J = ServoTable.from_dict(table), len(b["joints"])
    rows = drives.nominal(b["joints"])

    def world(r, start: float) -> World:
        warmth = None if r.temperature is None else (r.t, r.temperature - REFERENCE)
        return World(
            rows,
            drives,
            np.asarray(spec.option.gravity),
            SECONDS,
            np.full(J, start),
            np.zeros(J),
            r.cmd[0].copy(),
            r.cmd_t,
            r.cmd,
            None,
            warmth,
        )

    step = FINE if change.get("backlash") or change.get("softness") else STEP
    made = free_runs(
        spec,
        b["joints"],
        [*(world(r, 0.0) for r in runs), world(runs[-1], QUANTUM)],
        "cpu",
        step,
        "mujoco",
        torque=True,
    )
    at = lambda x, r: np.stack([np.interp(r.t, step * np.arange(len(y)), y) for y in x.T], 1)  # noqa: E731
    for r, (q, tau) in zip(runs, made, strict=False):
        r.q, r.torque = at(q, r), at(tau, r)
    return float(np.sqrt(np.mean((at(made[-1][0], runs[-1]) - runs[-1].q)[:, 0] ** 2) / 2))


def _not_the_hardest_last(b: dict, runs: list) -> list:
    """Return the runs such that the one that is held out asks for much, but for the most in nothing: what it alone
    reaches (a limit, braking at full speed) could be known by nobody. By the largest errors, speeds and torques of
    the loop as
    believed, of which each has one run that leads: of four runs one is always left."""
    _simulate(b, runs, [b["off"]], 1e-3, 2)
    reached = np.array(
        [
            [
                np.percentile(np.abs(x), 99.5)
                for x in ((r.command_at(r.t) - r.q)[:, 0], np.gradient(r.q[:, 0], r.t), r.torque[:, 0])
            ]
            for r in runs
        ]
    )
    reached /= reached.max(0)
    share = np.where((reached == 1.0).any(1), 0.0, reached.mean(1))
    last = int(np.argmax(share))
    out = [r for k, r in enumerate(runs) if k != last] + [runs[last]]
    for name, r in zip("abcd", out, strict=True):
        r.name = f"{name}.mcap"
    return out


def _off(rng: np.random.Generator, b: dict) -> dict:
    """Return what the believed figures are off by, as plant columns: draws from the tolerance that the tool states for
    each."""
    from dexsim.gap.rules import BELIEF

    def draw(centre: float, sd: float, low: float, high: float) -> float:
        while not low <= (x := rng.normal(centre, sd)) <= high:
            pass
        return float(x)

    # the simulator's limit goes by the motor's own speed
    far = BELIEF.tolerance
    off = {f"*{k}": draw(1.0, 0.5 * far, 1 - far, 1 + far) for k in REFIT} | {"limit_speed": 0.0}
    off |= {
        "+delay": draw(0.0, BELIEF.late / 3 / RATE, 0.0, BELIEF.late / RATE),
        "+lag": draw(0.25 / RATE, 0.25 / RATE, 0.0, 1.0 / RATE),
    }
    return off | ({"+speed_lag": draw(1.0 / RATE, 0.3 * BELIEF.filter, 0.0, BELIEF.filter)} if b["kd"] > 0 else {})


def _left(case, q: np.ndarray, none: np.ndarray, noise: float) -> float:
    """Return what is left of recordings q [n], simulated in the search's own plant, in times the noise, when all
    that the
    tool refits with every hypothesis is fitted to the first three: of those or of the last, whichever is less (what
    only the last shows could be known by nobody, what it does not show not be judged). Begun at the values under the
    effect; none [C]: without it."""
    from dexsim.gap.plant.columns import INDEX
    from dexsim.gap.search.fit import Fitter, Residuals, expand
    from dexsim.gap.search.search import JointSearch

    plant = case.plant
    params = [
        p for p in JointSearch(case, [0, 1, 2], None, [0, 1, 2, 3]).all_nuisances if p.columns[0] != "effort_gain"
    ]
    base = plant.base()[0]
    x = [
        none[c] / base[c] if p.mode == "factor" else none[c] - base[c] if p.mode == "add" else none[c]
        for p in params
        for c in [INDEX[p.columns[0]]]
    ]
    r = Residuals(noise, huber=5.0)
    fitter, all_four = Fitter(plant, plant.windows(None, [0, 1, 2]), r), plant.windows(None)
    fitter.q = q[fitter.w.sample_row]
    best = min(
        (fitter.fit(params, x0=x0, iterations=6, tolerance=1e-2) for x0 in (np.array(x), None)), key=lambda f: f.loss
    )
    miss = plant.simulate(expand(plant, params, best.x[None]), all_four)[0][0] - q
    each = [float(np.sqrt(np.mean(miss[rows] ** 2))) for rows in (plant.run_of < 3, plant.run_of == 3)]
    return float(np.hypot(min(each), noise) / noise)


def _sized(case, tries: list[dict], q: np.ndarray, noise: float, wanted: float) -> tuple[int, float]:
    """(number, x noise) of the change of tries[1:], growing, that is nearest to what is wanted, by halving: what is
    left grows with the size."""
    base = case.plant.base()[0]
    none = _apply(base, tries[0])
    known: dict[int, float] = {}

    def of(i: int) -> float:
        if i not in known:
            known[i] = _left(case, q[i], none, noise)
        return known[i]

    low, high = 0, len(tries) - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if of(middle) < wanted else (low, middle)
    pick = min((i for i in (low, high) if i > 0), key=lambda i: abs(np.log(of(i) / wanted)))
    return pick, of(pick)


def make(entry: dict, number: int, seed: int, folder: Path) -> dict:
    """Writes a case's recordings, model and servo to `folder`; returns what is hidden in them."""
    from dexsim.recording import Writer

    rng = np.random.default_rng([seed, 2, number])
    kind = PLANTS.get(entry["kind"])
    needs = kind.needs if kind else ""
    for _ in range(DRAWS):
        b = rig(rng, needs)
        b["off"] = _off(rng, b)
        extra = rng.uniform(2e-4, 5e-4)
        noise = float(np.hypot(QUANTUM / np.sqrt(12), extra))
        runs = _not_the_hardest_last(b, _runs(b, rng, needs))
        size, ratio, change = 0.0, 1.0, dict(b["off"])
        if kind:
            sizes = np.geomspace(*kind.span, 24)
            tries = [b["off"], *(_joined(b["off"], kind.change(b, s)) for s in sizes)]
            cases, q, _ = _simulate(b, runs, tries, 1e-3, 2)
            if kind.effect == "current_sensor":  # shows in the effort alone: sized by the noise of that
                reached = [1 + abs(x) * 20 for x in sizes]
                pick = 1 + int(np.argmin(np.abs(np.log(np.array(reached) / TIERS[entry["tier"]]))))
                ratio = reached[pick - 1]
            else:
                pick, ratio = _sized(cases[0], tries, q, noise, TIERS[entry["tier"]])
            size, change = float(sizes[pick - 1]), tries[pick]
        floor = float(np.hypot(noise, _by_mujoco(b, runs, change)))
        if floor < REPEATS * noise:
            break
    effort = "effort" in needs or bool(rng.uniform() < 0.4)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.xml").write_text(model_xml(b), encoding="utf-8")
    (folder / "servo.yaml").write_text(yaml.safe_dump(servo(b), sort_keys=False), encoding="utf-8")
    meta = {
        "source": "sim",
        "robot": "rig",
        "gravity": "0 0 -9.81",
        "effort_is": "torque_Nm" if effort else "none",
        "effort_sign": "+1",
    }
    for r in runs:
        q = np.round((r.q + rng.normal(0, extra, r.q.shape)) / QUANTUM) * QUANTUM
        tau = r.torque + rng.normal(0, 0.01 * b["weight"], r.q.shape)
        tau = change.get("effort_gain", 1.0) * tau + change.get("effort_offset", 0.0)
        with Writer(folder / r.name, list(b["joints"]), meta, 1_000_000_000) as w:
            rows = [(t, 0, c, None, None) for t, c in zip(r.cmd_t, r.cmd, strict=True)]
            rows += [(t, 1, x, u, None if r.temperature is None else h) for t, x, u, h in
                     zip(r.t, q, tau, r.temperature if r.temperature is not None else q, strict=True)]  # fmt: skip
            for t, which, x, u, h in sorted(rows, key=lambda row: row[:2]):
                if which == 0:
                    w.add_command(t, x)
                    continue
                w.add_state(t, x, None, u if effort else None)
                if h is not None:
                    w.add_temperature(t, h)
    return {**entry, "effect": kind.effect if kind else "none", "joint": "joint", "size": size, "ratio": ratio,
            "noise": noise, "floor": floor,
            "truth": kind.truth({**b, **_believed_now(b)}, size) if kind else {}, "voltage": b["voltage"],
            "effort": effort}  # fmt: skip


def _believed_now(b: dict) -> dict:
    """Return the true values under the effect, of the figures that are a little off and that an effect adds to."""
    return {
        k: b[k] * b["off"][f"*{k}"] for k in ("coulomb_friction", "viscous_friction", "torque_limit", "no_load_speed")
    }


def _joined(off: dict, change: dict) -> dict:
    """Return both changes, factors on the same column multiplied, additions to it added."""
    out = dict(off)
    for k, v in change.items():
        out[k] = v if k not in out else out[k] * v if k[0] == "*" else out[k] + v if k[0] == "+" else v
    return out


def score(truth: dict, d: dict) -> dict:
    """Return what the table needs of one diagnosis (as diagnosis.json holds it)."""
    from dexsim.gap.effects.catalogue import confusable

    found = d.get("findings", [])
    first = found[0] if found else None
    out = {**{k: truth[k] for k in ("kind", "effect", "tier", "ratio", "size", "noise", "floor")},
           "verdict": d["verdict"],
           "said": [f["effect"] for f in found], "confidence": first["confidence"] if first else None,
           "set": first["indistinguishable"] if first else []}  # fmt: skip
    out["wrong_sure"] = any(
        f["confidence"] >= 0.8 and len(f["indistinguishable"]) < 2 and f["effect"] != truth["effect"] for f in found
    )
    h = d.get("held_out") or {}
    if h.get("after") is not None and h["error"].startswith("position"):
        out["after"] = h["after"] / truth["floor"]
    if truth["effect"] == "none":
        out["false_alarm"] = bool(found) or d["verdict"] not in ("none",)
        return out
    group = set(first["indistinguishable"]) | {first["effect"]} if first else set()
    justified = (
        truth["effect"] in group and len(group) <= 3 and all(confusable(a, b) for a in group for b in group if a != b)
    )
    out["right"] = bool(
        first and (first["effect"] == truth["effect"] or justified) and first["where"]["joints"] == [truth["joint"]]
    )
    out["joint"] = bool(first and first["where"]["joints"] == [truth["joint"]])
    mine = next((f for f in found if f["effect"] == truth["effect"]), None)
    out["errors"], out["covered"], out["of_half"], out["missing"] = {}, {}, {}, []
    for key, value in truth["truth"].items():
        p = (mine or {}).get("parameters", {}).get(key)
        if mine is None:
            continue
        if p is None:
            out["missing"].append(key)
            continue
        if isinstance(value, str):
            out["errors"][key] = 0.0 if p["value"] == value else 1.0
            continue
        got, low, high, true = (np.atleast_1d(np.asarray(x, float)) for x in (p["value"], p["low"], p["high"], value))
        out["errors"][key] = float(np.linalg.norm(got - true) / max(np.linalg.norm(true), 1e-12))
        k = int(np.argmax(np.abs(true)))  # of a vector the component that was planted
        out["covered"][key] = bool(low[k] <= true[k] <= high[k])
        half = high[k] - got[k] if true[k] > got[k] else got[k] - low[k]
        out["of_half"][key] = float(abs(true[k] - got[k]) / max(half, 1e-12))
    return out


def _one(job: tuple) -> dict:
    """Makes, diagnoses and scores one case, or reads what was done before."""
    number, entry, s = job
    root = Path(s["out"]) / f"seed_{s['seed']}"
    done = root / "results" / f"{number}.json"
    if done.is_file():
        return json.loads(done.read_text(encoding="utf-8"))
    os.environ["OMP_NUM_THREADS"] = "1"
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    from dexsim.gap.diagnosis import Settings, diagnose, save

    folder = root / "cases" / str(number)
    truth = make(entry, number, s["seed"], folder)
    start, cpu = time.perf_counter(), time.process_time()
    try:
        d = diagnose(Settings([folder / f"{x}.mcap" for x in "abc"], folder / "out", [folder / "d.mcap"],
                              str(folder / "rig.xml"), str(folder / "servo.yaml"),
                              next_recording=False, replay="none"), say=lambda _: None)  # fmt: skip
        save(d, folder / "out")
        data = json.loads((folder / "out" / "diagnosis.json").read_text(encoding="utf-8"))
        shares = d.shares
    except Exception as error:  # counted, not dropped: no answer is a wrong one
        data, shares = {"verdict": f"failed: {type(error).__name__}: {error}", "findings": [], "held_out": None}, {}
    result = {
        "number": number,
        **score(truth, data),
        "seconds": time.perf_counter() - start,
        "cpu": time.process_time() - cpu,
        "shares": shares,
    }
    done.parent.mkdir(parents=True, exist_ok=True)
    done.write_text(json.dumps(result), encoding="utf-8")
    return result


def table(results: list[dict]) -> dict:
    """Return the figures of the JSON line."""
    planted = [r for r in results if r["effect"] != "none"]
    rate = lambda x: round(float(np.mean(x)), 3) if len(x) else None  # noqa: E731
    covered = [c for r in planted for c in r["covered"].values()]
    errors = [e for r in planted for e in r["errors"].values()]
    of_half = [e for r in planted for e in r["of_half"].values()]
    out = {"right": rate([r["right"] for r in planted])}
    out |= {f"right_{t}": rate([r["right"] for r in planted if r["tier"] == t]) for t in TIERS}
    out |= {"joint": rate([r["joint"] for r in planted]), "coverage": rate(covered),
            "parameter_error_median": round(float(np.median(errors)), 4) if errors else None,
            "error_of_half_width_median": round(float(np.median(of_half)), 3) if of_half else None,
            "parameters": len(covered), "within_1.3_floor": rate([r["after"] <= 1.3 for r in planted if "after" in r]),
            "false_alarms": rate([r["false_alarm"] for r in results if r["effect"] == "none"]),
            "nothing_planted": sum(r["effect"] == "none" for r in results),
            "confident_and_wrong": rate([r["wrong_sure"] for r in results]),
            "failed": sum(r["verdict"].startswith("failed") for r in results),
            "keys_missing": sorted({f"{r['effect']}.{k}" for r in planted for k in r["missing"]}),
            "seconds_median": round(float(np.median([r["seconds"] for r in results])), 1),
            "cpu_median": round(float(np.median([r["cpu"] for r in results])), 1)}  # fmt: skip
    stages: dict[str, float] = {}
    for r in results:
        for k, v in r["shares"].items():
            stages[k] = stages.get(k, 0.0) + v
    total = sum(stages.values()) or 1.0
    out["shares"] = {k: round(v / total, 3) for k, v in stages.items()}
    return out


def show(results: list[dict]) -> str:
    """Return one line a case."""
    out = [
        f"{'no':>4} {'planted':<31}{'tier':<7}{'x noise':>7}  {'verdict':<17}{'found':<42}{'after':>6}"
        f" {'sizes: error (covered)'}"
    ]
    for r in sorted(results, key=lambda r: (r["effect"], r["kind"], r["ratio"])):
        mark = " " if r.get("right", not r.get("false_alarm")) else "*"
        said = (
            " ".join(r["said"][:3])
            + (f" {r['confidence']:.2f}" if r["said"] else "-")
            + (f" {{{' '.join(r['set'])}}}" if len(r["set"]) > 1 else "")
        )
        sizes = ", ".join(
            f"{k} {e:.0%}{'' if r['covered'].get(k, True) else '!'}" for k, e in r.get("errors", {}).items()
        )
        out.append(
            f"{r['number']:>4} {r['kind'] or 'nothing':<31}{r['tier']:<7}{r['ratio']:>7.1f}"
            f" {mark}{r['verdict'][:16]:<17}{said:<42}{r.get('after', 0):>6.2f} {sizes}"
        )
    return "\n".join(out)


def main(argv: list[str]) -> dict:
    """Runs the sweep; returns what the JSON line says."""
    s = options(argv, SETTINGS)
    s["out"] = str(Path(s["out"]).expanduser().resolve())
    effects = {e for e in s["effects"].split(",") if e}
    unknown = effects - set(PLANTS) - {p.effect for p in PLANTS.values()}
    if unknown:
        raise UserError(
            f"effects={s['effects']}: {', '.join(sorted(unknown))} is not planted; valid: {', '.join(PLANTS)}"
        )
    entries = plan(s["seed"], effects)
    count = s["cases"] or sum(not effects or p.effect in effects or n in effects for n, p in PLANTS.items()) + (
        0 if effects else NONE_EACH
    )
    jobs = [(n, entries[n], s) for n in range(s["first"], s["first"] + count)]
    start = time.perf_counter()
    results = []
    if s["workers"] > 1:
        from dexsim.gap.plant.kernel import plant_kernel  # compiled once, before the workers ask for it all at once

        _warm(plant_kernel)
        with mp.get_context("spawn").Pool(min(s["workers"], len(jobs)), maxtasksperchild=8) as pool:
            stream = pool.imap_unordered(_one, jobs)
            results = _watch(stream, len(jobs), start, s["limit"])
    else:
        results = _watch(map(_one, jobs), len(jobs), start, s["limit"])
    print("\n" + show(results))
    line = {
        "benchmark": "planted",
        "seed": s["seed"],
        "cases": len(results),
        "wall": round(time.perf_counter() - start, 1),
        **table(results),
    }
    print(json.dumps(line))
    return line


def _warm(kernel) -> None:
    import warp as wp

    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    wp.load_module(module=kernel().module, device="cpu")


def _watch(stream, total: int, start: float, limit: float) -> list[dict]:
    """Return results as they come, until all are there or `limit` [s] is over (0: no limit)."""
    out: list[dict] = []
    with tqdm(total=total, desc="cases") as bar:
        while len(out) < total:
            remaining = limit - (time.perf_counter() - start) if limit else None
            try:
                if remaining is not None and remaining <= 0:
                    raise mp.TimeoutError
                out.append(stream.next(remaining) if hasattr(stream, "next") else next(stream))
            except mp.TimeoutError:
                bar.write(f"{limit:g} s are over: {len(out)} of {total} cases are done")
                break
            bar.update()
    return out


if __name__ == "__main__":
    sys.exit(guard(lambda argv: 0 if main(argv) else 1, sys.argv[1:], __doc__))
