"""The steps of the loop that no entry script does: a start that may be trained on, and recordings of the hand in its reality.

    python -m benchmarks.loop.steps start checkpoint=FILE out=last.pt device=cuda [any setting of train.py]
    python -m benchmarks.loop.steps record world=late out=DIR seed=1 [own=a.mcap,b.mcap] [seconds=19]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).parents[2]
EXCITED = (("random", 0.6), ("chirp", 0.6), ("random", 0.8))
"""The excitation: motions of all joints (or of fingers) at once, since most is seen in little time, and the share of the `used` speeds
that they may reach; chirps tell a delay from a lag. Faster, a drive that is late swings into the ends of its range (docs/loop.md)."""
KEPT = 1  # of them, the last, is for the proof
CAREFUL = 0.6  # of the believed no-load speed, as `dexsim.excite` has it
FAST = ("fast.mcap", "fast_kept.mcap")  # the recordings of fast moves: one is fitted, one is for the proof
DASH = ((0.7, 0.5), (-0.7, 0.75), (1.0, 1.0), (-1.0, 0.6), (0.8, 0.9), (-0.8, 1.1), (0.5, 0.7), (0.0, 0.5))
"""Straight moves about the middle of a joint's range: to which share of the largest offset, at which share of the believed no-load speed."""
DASH_S = 0.5  # s from one to the next
LATE = {"delay": 0.05, "lag": 0.025}  # s more: drives as late as this must stay clear of the ends as well
SMALLEST = 0.05  # of a joint's range: not made smaller than that
CLEAR = 0.05  # share of a joint's range that a dash leaves free at both ends


def start(given: dict[str, str]) -> None:
    """A checkpoint to resume from, out of one that holds a policy only: its actor, a fresh critic and optimizer, nothing counted."""
    import torch

    from dexsim.cli import build, machine
    from dexsim.cli import start as settings
    from dexsim.learning import checkpoint
    from dexsim.learning.runner import Runner

    own = {k: given.pop(k) for k in ("checkpoint", "out", "device")}
    ready = settings.for_train([f"resume={own['checkpoint']}", "device=cpu", "worlds=16", "iterations=1000000", *(f"{k}={v}" for k, v in given.items())],
                               ROOT / "configs")  # fmt: skip
    env = build.build_env(ready.cfg, None, {"start": own["checkpoint"]})
    runner = Runner(env, ready.cfg, machine.versions())
    checkpoint.check_layout(ready.data, checkpoint.layout_of(env), own["checkpoint"])
    payload = runner.payload()
    payload["actor"] = ready.data["actor"]
    if own["device"].startswith("cuda"):  # a random state belongs to its kind of device
        payload["env"]["rng"] = torch.Generator("cuda").manual_seed(int(ready.cfg["seed"])).get_state()
    Path(own["out"]).parent.mkdir(parents=True, exist_ok=True)
    checkpoint.save(own["out"], payload)


def record(given: dict[str, str]) -> None:
    """Recordings of the hand in a concealed reality under safe excitation: read as its bus reads, targets late and lost as there. As fast as
    the policies' own runs there were (own=a.mcap,b.mcap), since a limit that no motion meets is not found."""
    from dexsim.recording import read
    from dexsim.recording.excitation import Limits, plan
    from dexsim.recording.mechanism import mechanism

    world, out, seed = _world(given["world"]), Path(given["out"]), int(given.get("seed", 0))
    out.mkdir(parents=True, exist_ok=True)
    believed = mechanism()
    top = used([read(p) for p in given.get("own", "").split(",") if p], believed)
    print(f"own runs: up to {top:.2f} of the believed no-load speed", flush=True)
    for k, (kind, share) in enumerate(EXCITED):
        p = plan(believed, kinds=[kind], seed=seed + k, repeats=0, limits=Limits(speed=share * top))
        if kind == "random":
            p.t, p.value = (x[p.t < float(given.get("seconds", 19.0))] for x in (p.t, p.value))
        _drive(world, believed, p.t, p.value, p.home, np.random.default_rng([seed, k]), out / f"excite_{k}.mcap")
    for k, name in enumerate(FAST):
        _drive(world, believed, *dashes(believed, (1.0, -1.0)[k]), np.random.default_rng([seed, 100 + k]), out / name)


