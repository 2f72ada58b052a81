"""Draws touch cases: one xHand fingertip pressed by a ball, with a load cell, an effect of touch or contact of a chosen
size or none."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull

from benchmarks.concealed import touch
from dexsim.recording import Writer
from dexsim.recording.schema import EXTERNAL_FORCE

SECONDS, LSB, NOISE, SIZES = 8.0, 0.1, 0.02, 14
FINGERS = ("index", "mid", "ring", "pinky")


@dataclass(frozen=True)
class TouchKind:
    """effect: id of the catalogue; span: sizes; apply(p, s): parameters that change; report(new): {key: value}; own(f,
    n): [M] strength from force f [M] N and parameters n."""

    effect: str
    span: tuple[float, float]
    apply: object
    report: object
    own: object


def _relaxing(p: dict[str, float], f: np.ndarray) -> np.ndarray:
    """Return what the branches add [M] to a force f [M]; see `touch.relaxing`."""
    return touch.relaxing(p, f[:, None])[:, 0]


KINDS: dict[str, TouchKind] = {
    "pad_gain": TouchKind("tactile_gain", (0.06, 0.8), lambda p, s: {"gain": p["gain"] * (1 - s)},
                          lambda n: {"gain": n["gain"]}, lambda f, n: f),
    "hysteresis": TouchKind("tactile_hysteresis", (0.02, 1.5), lambda p, s: {"fraction": s},
                            lambda n: {"fraction": n["fraction"], "time_constant": n["time_constant"]},
                            lambda f, n: np.abs(_relaxing(n | {"fraction": 1.0, "branches": 1.0}, f))),
    "crosstalk": TouchKind("tactile_crosstalk", (0.02, 0.6), lambda p, s: {"crosstalk": s},
                           lambda n: {"fraction": n["crosstalk"]}, lambda f, n: f),
    "touch_delay": TouchKind("tactile_delay", (0.003, 0.2), lambda p, s: {"delay": s}, lambda n: {"delay": n["delay"]},
                             lambda f, n: np.abs(f - np.r_[np.zeros(int(n["delay"] * 1000)), f][: len(f)])),
    "soft_contact": TouchKind("contact_stiffness", (0.06, 0.85), lambda p, s: {"stiffness": p["stiffness"] * (1 - s)},
                              lambda n: {"stiffness": n["stiffness"]}, lambda f, n: f),
}  # fmt: skip


@dataclass(frozen=True)
class TouchLaw:
    """The second law of a form of an effect. first, second: both in words. more: parameters of it beside those of
    `TouchKind.apply`. report(pad, force, n): values that take the place of those of `TouchKind.report`; force: [M] N of
    each fitted recording."""

    first: str
    second: str
    more: dict[str, float]
    report: Callable = lambda pad, force, n: {}


def _one_branch(pad: touch.Pad, force: list[np.ndarray], n: dict) -> dict[str, float]:
    """Return the fraction and time constant of the one branch that adds most nearly what the two add in the recorded
    force."""
    of = lambda p: np.concatenate([_relaxing(p, f) for f in force])  # noqa: E731
    truth = of(n)
    best = (np.inf, 0.0, 0.0)
    for time_constant in np.geomspace(n["time_constant"] / 10, n["time_constant"] * 1.2, 50):
        x = of({"fraction": 1.0, "time_constant": time_constant, "branches": 1.0})
        fraction = float(x @ truth / max(x @ x, 1e-12))
        best = min(best, (float(((truth - fraction * x) ** 2).sum()), fraction, float(time_constant)))
    return {"fraction": best[1], "time_constant": best[2]}


SECOND: dict[str, TouchLaw] = {
    "hysteresis": TouchLaw("one branch", "two, one eight times as fast; the nearest one told", {"branches": 2.0},
                           _one_branch),
    # what a taxel gives away and does not get back by its neighbours' neighbours
    "crosstalk": TouchLaw("neighbours", "neighbours and theirs", {"rings": 2.0}, lambda pad, force, n:
                          {"fraction": n["crosstalk"] * (1 - float(np.mean(np.diag(pad.beside @ pad.beside))) / 3)}),
    # the mean of what comes evenly over twice the delay is late by the delay
    "touch_delay": TouchLaw("a delay", "a mean over twice the delay", {"window": 1.0}),
}  # fmt: skip
REFIT = {"stiffness": 0.05, "gain": 0.05, "zero": 1.5e-4, "along": 6e-4, "across": 6e-4}


def bench(finger: str, where: Path):
    """Return the rig as it is believed (rig.xml, rig's servo.yaml in `where`) and its pad for the plant."""
    from benchmarks.press_rig import RADIUS, SERVO, spec
    from tools.assets import xhand

    s, _, press, slide = spec(finger)
    model = s.compile()
    (where / "rig.xml").write_text(s.to_xml(), encoding="utf-8")
    (where / "servo.yaml").write_text(yaml.safe_dump(SERVO, sort_keys=False), encoding="utf-8")
    mesh = model.geom("tip").dataid[0]
    a, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[a : a + n].astype(float)
    R = np.zeros(9)
    import mujoco

    mujoco.mju_quat2Mat(R, model.geom("tip").quat)
    vertices = vertices @ R.reshape(3, 3).T + model.geom("tip").pos
    body = model.body(xhand.TIP_BODIES[xhand.FINGERS.index(finger)])
    vertices = vertices + body.pos  # the body is not turned
    hull = ConvexHull(vertices)
    table = xhand.taxel_table(finger)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return touch.Pad(vertices[hull.simplices], float(model.geom("tip").margin[0]), table["position"] + body.pos,
                     table["normal"], table["area"],
                     data.geom("ball").xpos.copy(), press, slide, RADIUS, np.array([0, 0, -9.81]))  # fmt: skip


def motion(rng: np.random.Generator) -> np.ndarray:
    """Return targets [2, M] of (slide, press): presses of several depths, quick and slow, some held, each elsewhere."""
    t = np.arange(0, SECONDS, 0.01)
    q, at = np.zeros((2, len(t))), 0.2
    q[1] = 0.5e-3
    while at < SECONDS - 0.9:
        deep, ramp, hold = 2e-3 + rng.uniform(0.4e-3, 1.2e-3), rng.choice([0.07, 0.2, 0.6]), rng.choice([0.1, 0.6, 2.2])
        q[1] = np.maximum(
            q[1], np.interp(t, [at, at + ramp, at + ramp + hold, at + 2 * ramp + hold], [0, 1, 1, 0]) * deep
        )
        q[0] += np.interp(t, [at - 0.15, at], [0, 1]) * rng.uniform(-2e-3, 2e-3) * (t < at + 2 * ramp + hold + 0.05)
        at += 2 * ramp + hold + rng.uniform(0.25, 0.6)
    return np.repeat(q, 10, 1)


def build(entry: dict, number: int, seed: int, seen: Path, truth: Path, which: str = "two") -> dict:
    """Writes one touch case and its truth, as `generate.build` does for joints."""
    from benchmarks.concealed.generate import HELD, RECORDINGS, START_NS, TIERS, commit, tier_of

    rng = np.random.default_rng([seed, 2, number])
    name = hashlib.sha256(f"{seed}/{number}".encode()).hexdigest()[:8]
    where = seen / name
    where.mkdir(parents=True, exist_ok=True)
    finger = str(rng.choice(FINGERS))
    pad = bench(finger, where)
    commands = [motion(rng) for _ in RECORDINGS]
    off = lambda: 1 + rng.uniform(-0.03, 0.03)  # noqa: E731
    true = touch.DEFAULTS | {"stiffness": 7000.0 * off(), "gain": off(), "reach": 1e-3 * off(), "kp": 4000.0 * off(),
                             "kd": 40.0 * off(), "mass_press": 0.1 * off(),
                             "mass_slide": 0.2 * off(), "zero": rng.uniform(-5e-5, 5e-5),
                             "along": rng.uniform(-2e-4, 2e-4), "across": rng.uniform(-2e-4, 2e-4),
                             "time_constant": rng.uniform(0.1, 1.5)}  # fmt: skip
    own_gain = 1 + rng.uniform(-0.02, 0.02, len(pad.areas))
    cache: dict[float, list] = {}

    def read(p: dict, q: np.ndarray, f: np.ndarray) -> np.ndarray:
        return touch.readings(pad, p, q, f) * own_gain

    def run(p: dict) -> list[tuple]:
        """Return (positions, force, readings) of every recording."""
        if p["stiffness"] not in cache:
            cache[p["stiffness"]] = [touch.move(pad, p, c) for c in commands]
        return [(q, f, read(p, q, f)) for q, f in cache[p["stiffness"]]]

    stack = lambda r: np.stack([x[2][::11] for x in r])  # noqa: E731
    nominal = run(true)
    base = stack(nominal)
    kind = KINDS.get(entry["kinds"][0]) if entry["kinds"] else None
    slopes = []
    for k, width in REFIT.items():
        p = true | {k: true[k] + 0.3 * width * (true[k] if k in ("stiffness", "gain") else 1.0)}
        more = 1 + 0.3 * width if k == "stiffness" else 1.0
        changed = [(q, f, read(p, q, f * more)) for q, f, _ in nominal]
        slopes.append((stack(changed) - base).reshape(-1) / 0.3)
    Q, R = np.linalg.qr(np.stack(slopes, 1))

    def hidden(x: np.ndarray) -> float:
        fit = lsq_linear(R, Q.T @ x.reshape(-1), (-1.0, 1.0)).x
        residual = (x.reshape(-1) - np.stack(slopes, 1) @ fit).reshape(x.shape)[-HELD:]
        return float(np.sqrt(np.mean(residual[..., base.max((0, 1)) > 0.02] ** 2)))

    floor = float(np.hypot(LSB / np.sqrt(12), NOISE))
    floor = float(np.hypot(floor, hidden(base * (1 - 1 / own_gain))))
    law, pair = None, SECOND.get(entry["kinds"][0]) if kind else None
    if pair is not None and which == "two" and np.random.default_rng([seed, 3, number]).uniform() < 0.5:
        law = pair
    more = law.more if law is not None else {}
    p, facts = dict(true), {"floor": floor, "noise": NOISE}
    if kind:
        sizes = np.geomspace(*kind.span, SIZES)
        change = np.array([hidden(stack(run(true | more | kind.apply(true, s))) - base) for s in sizes])
        reached = np.hypot(change, floor) / floor
        pick = int(np.nanargmin(np.abs(np.log(reached / TIERS[entry["tier"]]))))
        p = true | more | kind.apply(true, sizes[pick])
        facts |= {
            "ratio": float(reached[pick]),
            "size": float(sizes[pick]),
            "before": float(np.hypot(change[pick], floor)),
        }
    done = run(p)
    meta = {
        "source": "real",
        "robot": "press_rig",
        "gravity": "0 0 -9.81",
        "effort_is": "none",
        "tactile_unit": "count",
        "tactile_lsb": f"{LSB:g}",
    }
    from tools.assets import xhand

    pad_number = xhand.FINGERS.index(finger)
    when = []
    for k, letter in enumerate(RECORDINGS):
        q, f, z = done[k]
        t = np.arange(0.005, SECONDS - 0.03, 1 / 90) + np.clip(
            rng.normal(0, 3e-4, len(np.arange(0.005, SECONDS - 0.03, 1 / 90))), -1e-3, 1e-3
        )
        t = t[rng.uniform(size=len(t)) > 0.01]
        grid = np.arange(q.shape[1]) * 1e-3
        with Writer(where / f"{letter}.mcap", ("slide", "press"), meta, START_NS) as w:
            order = [(i * 1e-3, 0, i) for i in range(0, q.shape[1], 10)] + [(x, 1, i) for i, x in enumerate(t)]
            for x, which, i in sorted(order):
                if which == 0:
                    w.add_command(x, commands[k][:, i])
                    continue
                at = min(int(x * 1000), q.shape[1] - 2)
                part = x * 1000 - at
                seen = np.array([np.interp(x, grid, q[0]), np.interp(x, grid, q[1])]) + 6e-6 * rng.normal(size=2)
                w.add_state(x, np.round(seen / 1e-5) * 1e-5)
                out = np.zeros((5, len(pad.areas), 3))
                value = z[at] * (1 - part) + z[at + 1] * part + NOISE * rng.normal(size=len(pad.areas))
                out[pad_number, :, 2] = np.clip(np.round(value / LSB), 0, 255)
                w.add("tactile", x, out)
                push = np.r_[np.interp(x, grid, f) + 0.02 * rng.normal(), np.zeros(5)]
                w.add_vector(EXTERNAL_FORCE, x, push, "indenter")
        if kind and k < len(RECORDINGS) - HELD:
            strength = kind.own(f, p)
            edge = np.flatnonzero(
                np.diff(np.r_[0, (strength > 0.25 * max(np.percentile(strength, 99.9), 1e-12)).astype(int), 0])
            )
            when += [
                [letter, round(float(a) * 1e-3, 3), round(float(b) * 1e-3, 3)]
                for a, b in zip(edge[::2], edge[1::2], strict=True)
            ]
    stated = {k: float(v) for k, v in kind.report(p).items()} if kind else {}
    if law is not None:
        stated |= law.report(pad, [f for _, f, _ in done[: len(RECORDINGS) - HELD]], p)
    which_law = {"law": "only"}
    if pair is not None:
        which_law = {"law": "second" if law else "first", "law_is": pair.second if law else pair.first}
    effects = [] if not kind else [{"effect": kind.effect, "kind": entry["kinds"][0], "joint": "pad",
                                    "parameters": stated, **which_law,
                                    "facts": facts, "also": [], "when": when}]  # fmt: skip
    answer = {"name": name, "group": "touch", "decoy": "", "bad": "", "asked_tier": entry["tier"],
              "tier": tier_of(facts["ratio"]) if kind else "none", "shape": "touch",
              "joints": 1, "voltage": False, "effort": False, "floor": floor, "effects": effects}  # fmt: skip
    return {"name": name, "digest": commit(answer, truth), "settings": []}
