"""The steps of the loop that no entry script does: a start that may be trained on, and recordings of the hand in its
reality.

    python -m benchmarks.loop.steps start checkpoint=FILE out=last.pt device=cuda [any setting of train.py]
    python -m benchmarks.loop.steps record world=late out=DIR seed=1 [own=a.mcap,b.mcap] [seconds=19]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from benchmarks.loop.presses import world_of
from dexsim.paths import CONFIGS

EXCITED = (("random", 0.6), ("chirp", 0.6), ("random", 0.8))
"""The excitation: motions of all joints (or of fingers) at once, since most is seen in little time, and the share of
the `used` speeds that they may reach; chirps tell a delay from a lag. Faster, a drive that is late swings into the ends
of its range (lab/results/loop.md)."""
KEPT = 1  # of them, the last, is for the proof
CAREFUL = 0.6  # of the believed no-load speed, as `dexsim.excite` has it
FAST = ("fast.mcap", "fast_kept.mcap")  # the recordings of fast moves: one is fitted, one is for the proof
DASH = ((1, 0.35), (-1, 0.5), (1, 0.6), (-1, 0.7), (1, 0.45), (-1, 0.55), (1, 0.65), (0, 0.35))
"""Straight moves about the middle of a joint's range: to which end of them, at which share of the believed no-load
speed."""
# s from one to the next; of the free range, either way; rad: joints that cannot go so far are left out
DASH_S, REACH, SHORT = 0.6, 0.4, 0.25
# s more, and of the no-load speed: drives as late or as slow as this must keep to it too
LATE, SLOW = {"delay": 0.05, "lag": 0.025}, 0.5
# rad from its target before the next move, at most; rad from its ends, at least; of DASH, or left out
SETTLED, MARGIN, LEAST = 0.05, 0.02, 0.6


def start(given: dict[str, str]) -> None:
    """Make a checkpoint to resume from, out of one that holds a policy only: its actor, a fresh critic and optimizer,
    nothing counted."""
    import torch

    from dexsim.cli import build, machine
    from dexsim.cli import start as settings
    from dexsim.learning import checkpoint
    from dexsim.learning.runner import Runner

    own = {k: given.pop(k) for k in ("checkpoint", "out", "device")}
    ready = settings.for_train([f"resume={own['checkpoint']}", "device=cpu", "worlds=16", "iterations=1000000",
                                *(f"{k}={v}" for k, v in given.items())],
                               CONFIGS)  # fmt: skip
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
    """Make recordings of the hand in a concealed reality under safe excitation: read as its bus reads, targets late
    and lost as there. As fast as the policies' own runs there were (own=a.mcap,b.mcap), since a limit that no motion
    meets is not found."""
    from dexsim.recording import read
    from dexsim.recording.excitation import Limits, plan
    from dexsim.recording.mechanism import mechanism

    world, out, seed = world_of(given["world"]), Path(given["out"]), int(given.get("seed", 0))
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
    """Times [T] s, targets [T, J] rad and home [J]: one joint of each finger at a time is led to and fro about the
    middle of its range, far and faster than its drive may be able to follow: a speed limit shows, which smooth motion
    of all joints does not reach. Long straight moves, since after a step or a short fast move a drive with a lag swings
    for long. Simulated with the drives as believed, with drives as late as LATE, and with those as slow as SLOW too; a
    joint is led less far and more slowly until in all of them it has come to rest before each next move and met no end.
    way: 1, or -1 for the same the other way round."""
    from dexsim.recording import excitation, safety
    from dexsim.recording.mechanism import drive, mechanism
    from dexsim.recording.schema import Series
    from dexsim.recording.waveforms import minimum_jerk

    dt, hold = 0.01, round(DASH_S / 0.01)
    low, high, home = excitation._range(believed, excitation.Limits())
    hands = [believed]
    for speed in (1.0, SLOW):
        table = believed.table.to_dict()
        for columns in table["joints"].values():
            columns |= {k: columns[k] + v if k in columns else v for k, v in LATE.items() if k in columns or k == "lag"}
            columns |= {"no_load_speed": speed * columns["no_load_speed"]} if "no_load_speed" in columns else {}
        hands.append(mechanism(servo=table, gravity=believed.spec.option.gravity))
    check = safety.ContactCheck(believed, home, excitation.Limits().clearance)
    parts = [np.tile(home, (30, 1))]
    for group in excitation.groups(believed, believed.joints):
        free = {j: excitation._free(check, home, believed.joints.index(j), low, high) for j in group}
        pace = {j: 1.0 for j in group if REACH * (free[j][1] - free[j][0]) > SHORT}  # how far and how fast, of DASH
        while pace:
            centre, body = home.copy(), np.zeros((hold * len(DASH), len(home)))
            for j, slower in pace.items():
                i, at = believed.joints.index(j), 0.0
                centre[i] = 0.5 * sum(free[j])
                for k, (end, share) in enumerate(DASH):
                    to = way * end * slower * REACH * (free[j][1] - free[j][0])
                    body[hold * k : hold * (k + 1), i] = at + np.sign(to - at) * np.minimum(
                        np.arange(1, hold + 1) * dt * slower * share * believed.speeds[i], abs(to - at)
                    )
                    at = to
            value = np.concatenate(
                [
                    minimum_jerk(home, centre, 0.8, dt),
                    centre + body,
                    minimum_jerk(centre, home, 0.8, dt),
                    np.tile(home, (30, 1)),
                ]
            )
            t = np.arange(len(value)) * dt
            swings, touched = set(), False
            for hand in hands:
                run = drive(
                    hand,
                    Series(t, value),
                    hand.joints,
                    float(t[-1]),
                    home,
                    excitation.CHECK_STEP,
                    frame_s=excitation.FRAME,
                )
                ends = len(value) - len(body) - 110 + hold * np.arange(1, len(DASH) + 1) - 1
                for j in pace:
                    i = believed.joints.index(j)
                    low_end, high_end = believed.limits[i]
                    settled = np.abs(np.interp(t[ends], run.t, run.position[:, i]) - value[ends, i]).max() < SETTLED
                    if (
                        not settled
                        or run.position[:, i].min() < low_end + MARGIN
                        or run.position[:, i].max() > high_end - MARGIN
                    ):
                        swings.add(j)
                touched = touched or bool(check.along(run))
            if not swings and not touched:
                break
            pace = {j: 0.85 * x if j in swings or touched else x for j, x in pace.items()}
            pace = {j: x for j, x in pace.items() if x > LEAST}
        print(
            "fast: "
            + ", ".join(
                f"{j} +-{x * REACH * (free[j][1] - free[j][0]):.2f} rad at {x:.2f} of the speeds"
                for j, x in pace.items()
            ),
            flush=True,
        )
        parts += [value] if pace else []
    value = np.concatenate(parts)
    return np.arange(len(value)) * dt, value, home


def used(own: list, believed) -> float:
    """Return the largest speed that a joint reached in recordings (99 % of the time below it), as a share of its
    believed no-load speed, from CAREFUL to 1."""
    shares = [CAREFUL]
    for r in own:
        q = r.states.position
        speed = np.abs(np.diff(q.value, axis=0)) / np.diff(q.t)[:, None]
        believed_speed = believed.speeds[[believed.joints.index(j) for j in r.joints]]
        shares.append(float((np.nanpercentile(speed, 99, axis=0) / believed_speed).max()))
    return min(max(shares), 1.0)


def _drive(
    world: dict, believed, t: np.ndarray, value: np.ndarray, home: np.ndarray, rng: np.random.Generator, path: Path
) -> None:
    """Sends targets value [T, J] rad at t [T] s to the empty hand of a world, from home [J], and writes what its bus
    delivers."""
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
    seen = realistic(
        recorded(run, believed, Series(t, value, COMMANDS), believed.joints, rate=500.0),
        seed=int(rng.integers(1 << 30)),
    )
    seen.meta["source"] = "real"
    write(path, seen)
    print(f"{path}: {t[-1]:.0f} s", flush=True)


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    {"start": start, "record": record}[what](dict(item.split("=", 1) for item in rest))
