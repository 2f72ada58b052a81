"""Large effects hidden in the transmission of one drive of a coupled hand, and what `dexsim diagnose` says of them.

    python -m benchmarks.hidden_drives hands=hands/inspire,hands/shadow [cases=20] [seed=1] [jobs=1] [limit=600]
    [out=out/hidden_drives]

Each case draws a hand, a drive that other joints follow (by mimic, equality or tendon; any drive where none does), and
play, dry friction or elasticity between that drive and its joints. Two drives move, the one with the effect and
another, and the diagnosis is asked about these. The effect alone changes the drive's motions by 16 to 32 times the
noise of the readings. Of the three kinds, those that cannot do so with a drive that still moves are not drawn (a light
finger winds up no spring). The hand is C MuJoCo's model with all of its coupled joints, which the diagnosis does not
simulate; its loop reads the motor, the recording has the joint and the motor's current, whose scale is known (`dexsim
calibrate` measures it); its gains, limits and friction are each up to 3 % off what is believed; readings come as a bus
gives them (rate, jitter, counts, milliamperes). seed: a number, or `source`: read off the sources. Named: the first
finding is this effect of this drive and of no other. Resumable: what is in out=/seed_N is read. Prints a line a case,
and one of JSON.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks import answers
from dexsim.console.ending import guard
from dexsim.errors import UserError

SETTINGS = {"hands": "", "cases": 20, "seed": "1", "jobs": 1, "limit": 600, "out": "out/hidden_drives"}
KINDS = {"play": "backlash", "friction": "coulomb_friction", "elasticity": "compliance"}
"""What is hidden, and the effect of the catalogue that it is."""
OFF = 0.03  # how far off each believed figure may be
MOVED = 2  # drives that a recording moves
DRAWS = 9  # of a case that can be, at most
NOISE = 6e-4  # rad: of the readings, a 4096th of a turn and its jitter; a slide goes through its range in one turn
LARGE = (16.0, 32.0)  # times that, in what the effect alone changes; what a refit leaves of it is about half
SIZED = 40.0  # s of the drive's own motions in the first recording that it is sized on
MOST = {"play": 0.2, "friction": 0.4, "elasticity": 1.5}
"""Of what `sized` measures it by: a drive with more does hardly move."""
RECORDINGS = {"a": ("triangles", "steps"), "b": ("chirp", "ladder"), "c": ("random", "triangles")}
"""Kinds of motion of each; the last is held out."""


def drives(hand: Any) -> list[str]:
    """Return names of a hand's drives that other joints follow; all of them where none does."""
    data = mujoco.MjData(hand.compiled)
    hand.couplings.put(data, hand.pose("cupped"))  # bent: a tendon may be slack at rest
    moves = hand.couplings.motion(data.qpos)
    others = np.ones(hand.compiled.nv, bool)
    others[hand.couplings.dof] = False
    led = [j for k, j in enumerate(hand.joints) if np.abs(moves[others, k]).max(initial=0.0) > 1e-3]
    return led or list(hand.joints)


def sized(true: Any, hidden: str, kind: str, least: float, p: Any, span: float) -> dict[str, float]:
    """Return the column of the servo that has the effect, and its value; empty where the largest one tried does less
    than `least`. It grows by halves from a hundredth of the drive's range (play), of its torque limit (friction), or of
    the deflection that the loop's own gain allows at a torque (elasticity) to MOST of it, until the motions of `hidden`
    in a plan `p` differ from those without by `least` rad or m (standard deviation)."""
    from dexsim.recording.mechanism import drive
    from dexsim.recording.schema import Series

    k = true.joints.index(hidden)
    column, unit = {"play": ("backlash", span), "friction": ("coulomb_friction", true.column("torque_limit")[k]),
                    "elasticity": ("softness", 1 / true.column("kp")[k])}[kind]  # fmt: skip
    before = true.table.value(hidden, column).value or 0.0
    rows = np.concatenate([np.flatnonzero((p.t >= s.start) & (p.t <= s.end)) for s in p.segments if hidden in s.joints])
    rows = rows[: int(SIZED / np.diff(p.t).mean())]
    commands = Series(p.t[: len(rows)], p.value[rows])

    def moved(value: float) -> np.ndarray:
        true.table.set(hidden, column, before + value)
        return drive(true, commands, true.joints, float(commands.t[-1]), initial=p.home, timestep=0.002).position[:, k]

    plain, value = moved(0.0), 0.01 * unit
    while np.std(moved(value) - plain) < least:  # a gap that a load never leaves is an offset, and nothing else
        value *= 1.5
        if value > MOST[kind] * unit:
            true.table.set(hidden, column, before)
            return {}
    return {column: float(before + value)}