def dashes(believed, way: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [T] s, targets [T, J] rad and home [J]: one joint of each finger at a time is led about the middle of its range, for a tenth of
    a second faster than its drive may be able to follow: a speed limit shows, which smooth motion does not reach. A step of the target
    would too, but a drive with a lag swings far past it. Simulated with the drives as believed and with drives as late as LATE; a joint's
    motion is made smaller and slower until it keeps CLEAR of the ends in both, that of a group where anything touches. way: 1, or -1 for
    the same the other way round."""
    from dexsim.recording import excitation, safety
    from dexsim.recording.mechanism import drive, mechanism
    from dexsim.recording.schema import Series
    from dexsim.recording.waveforms import minimum_jerk

    dt = 0.01
    low, high, home = excitation._range(believed, excitation.Limits())
    table = believed.table.to_dict()
    for columns in table["joints"].values():
        columns |= {k: columns[k] + v if k in columns else v for k, v in LATE.items() if k in columns or k == "lag"}
    hands = [believed, mechanism(servo=table, gravity=believed.spec.option.gravity)]
    check = safety.ContactCheck(believed, home, excitation.Limits().clearance)
    parts = [np.tile(home, (30, 1))]
    for group in excitation.groups(believed, believed.joints):
        free = {j: excitation._free(check, home, believed.joints.index(j), low, high) for j in group}
        size = {j: 0.45 for j in group}  # of the free range, either way
        while True:
            centre, body = home.copy(), np.zeros((round(DASH_S / dt) * len(DASH), len(home)))
            for j in group:
                i, wide = believed.joints.index(j), free[j][1] - free[j][0]
                centre[i], at = 0.5 * sum(free[j]), 0.0
                for k, (level, share) in enumerate(DASH):
                    first, to = round(DASH_S / dt) * k, way * level * size[j] * wide
                    move = np.arange(round(DASH_S / dt)) * dt * share * believed.speeds[i] * size[j] / 0.45
                    body[first : first + len(move), i] = at + np.sign(to - at) * np.minimum(move, abs(to - at))
                    at = to
            value = np.concatenate([minimum_jerk(home, centre, 0.8, dt), centre + body, minimum_jerk(centre, home, 0.8, dt), np.tile(home, (30, 1))])
            t = np.arange(len(value)) * dt
            over, touched = set(), False
            for hand in hands:
                run = drive(hand, Series(t, value), hand.joints, float(t[-1]), home, excitation.CHECK_STEP, frame_s=excitation.FRAME)
                for j in group:
                    x, wide = run.position[(run.t > 0.8) & (run.t < t[-1] - 1.1), believed.joints.index(j)], free[j][1] - free[j][0]
                    if size[j] > SMALLEST and (x.min() < free[j][0] + CLEAR * wide or x.max() > free[j][1] - CLEAR * wide):
                        over.add(j)
                touched = touched or bool(check.along(run))
            if touched and max(size.values()) > SMALLEST:
                over = set(group)
            if not over:
                break
            size |= {j: 0.85 * size[j] for j in over}
        print("fast: " + ", ".join(f"{j} +-{size[j] * (free[j][1] - free[j][0]):.2f}" for j in group) + (" rad, left out: touches" if touched else " rad"), flush=True)
        if not touched:
            parts.append(value)
    value = np.concatenate(parts)
    return np.arange(len(value)) * dt, value, home


def used(own: list, believed) -> float:
    """Largest speed that a joint reached in recordings (99 % of the time below it), as a share of its believed no-load speed, from
    CAREFUL to 1."""
    shares = [CAREFUL]
    for r in own:
        q = r.states.position
        speed = np.abs(np.diff(q.value, axis=0)) / np.diff(q.t)[:, None]
        believed_speed = believed.speeds[[believed.joints.index(j) for j in r.joints]]
        shares.append(float((np.nanpercentile(speed, 99, axis=0) / believed_speed).max()))
    return min(max(shares), 1.0)


def _world(name: str) -> dict:
    from dexsim.cli.build import quiet_warp

    quiet_warp("cpu")
    return yaml.safe_load((ROOT / "configs" / "reality" / f"{name}.yaml").read_text(encoding="utf-8"))


def _drive(world: dict, believed, t: np.ndarray, value: np.ndarray, home: np.ndarray, rng: np.random.Generator, path: Path) -> None:
    """Sends targets value [T, J] rad at t [T] s to the empty hand of a world, from home [J], and writes what its bus delivers."""
    from dexsim.recording import write
    from dexsim.recording.mechanism import drive, mechanism, recorded
    from dexsim.recording.realistic import realistic
    from dexsim.recording.schema import COMMANDS, Series

    true = mechanism(servo=world["servo"], gravity=believed.spec.option.gravity)
    arrives = rng.random(len(t)) >= world["timing"]["lost"]
    late = t + world["timing"]["late"] * rng.random(len(t))
    order = np.argsort(late[arrives], kind="stable")
    sent = Series(late[arrives][order], value[arrives][order], COMMANDS)
    run = drive(true, sent, believed.joints, float(t[-1]), initial=home, timestep=0.001)
    seen = realistic(recorded(run, believed, Series(t, value, COMMANDS), believed.joints, rate=500.0), seed=int(rng.integers(1 << 30)))
    seen.meta["source"] = "real"
    write(path, seen)
    print(f"{path}: {t[-1]:.0f} s", flush=True)


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    {"start": start, "record": record}[what](dict(item.split("=", 1) for item in rest))
