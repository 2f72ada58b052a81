"""Planted effects: effects of a joint, hidden in recordings of our own simulator, and found again.

    python -m benchmarks.planted [cases=40] [seed=source] [jobs=1] [limit=300] [until=0] [out=out/planted]

Training and recordings share one simulator here, so this is a sanity check of `diagnose`. Each case is a pendulum of
random size on a servo whose believed figures are each up to 3 % off. Three recordings are fitted, one is held out;
readings come as a bus gives them. Effects and three sizes take turns, with nothing planted in every sixth case. The
effect alone changes the motion by 16, 8 or 4 times the noise of the readings; a refit leaves about half of that. seed:
a number, or `source`: read off the sources. limit: seconds that a diagnosis may take; until: seconds after which
nothing more is begun (0: no limit). Resumable: what is in out=/seed_N is read. Prints a line a case, a table and one
JSON line.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks import answers
from benchmarks.concealed import generate, score
from dexsim.console.ending import guard

TIERS = {"large": 16.0, "medium": 8.0, "small": 4.0}  # x the noise
NOISE = 6e-4  # rad: of the readings, a 4096th of a turn and its jitter
NONE_EVERY = 6  # of so many cases one has nothing planted
OFF = 0.03  # how far off each believed figure may be
SECONDS, STEP = 7.0, 5e-4  # s of a recording, of the physics
RECORDINGS = ("a", "b", "c", "d")  # the last is held out
SETTINGS = {"cases": 40, "seed": "source", "jobs": 1, "limit": 300, "until": 0, "out": "out/planted"}
Figures = dict[str, float]
"""Of a rig: its servo's columns, and mass [kg], length [m], rotor [kg.m2], weight [N.m]."""

PLANTS: dict[str, tuple[float, float, Callable[[Figures, float], Figures]]] = {
    "coulomb_friction": (0.01, 1.0, lambda b, s: {"coulomb_friction": b["coulomb_friction"] + s * b["weight"]}),
    "stribeck_friction": (0.01, 1.2, lambda b, s: {"stribeck_peak": s * b["weight"], "stribeck_speed": 0.25}),
    "viscous_friction": (0.01, 1.0, lambda b, s: {"viscous_friction": b["viscous_friction"] + 0.2 * s * b["weight"]}),
    "load_friction": (0.02, 0.8, lambda b, s: {"load_friction": s, "load_friction_backdriven": 1.4 * s}),
    "backlash": (0.003, 0.3, lambda b, s: {"backlash": s}),
    "compliance": (0.03, 2.0, lambda b, s: {"softness": s / b["kp"]}),
    "command_delay": (0.002, 0.1, lambda b, s: {"delay": s}),
    "lag": (0.001, 0.1, lambda b, s: {"lag": s}),
    "setpoint_profile": (0.02, 0.93, lambda b, s: {"profile_speed": 8 * (1 - s),
                                                   "profile_acceleration": 80 * (1 - s) / s}),
    "torque_limit": (0.05, 0.9, lambda b, s: {"torque_limit": b["torque_limit"] * (1 - s)}),
    "torque_speed_limit": (0.06, 0.93, lambda b, s: {"no_load_speed": b["no_load_speed"] * (1 - s)}),
    "torque_ripple": (0.01, 1.0, lambda b, s: {"torque_ripple": s * b["weight"], "ripple_per_turn": 11.0}),
    "position_scale": (0.005, 0.3, lambda b, s: {"position_scale": 1 + s}),
    "payload": (0.06, 2.0, lambda b, s: {"mass": b["mass"] * (1 + s)}),
    "inertia": (0.06, 5.0, lambda b, s: {"rotor": b["rotor"] + s * b["mass"] * b["length"] ** 2}),
    "gain_mismatch": (0.06, 0.7, lambda b, s: {"kp": b["kp"] * (1 - s)}),
    "deadband": (0.002, 0.3, lambda b, s: {"deadband": s}),
    "controller_term": (0.05, 3.0, lambda b, s: {"speed_feedforward": s * b["kd"]}),
}  # fmt: skip
"""By effect of the catalogue: the smallest and largest size, and the figures that a size changes."""
IN_THE_GEAR = ("backlash", "compliance")  # they show where the loop reads the motor
BODY = ("mass", "length", "rotor", "weight")
MODEL = """<mujoco model="rig"><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body name="link"><joint name="joint" type="hinge" axis="0 1 0" armature="{rotor:.6g}" range="-3 3"/>
<geom name="bob" type="sphere" size="0.012" pos="0 0 -{length:.6g}" mass="{mass:.6g}" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>
"""