def make(folder: Path, which: Path, rng: np.random.Generator) -> dict[str, Any]:
    """Write the recordings of a hand with a hidden effect into a folder; return the truth."""
    from dexsim.hand import load_hand
    from dexsim.recording import write
    from dexsim.recording.excitation import plan
    from dexsim.recording.mechanism import drive, of_hand, recorded
    from dexsim.recording.realistic import CURRENT_PER_TORQUE, Hardware, realistic
    from dexsim.recording.schema import COMMANDS, Series
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    hand = load_hand(which)
    slides = hand.compiled.jnt_type[[hand.compiled.joint(j).id for j in hand.joints]] == mujoco.mjtJoint.mjJNT_SLIDE
    radius = np.where(slides, np.ptp(hand.limits, axis=1) / (2 * np.pi), 1.0)  # m a rad of the motor
    amperes = CURRENT_PER_TORQUE * float(radius.mean())  # a N m of a hinge, a N of a slide
    servo = of_hand(hand).table.to_dict() | {"loop_encoder": "motor", "current_per_torque": amperes}
    believed, true = of_hand(hand, servo), of_hand(hand, servo)
    hidden = str(rng.choice(drives(hand)))
    others = [j for j in hand.joints if j != hidden]
    moved = [hidden, *(str(j) for j in rng.permutation(others)[: MOVED - 1])]
    moved.sort(key=hand.joints.index)
    for joint in hand.joints:
        for column in ("kp", "kd", "torque_limit", "no_load_speed", "coulomb_friction"):
            if (value := true.table.value(joint, column).value) is not None:
                true.table.set(joint, column, value * (1 + rng.uniform(-OFF, OFF)))
    k = hand.joints.index(hidden)
    folder.mkdir(parents=True, exist_ok=True)
    believed.table.save(folder / "servo.yaml")
    plans = [plan(believed, moved, kinds, seed=int(rng.integers(1 << 30))) for kinds in RECORDINGS.values()]
    least = float(rng.uniform(*LARGE)) * NOISE * float(radius[k])
    bus = Hardware(position_lsb=np.append(radius, np.ones(len(hand.sensed))) * Hardware.position_lsb)
    for kind in rng.permutation(list(KINDS)).tolist():  # a light finger shows no spring in its tendon: then another
        if changed := sized(true, hidden, kind, least, plans[0], float(np.ptp(hand.limits[k]))):
            break
    else:
        raise UserError(f"hand={which}: neither play nor friction nor a spring in the drive of {hidden} shows")
    for name, p in zip(RECORDINGS, plans, strict=True):
        run = drive(true, Series(p.t, p.value), hand.joints, float(p.t[-1]), initial=p.home)
        dense = recorded(run, believed, Series(p.t, p.value, COMMANDS), hand.joints, rate=500.0)
        seen = realistic(dense, seed=int(rng.integers(1 << 30)), hardware=bus, current_per_torque=amperes)
        seen.meta["source"] = "real"
        write(folder / f"{name}.mcap", seen)
    return {"hand": str(which), "kind": kind, "effect": KINDS[kind], "joint": hidden, "moved": moved, **changed,
            "seconds": round(sum(float(p.t[-1]) for p in plans), 1)}  # fmt: skip


def score(truth: dict[str, Any], diagnosis: dict[str, Any]) -> dict[str, Any]:
    """Return what the first finding says, and whether it is the hidden effect alone, at its drive alone."""
    found = diagnosis.get("findings") or []
    first = found[0] if found else None
    right = bool(first) and first["effect"] == truth["effect"] and first["where"]["joints"] == [truth["joint"]]
    said = [f"{f['effect']} of {', '.join(f['where']['joints'])} ({f['confidence']:.2f})" for f in found]
    return {"right": right, "verdict": diagnosis["verdict"], "said": said}


def case(job: tuple[int, list[Path], int, int, Path]) -> dict[str, Any]:
    """Return a case's row: made, diagnosed and scored. job: number, hands, seed, limit [s], folder."""
    number, hands, seed, limit, out = job
    folder, rng = out / str(number), np.random.default_rng([seed, number])
    for more in reversed(range(DRAWS)):
        try:
            truth = make(folder, hands[int(rng.integers(len(hands)))], rng)
            break
        except UserError as error:  # another drive, or another hand
            if not more:
                raise
            print(f"{number:>3} drawn again: {error}", flush=True)
    return {"set": "hidden_drives", "number": number, **truth, **diagnosed(folder, truth, limit)}


def diagnosed(folder: Path, truth: dict[str, Any], limit: int) -> dict[str, Any]:
    """Return the score of `dexsim diagnose` on a folder of recordings, as a user would run it."""
    *fit, held = (str(folder / f"{n}.mcap") for n in RECORDINGS)
    words = [f"recordings=[{','.join(fit)}]", f"held_out=[{held}]", f"hand={truth['hand']}",
             f"joints=[{','.join(truth['moved'])}]", f"servo={folder / 'servo.yaml'}"]  # fmt: skip
    took = answers.ask(words, folder / "diagnosis", limit)[1]
    said = {"verdict": "failed", "findings": []}  # counted, not dropped: no answer is a wrong one
    if (file := folder / "diagnosis" / "diagnosis.json").is_file():
        said = json.loads(file.read_text(encoding="utf-8"))
    return {**score(truth, said), "diagnosis_s": round(took, 1)}


def main(argv: list[str]) -> int:
    """Run the cases; print a line of each, and how many were named."""
    s, engine = answers.settings(argv, SETTINGS)
    hands = [Path(h).resolve() for h in s["hands"].split(",") if h]
    if not hands:
        raise UserError("say which hands: hands=FOLDER,FOLDER (of dexsim import-hand)")
    seed, out = s["seed"], Path(s["out"]).resolve() / f"seed_{s['seed']}"
    given = {("hidden_drives", n): (n, hands, seed, s["limit"], out) for n in range(s["cases"])}
    rows = answers.each(case, given, out / "cases.jsonl", engine)
    for row in rows:
        print(f"{row['number']:>3} {'right' if row['right'] else 'WRONG'} {Path(row['hand']).name:<16}{row['kind']}"
              f" of {row['joint']}: {'; '.join(row['said']) or row['verdict']} ({row['diagnosis_s']:.0f} s)",
              flush=True)  # fmt: skip
    line = {"benchmark": "hidden_drives", "seed": seed, "cases": len(rows), "right": sum(r["right"] for r in rows)}
    line |= {kind: f"{sum(r['right'] for r in mine)} of {len(mine)}" for kind in KINDS
             if (mine := [r for r in rows if r["kind"] == kind])}  # fmt: skip
    print(json.dumps(line))
    (out / "results.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