def plan(seed: int, count: int = 400) -> list[dict[str, str]]:
    """Return effect and tier ("none" both where nothing is planted) of each case: all effects in a drawn order, again
    and again."""
    rng, out, order = np.random.default_rng([seed, 1]), [], []
    for k in range(count):
        if k % NONE_EVERY == NONE_EVERY - 1:
            out.append({"effect": "none", "tier": "none"})
            continue
        order = order or rng.permutation(list(PLANTS)).tolist()
        out.append({"effect": order.pop(), "tier": list(TIERS)[len(out) % 3]})
    return out


def rig(rng: np.random.Generator) -> Figures:
    """Draw the believed figures of a pendulum on a servo."""
    b = {"mass": rng.uniform(0.08, 0.3), "length": rng.uniform(0.07, 0.14), "rotor": rng.uniform(2e-4, 8e-4)}
    b["weight"] = b["mass"] * 9.81 * b["length"]
    b |= {"torque_limit": b["weight"] * rng.uniform(4, 8), "no_load_speed": rng.uniform(9, 18)}
    b["kp"] = b["weight"] * rng.uniform(6, 14)
    b["kd"] = 2 * rng.uniform(0.3, 0.6) * np.sqrt(b["kp"] * (b["mass"] * b["length"] ** 2 + b["rotor"]))
    b["coulomb_friction"] = b["weight"] * rng.uniform(0.04, 0.1)
    b["viscous_friction"] = b["weight"] * rng.uniform(0.005, 0.02)
    return {k: float(v) for k, v in b.items()}


def servo(b: Figures, effect: str) -> dict[str, Any]:
    """Return the table of a rig's servo. How the simulator's drives brake is stated, and not to be guessed."""
    columns = {k: float(v) for k, v in b.items() if k not in BODY} | {"braking_slope": 1.0}
    loop = "motor" if effect in IN_THE_GEAR else "joint"
    return {"drive": "torque", "joints": {"*": columns}, "loop_rate": 1000, "loop_encoder": loop,
            "position_encoder": "joint"}  # fmt: skip


def motion(rng: np.random.Generator, kind: int) -> np.ndarray:
    """Return the targets sent at 100 Hz [K]: steps, ramps and a chirp, in another order by `kind`."""
    t = np.arange(0.0, SECONDS, 0.01)
    ramp, step, chirp = generate.courses(rng, t, 40, 0.9, (0.12, 0.3), (1.5, 3.0))
    return generate.in_turn([[ramp, step, chirp], [chirp, ramp, step], [step, chirp, ramp], [ramp, chirp, step]][kind])


def driven(folder: Path, b: Figures, effect: str, commands: Any) -> tuple[Any, Any]:
    """Return a rig as a mechanism, and its run in C MuJoCo under commands."""
    from dexsim.recording.mechanism import drive, mechanism

    path = folder / "true.xml"
    path.write_text(MODEL.format(**b), encoding="utf-8")
    m = mechanism(path, servo(b, effect))
    path.unlink()
    return m, drive(m, commands, ("joint",), SECONDS, initial=np.zeros(1), timestep=STEP)


def sized(folder: Path, b: Figures, effect: str, wanted: float, commands: Any) -> tuple[Figures, float]:
    """Return the figures with the effect, and by how much [rad, rms] it changes the motion under commands: by what is
    nearest to `wanted`, halving between the sizes of PLANTS."""
    low, high, apply = PLANTS[effect]
    plain, tried = driven(folder, b, effect, commands)[1].position, []
    for _ in range(7):
        size = float(np.sqrt(low * high))
        changed = b | apply(b, size)
        moved = float(np.sqrt(np.mean((driven(folder, changed, effect, commands)[1].position - plain) ** 2)))
        tried.append((changed, moved))
        low, high = (size, high) if moved < wanted else (low, size)
    return min(tried, key=lambda x: abs(np.log(max(x[1], 1e-9) / wanted)))


def make(entry: dict[str, str], number: int, seed: int, folder: Path) -> dict[str, Any]:
    """Write a case's recordings, model and servo to a folder; return what is hidden in them."""
    from dexsim.recording import write
    from dexsim.recording.mechanism import recorded
    from dexsim.recording.realistic import realistic
    from dexsim.recording.schema import COMMANDS, Series

    folder.mkdir(parents=True, exist_ok=True)
    rng, effect = np.random.default_rng([seed, 2, number]), entry["effect"]
    believed = rig(rng)
    (folder / "rig.xml").write_text(MODEL.format(**believed), encoding="utf-8")
    (folder / "servo.yaml").write_text(yaml.safe_dump(servo(believed, effect), sort_keys=False), encoding="utf-8")
    true = {k: v * (1 + rng.uniform(-OFF, OFF)) for k, v in believed.items()}
    t = np.arange(0.0, SECONDS, 0.01)
    commands = [Series(t, motion(rng, k)[:, None], COMMANDS, t.copy()) for k in range(len(RECORDINGS))]
    moved = 0.0
    if effect != "none":
        true, moved = sized(folder, true, effect, TIERS[entry["tier"]] * NOISE, commands[-1])
    for k, name in enumerate(RECORDINGS):
        m, run = driven(folder, true, effect, commands[k])
        seen = realistic(recorded(run, m, commands[k], ("joint",)), seed=int(rng.integers(1 << 30)))
        seen.meta |= {"source": "real", "servo": ""}  # what is hidden is not told
        write(folder / f"{name}.mcap", seen)
    return {**entry, "times_noise": moved / NOISE}


def case(job: tuple[int, dict[str, Any], Path, float]) -> dict[str, Any] | None:
    """Return a case's row: made, diagnosed and scored; None where there was no time for it."""
    from dexsim.sim.quiet import quiet_warp

    number, s, out, ends = job
    if time.time() > ends:
        return None
    quiet_warp("cpu")
    folder = out / "cases" / str(number)
    truth = make(plan(s["seed"])[number], number, s["seed"], folder)
    said = answers.diagnosed(answers.ROOT, words(folder), out / "answers" / str(number), s["limit"], ends)
    if said is None:
        return None
    first = next(({"effect": f[0], "indistinguishable": f[3]} for f in said["findings"]), None)
    right = first is None if truth["effect"] == "none" else score.named_right(first, truth["effect"])
    return {"set": "planted", "number": number, **truth, **said,
            "sure_and_wrong": answers.sure_and_wrong(said, [truth["effect"]]), "right": right}  # fmt: skip


def words(folder: Path) -> list[str]:
    """Return the settings of `diagnose` on a case."""
    files = [str(folder / f"{name}.mcap") for name in RECORDINGS]
    return [f"recordings=[{','.join(files[:-1])}]", f"held_out=[{files[-1]}]", f"model={folder / 'rig.xml'}",
            f"servo={folder / 'servo.yaml'}"]  # fmt: skip


def table(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return the figures: right effect first by tier, names where nothing is planted, confident and wrong."""
    of = lambda test, these: f"{sum(map(test, these))} of {len(these)}"  # noqa: E731
    out = {f"right_{t}": of(lambda r: r["right"], [r for r in rows if r["tier"] == t]) for t in TIERS}
    out["false_alarms"] = of(lambda r: not r["right"], [r for r in rows if r["tier"] == "none"])
    return out | {"confident_and_wrong": of(lambda r: r["sure_and_wrong"], rows)}


def main(argv: Sequence[str]) -> int:
    """Run the cases and print them; return the exit status."""
    s, engine = answers.settings(argv, SETTINGS)
    ends = time.time() + (s["until"] or 1e9)
    out = Path(s["out"]).expanduser().resolve() / f"seed_{s['seed']}"
    cases = {("planted", k): (k, s, out, ends) for k in range(s["cases"])}
    rows = answers.each(case, cases, out / "cases.jsonl", engine)
    for r in sorted(rows, key=lambda r: (r["effect"], r["times_noise"])):
        found = ", ".join(f"{f[0]} {f[2]:.2f}" for f in r["findings"][:3]) or "-"
        print(f"{r['number']:>4} {r['effect']:<20}{r['tier']:<8}{r['times_noise']:>6.1f} {' ' if r['right'] else '*'}"
              f"{r['verdict']:<18}{found} ({r['seconds']:.0f} s)")  # fmt: skip
    print(json.dumps({"benchmark": "planted", "seed": s["seed"], "cases": len(rows), **table(rows)}))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
