"""Draws the cases of the concealed benchmark: a rig, motions, an effect of a chosen size, recordings, and the truth
apart.

A case folder holds what `diagnose` sees: `a.mcap`, `b.mcap`, `c.mcap` (to fit), `d.mcap` (held out), `rig.xml`,
`servo.yaml` (none for the right xHand). The truth goes to another folder; its SHA-256 with a random salt is published
first.

Size of an effect: d = the held-out change that it makes in its joint, with gains, mass, inertia and friction refitted
by up to 5 % to hide it; f = the floor: measurement noise and what another friction law leaves of the same rig. sqrt(d^2
+ f^2) / f is 10, 3 or 1.5 at easy, medium and hard: the size is read off one batch in which the same rig carries the
effect at many sizes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

from benchmarks.concealed import laws, plant, rigs, touch_cases
from benchmarks.concealed.effects import ALL, BY_EFFECT, KINDS, OUTSIDE, Kind, stalled
from dexsim.recording import Writer

TIERS = {"easy": 10.0, "medium": 3.0, "hard": 1.5, "poor": 1.2}  # poor: a decoy, excited too little to show
SECONDS = 7.0
START_NS = 1_700_000_000_000_000_000  # the same for every recording: time tells nothing
RECORDINGS = ("a", "b", "c", "d")
HELD = 1  # of them held out, at the end
SIZES = 20
REFIT = ("kp", "kd", "mass", "rotor", "coulomb", "viscous", "torque_limit", "no_load_speed")
BELIEF = 0.05  # how far each may be refitted
NOISE_OF_EFFORT = 0.02  # of a joint's typical torque
DECOYS = ("poor", "touched", "wrong_mass", "confounded", "bad_channel")
MIX = {"effect": 14, "none": 4, "noise": 2, "pair": 2, "outside": 2, "decoy": 2, "hand": 6, "touch": 0, "large": 0,
       "spatial": 0}  # fmt: skip
ELSEWHERE = 4  # other joints at which a large effect is tried where the drawn one does not show it
SEVERAL = ("bench2", "bench4", "arm2", "arm3", "finger")  # shapes of more than one joint


def plan(mix: dict[str, int], seed: int, one_joint: bool = False) -> list[dict]:
    """Return what each case holds: {group, kinds, tier, shape, number in group}, in an order that is itself drawn.

    mix: number of cases by group: effect (one of the catalogue), none (one joint, nothing missing), noise (the same,
    noise doubled), pair (two effects), outside (the catalogue), decoy, hand (a hand: of every six two with nothing
    missing, three with an effect, one with effects at two joints), large (a hand, always one large effect, at a joint
    that shows it), touch (a fingertip under a ball: of every four one with nothing missing), spatial (arms and hands of
    2 to 7 joints whose geometry, gravity, encoders, cables, supply and warmth are a little off: of every three two with
    nothing missing). Effects, tiers and shapes
    take turns; one_joint: only rigs of one joint. Raises ValueError for a group that there is not.
    """
    rng = np.random.default_rng([seed, 1])
    effects, tiers = [str(e) for e in rng.permutation(list(BY_EFFECT))], ("easy", "medium", "hard")
    if one_joint:
        effects = [e for e in effects if any(KINDS[k].joints == 1 for k in BY_EFFECT[e])]
    out = []
    for group, count in mix.items():
        if group not in MIX:
            raise ValueError(f"no group '{group}'; there are {', '.join(MIX)}")
        for k in range(count):
            entry = {"group": group, "kinds": [], "tier": "none", "shape": "one", "joints": []}
            turn = k // len(effects)
            if group in ("effect", "hand", "decoy", "large"):
                names = BY_EFFECT[effects[k % len(effects)]]
                kind = names[turn % len(names)]
                several = not one_joint and (KINDS[kind].joints > 1 or (k + turn) % 5 in (1, 3))
                entry |= {
                    "kinds": [kind],
                    "tier": tiers[(k + turn) % 3],
                    "shape": str(rng.choice(SEVERAL)) if several else "one",
                }
            if group == "hand":
                entry |= (
                    {"shape": "hand", "tier": tiers[k % 2]} if k % 3 else {"shape": "hand", "kinds": [], "tier": "none"}
                )
                if k % 6 == 5:
                    entry["kinds"].append(BY_EFFECT[effects[(k + len(effects) // 3) % len(effects)]][0])
            elif group == "large":
                entry |= {"shape": "hand", "tier": "easy"}
            elif group == "spatial":
                entry["shape"] = rigs.SPATIAL[(k + k // len(rigs.SPATIAL)) % len(rigs.SPATIAL)]  # each with each tier
                if k % 3 == 2:
                    names = BY_EFFECT[effects[k // 3 % len(effects)]]
                    entry |= {"kinds": [names[k // 3 // len(effects) % len(names)]], "tier": tiers[k // 3 % 2]}
            elif group == "touch":
                names = list(touch_cases.KINDS)
                hidden = k % 4 > 0
                entry |= {
                    "shape": "touch",
                    "kinds": [names[(k - k // 4) % len(names)]] if hidden else [],
                    "tier": ("easy", "medium")[k // 4 % 2] if hidden else "none",
                }
            elif group == "none" and not one_joint and k % 10 == 9:
                entry["shape"] = str(rng.choice(SEVERAL))
            elif group == "pair":
                two = rng.choice(len(effects), 2, replace=False)
                kinds = [str(rng.choice(BY_EFFECT[effects[i]])) for i in two]
                entry |= {
                    "kinds": kinds,
                    "tier": tiers[k % 2],
                    "shape": str(rng.choice(SEVERAL))
                    if not one_joint and k % 2 or any(KINDS[x].joints > 1 for x in kinds)
                    else "one",
                }
            elif group == "outside":
                entry |= {"kinds": [list(OUTSIDE)[k % len(OUTSIDE)]], "tier": tiers[k // len(OUTSIDE) % 2]}
            elif group == "decoy":
                what = DECOYS[k % len(DECOYS)]
                entry |= (
                    {"decoy": what, "tier": "poor"}
                    if what == "poor"
                    else {"decoy": what, "kinds": [], "tier": "none", "shape": "one"}
                )
            out.append(entry)
    return [out[i] for i in rng.permutation(len(out))]


def motions(rng: np.random.Generator, d: rigs.Drawn, poor: bool) -> np.ndarray:
    """Return the targets of the recordings in every millisecond, [R, J, M]; sent at 100 Hz and held between."""
    M = int(SECONDS * 1000)
    t = np.arange(0, SECONDS, 0.01)
    # a chain thrown about is chaotic, and no replay of it can be compared
    calm = 0.6 if d.rig.com.shape[1] > 1 else 1.0
    out = np.zeros((len(RECORDINGS), d.joints, M))
    for k in range(len(RECORDINGS)):
        for j in range(d.joints):
            if poor:  # slow and small: hardly anything shows
                c = rng.uniform(-0.1, 0.1) + 0.06 * np.sin(2 * np.pi * rng.uniform(0.1, 0.2) * t)
            else:
                parts = courses(rng, t, 60, 0.8, (0.15, 0.35), (1.2, 2.5), calm)
                c = in_turn([parts[(k + j + i) % 3] for i in range(3)])
            middle, half = 0.5 * (d.low[j] + d.high[j]), 0.5 * (d.high[j] - d.low[j])
            out[k, j] = np.repeat(middle + half * c / 0.8, 10)[:M]
    return out


def courses(
    rng: np.random.Generator, t: np.ndarray, count: int, most: float, rise: tuple, top: tuple, calm: float = 1.0
) -> list[np.ndarray]:
    """Return targets [T] at t [T] s, every 10 ms, that go along ramps, in steps, and as a chirp. count: of steps; most:
    how far they go; rise [s]: how long one takes, as a planner sends it (a drive that saturates all the time hides the
    rest); top [Hz]: where the chirp ends; calm: below 1, all is less and slower."""
    knots = np.cumsum(np.r_[0.0, rng.uniform(0.4, 0.9, count)])
    levels = np.r_[0.0, calm * rng.uniform(-most, most, len(knots) - 1)]
    ends = np.sort(np.r_[knots[1:], knots[1:] + rng.uniform(*rise) / calm])
    step = np.interp(t, ends, np.r_[levels[0], np.repeat(levels[1:-1], 2), levels[-1]])
    f = np.linspace(rng.uniform(0.15, 0.3), calm * rng.uniform(*top), len(t))
    chirp = rng.uniform(0.2, 0.4) * np.sin(2 * np.pi * np.cumsum(f) * 0.01) + rng.uniform(-0.3, 0.3)
    return [np.interp(t, knots[::2], levels[::2]), step, chirp]


def in_turn(parts: list[np.ndarray]) -> np.ndarray:
    """Return the first third of the first part, the second of the second, the third of the third."""
    return np.choose(np.minimum((3 * np.arange(len(parts[0])) / len(parts[0])).astype(int), 2), parts)


class Bench:
    """A rig with its motions: runs variants of its parameters, as measured. settled: whether a joint begins where its
    encoder reads the first target, else at the target itself, from where a drive whose encoder is off jumps."""

    def __init__(
        self, d: rigs.Drawn, command: np.ndarray, warm: np.ndarray, noise: float, source: int, settled: bool = False
    ):
        self.d, self.command, self.warm, self.noise, self.source = d, command, warm, noise, source
        self.settled = settled
        self.base = {
            k: np.broadcast_to(d.true.get(k, v), (d.joints,)).astype(float).copy() for k, v in plant.DEFAULTS.items()
        }
        self.base["couple_from"][:] = source

    def run(
        self, variants: list[dict[str, np.ndarray]], commands: list[np.ndarray] | None = None, **kw
    ) -> dict[str, np.ndarray]:
        """Return the outputs [V, R, J, M] of parameter sets [J]; position is as the encoder reports it. commands: one
        [R, J, M] a variant."""
        V, R = len(variants), len(self.command)
        values = {k: np.repeat(np.stack([v[k] for v in variants]), R, 0) for k in plant.DEFAULTS}
        values["warm"] = np.tile(self.warm[:, None] + np.zeros(self.d.joints), (V, 1))
        begins = np.array([laws.chance_of(k) for k in range(R)], float)
        values["jitter_from"] = np.tile(begins[:, None] + np.zeros(self.d.joints), (V, 1))
        command = np.tile(self.command, (V, 1, 1)) if commands is None else np.concatenate(commands)
        if self.d.gravity is not None:
            kw["gravity"] = np.tile(self.d.gravity[:R], (V, 1))
        # at rest at the first target, so that nothing swings in
        start = command[:, :, 0]
        encoder = ("scale", "offset", "eccentric", "eccentric_at", "second_harmonic")
        if self.settled:
            start = plant.angle_read_as(start, *(values[k] for k in encoder))
        out = plant.simulate(self.d.rig, plant.rows(V * R, self.d.joints, **values), command, q0=start, **kw)
        out["link"] = out["position"]
        out["position"] = plant.encoded(out["link"], *(values[k][..., None] for k in encoder))
        return {k: x.reshape(V, R, *x.shape[1:]) for k, x in out.items()}

    def changed(
        self, joint: int, change: dict[str, float], base: dict[str, np.ndarray] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the parameters with one joint's changed."""
        out = {k: v.copy() for k, v in (base or self.base).items()}
        for k, x in change.items():
            out[k][joint] = x
        return out

    def sized(
        self, kind: Kind | None, joint: int, ratio: float, seed: int, law: laws.Law | None = None
    ) -> tuple[float, dict, dict]:
        """(size of the effect, figures, outputs [1, R, J, M] with it): the size at which it changes held-out error in
        its joint by the ratio. law: the second law, None for the first."""
        d, true = self.d, {k: float(v[joint]) for k, v in self.base.items()}
        sizes = np.geomspace(*kind.span, SIZES) if kind else np.zeros(0)
        unit, inertia = float(d.unit[joint]), float(d.inertia[joint])
        moves = kind is not None and kind.signal == "position"
        apply = law.apply if law is not None else kind.apply if kind is not None else None
        variants = [self.base] + [self.changed(joint, apply(true, s, unit, inertia)) for s in sizes if moves]
        commands = [self.command] * len(variants)
        if kind is OUTSIDE["bus_stalls"]:
            commands[1:] = [self.stalls(s, seed) for s in sizes]
        first = len(variants)
        variants += [self.changed(joint, {k: true[k] * 1.02}) for k in REFIT] + [self.changed(joint, {"bristle": 0.0})]
        run = self.run(variants, commands + [self.command] * (len(variants) - first))
        signal = "torque" if kind is not None and kind.signal == "effort" else "position"
        y = run[signal][:, :, joint]
        slopes = (y[first:-1] - y[0]).reshape(len(REFIT), -1).T / 0.02

        # every belief may move within 5 % of what is believed, which is not what is true
        believed = np.array([d.believed[k][joint] for k in REFIT])
        low, high = ((f * believed / np.array([true[k] for k in REFIT])) - 1 for f in (1 - BELIEF, 1 + BELIEF))
        size_of = np.maximum(np.sqrt((slopes**2).sum(0)), 1e-12)
        Q, R = np.linalg.qr(slopes / size_of)

        def hidden(x: np.ndarray) -> float:
            """Return held-out RMS of a change [R, M], what a refit on all within its bounds takes away taken away."""
            if not np.isfinite(x).all() or np.abs(x).max() > 10.0:  # too much for the rig: it runs away
                return np.nan
            fit = lsq_linear(R, Q.T @ x.reshape(-1), (low * size_of, high * size_of)).x / size_of
            return float(np.sqrt(np.mean((x.reshape(-1) - slopes @ fit).reshape(x.shape)[-HELD:] ** 2)))

        noise = self.noise if signal == "position" else NOISE_OF_EFFORT * unit
        law = hidden(y[-1] - y[0])
        floor = float(np.hypot(noise, law))
        facts = {"floor": floor, "law": law, "noise": noise}
        of = lambda i: {key: x[i : i + 1].copy() for key, x in run.items()}  # noqa: E731
        if kind is None:
            return 0.0, facts, of(0)
        if moves:
            change = np.array([hidden(x - y[0]) for x in y[1:first]])
        elif law is not None:
            label, over = "current_gain" if kind is KINDS["current_gain"] else "current_offset", _over(y.shape[-1])
            change = np.array(
                [hidden(laws.effort(y[0], laws.HEALTHY | laws.fault(label, True, s, unit), over) - y[0]) for s in sizes]
            )
        elif kind is KINDS["current_gain"]:
            change = np.array([hidden(s * y[0]) for s in sizes])
        else:
            change = np.array([hidden(np.full_like(y[0], s * unit)) for s in sizes])
        reached = np.hypot(change, floor) / floor
        pick = int(np.nanargmin(np.abs(np.log(reached / ratio))))
        facts |= {
            "ratio": float(reached[pick]),
            "before": float(np.hypot(change[pick], floor)),
            "size": float(sizes[pick]),
        }
        return float(sizes[pick]), facts, of(1 + pick if moves else 0)

    def largest(
        self, kind: Kind, joints: list[int], ratio: float, seed: int, draw: Callable[[int], laws.Law | None]
    ) -> tuple[int, tuple[float, dict, dict]]:
        """Return (joint, what `sized` says of it): the first at which the effect can be made about as large as the
        ratio, else
        that at which it becomes largest: an encoder's offset is nothing on a link that weighs nothing. draw: the law
        that it follows at a joint."""
        found: dict[int, tuple[float, dict, dict]] = {}
        for joint in joints:
            found[joint] = self.sized(kind, joint, ratio, seed, draw(joint))
            if tier_of(found[joint][1]["ratio"]) == tier_of(ratio):
                return joint, found[joint]
        return max(found.items(), key=lambda item: item[1][1]["ratio"])

    def stalls(self, size: float, seed: int) -> np.ndarray:
        """Return the commands as they arrive on a bus that stalls; the same stalls whatever their length."""
        return np.stack([stalled(c, size, np.random.default_rng([seed, 7, k])) for k, c in enumerate(self.command)])


def _over(count: int) -> np.ndarray:
    """Share of a recording that is over at each of its samples."""
    return np.arange(count) / count


def words(case: Path, servo: Path | None = None) -> list[str]:
    """Return the settings of `diagnose` on a case's folder; servo: another table than its own."""
    files = [str(case / f"{letter}.mcap") for letter in RECORDINGS]
    rig = [f"model={case / 'rig.xml'}", f"servo={servo or case / 'servo.yaml'}"]
    return [f"recordings=[{','.join(files[:-HELD])}]", f"held_out=[{','.join(files[-HELD:])}]",
            *(rig if (case / "rig.xml").is_file() else [])]  # fmt: skip


def metadata(effort: bool, hand: str) -> dict[str, str]:
    """Return what every recording states: nothing of it depends on the effect."""
    return {"source": "real", "robot": hand or "rig", "gravity": "0 0 -9.81",
            "effort_is": "torque_Nm" if effort else "none",
            "effort_sign": "+1"}  # fmt: skip


def tier_of(ratio: float) -> str:
    """Return the tier nearest to a size reached."""
    return "silent" if ratio < 1.25 else min(("easy", "medium", "hard"), key=lambda t: abs(np.log(ratio / TIERS[t])))


def build(entry: dict, number: int, seed: int, seen: Path, truth: Path, which: str = "two") -> dict:
    """Writes one case to `seen` and its truth to `truth`; returns {name, digest}. The folder's name is drawn too.

    which: "two" draws the law of each effect that has two, "one" takes the first (see `laws`)."""
    rng = np.random.default_rng([seed, 2, number])
    name = hashlib.sha256(f"{seed}/{number}".encode()).hexdigest()[:8]
    d = rigs.draw(rng, entry["shape"], entry.get("hand"))
    group, decoy = entry["group"], entry.get("decoy", "")
    command = motions(rng, d, decoy == "poor")
    warm = rng.permutation(np.linspace(25.0, rng.uniform(45.0, 65.0), len(RECORDINGS)))
    quantum = 2 * np.pi / rng.choice([4096, 16384])
    extra = rng.uniform(2e-4, 6e-4) * (2 if group == "noise" else 1)
    noise = float(np.hypot(quantum / np.sqrt(12), extra))
    kinds = [ALL[k] for k in entry["kinds"]]
    effort = bool(rng.uniform() < 0.5) | any(k.signal == "effort" for k in kinds)
    order = [int(x) for x in rng.permutation(d.joints)] if d.joints > 1 else [0, 0]
    joint, source = order[:2]
    joints = [joint] * len(kinds)
    if len(kinds) == 2 and d.joints > 1 and (rng.uniform() < 0.7 or group == "hand"):
        joints[1] = source
        source = joint if d.joints == 2 else int(rng.choice([i for i in range(d.joints) if i not in joints]))
    confounding = decoy == "confounded"
    if confounding:
        warm = np.sort(warm)
    bench = Bench(d, command, warm, noise, source, settled=group == "large")
    facts, new, sent, current = [], bench.base, command, dict(laws.HEALTHY)
    of_joint = lambda at: {k: float(v[at]) for k, v in bench.base.items()}  # noqa: E731
    ratio, found = TIERS.get(entry["tier"], 1.0), None
    if group == "large":
        draw = lambda at: laws.draw(entry["kinds"], [of_joint(at)], which, seed, number)[0]  # noqa: E731
        joint, found = bench.largest(kinds[0], [joint, *order[2 : 2 + ELSEWHERE]], ratio, number, draw)
        joints = [joint]
    current_at = joint
    own = [of_joint(at) for at in joints]
    drawn = laws.draw(entry["kinds"], own, which, seed, number)
    for kind, label, at, law, old in zip(kinds, entry["kinds"], joints, drawn, own, strict=True):
        size, fact, run = found or bench.sized(kind, at, ratio, number, law)
        facts.append(fact)
        apply = law.apply if law is not None else kind.apply
        new = bench.changed(at, apply(old, size, float(d.unit[at]), float(d.inertia[at])), new)
        if label == "bus_stalls":
            sent = bench.stalls(size, number)
        elif label in ("current_gain", "current_offset"):
            current_at = at
            current |= laws.fault(label, law is not None, size, float(d.unit[at]))
    if not kinds:
        _, fact, run = bench.sized(None, joint, 1.0, number)
        facts.append(fact)
    hand_touch, wrong = None, {}
    if decoy == "touched":  # somebody leans on the link for a while, in one recording
        hand_touch = np.zeros_like(command)
        k, a = int(rng.integers(len(RECORDINGS) - HELD)), int(rng.uniform(0.2, 0.6) * command.shape[2])
        hand_touch[k, joint, a : a + 1200] = (
            2.0 * d.unit[joint] * np.sin(np.pi * np.arange(1200) / 1200)[: command.shape[2] - a]
        )
    elif decoy == "wrong_mass":
        wrong = {"mass": float(new["mass"][joint])}
        d.believed["mass"][joint] *= 1 + float(rng.choice([-0.3, 0.4]))
        wrong = {"mass": wrong["mass"] - float(d.believed["mass"][joint])}
    if len(kinds) == 2 or hand_touch is not None:
        run = bench.run([new], [sent], external=hand_touch)
    if confounding:  # friction wears up run by run, and the motor happens to be warmer each time
        parts = [
            bench.run([bench.changed(joint, {"coulomb": new["coulomb"][joint] * (1 + 1.2 * k)}, new)], [sent])
            for k in range(len(RECORDINGS))
        ]
        run = {key: np.stack([parts[k][key][:, k] for k in range(len(RECORDINGS))], 1) for key in run}
    where = seen / name
    where.mkdir(parents=True, exist_ok=True)
    settings = rigs.files(where, d)
    bad = str(rng.choice(["stale", "degrees", "wrap"])) if decoy == "bad_channel" else ""
    effort = effort or bad == "wrap"
    _record(where, d, command, run, rng, quantum, extra, effort, current, current_at, joint, bad)
    effects = []
    for kind, label, at, fact, law, o in zip(kinds, entry["kinds"], joints, facts, drawn, own, strict=False):
        n = {k: float(v[at]) for k, v in new.items()} | current
        believed = {k: float(v[at]) for k, v in d.believed.items()}
        logs = _logs(run, command, at, source)
        known = {k: believed[k] for k in ("kp", "kd") if k in believed} | {"rotor": believed["rotor"]}
        stated = laws.reported(kind, law, logs, n, o | known)
        if kind.effect == "payload":
            stated = {"mass": n["mass"] + n["extra"] - believed["mass"]}
        strength = law.own if law is not None and law.own is not None else kind.own
        effects.append({"effect": kind.effect, "kind": label, "joint": d.rig.names[at], "parameters": stated,
                        "facts": fact, **laws.described(label, law, o),
                        "also": _also(kind, d, at, source),
                        "when": _when([strength(L, n, o) for L in logs])})  # fmt: skip
    if wrong:
        effects = [
            {
                "effect": "payload",
                "kind": "payload",
                "joint": d.rig.names[joint],
                "parameters": wrong,
                "facts": facts[0],
                "also": [],
                "when": [],
            }
        ]
    tier = entry["tier"]
    if group in ("effect", "hand", "large", "pair", "outside", "spatial") and kinds:
        tier = min((tier_of(f["ratio"]) for f in facts), key=("silent", "hard", "medium", "easy").index)
    answer = {"name": name, "group": group, "decoy": decoy, "bad": bad, "asked_tier": entry["tier"], "tier": tier,
              "shape": d.shape, "joints": len(d.rig.names),
              "voltage": d.voltage, "effort": effort, "floor": facts[0]["floor"], "effects": effects}  # fmt: skip
    return {"name": name, "digest": commit(answer, truth), "settings": settings}


def _also(kind: Kind, d: rigs.Drawn, j: int, source: int) -> list[str]:
    """Return the other joints at which the effect is just as true: a linkage has two ends, and what a link carries its
    parents carry."""
    if kind.effect == "joint_coupling":
        return [d.rig.names[source]]
    chain, depth = d.rig.place[j]
    return (
        [d.rig.names[i] for i, (c, k) in enumerate(d.rig.place) if c == chain and k < depth]
        if kind.effect == "payload"
        else []
    )


def _logs(run: dict, command: np.ndarray, j: int, source: int) -> list[dict[str, np.ndarray]]:
    """Return for each recording to fit what is true of a joint in every millisecond [M]: the plant's outputs at it, its
    command, the angle of the joint that it may hang on, the others' torque."""
    out = []
    for k in range(len(RECORDINGS) - HELD):
        L = {key: x[0, k, j].astype(float) for key, x in run.items()}
        L["position"] = L["link"]
        L |= {
            "command": command[k, j],
            "source": run["link"][0, k, source],
            "others": np.abs(run["torque"][0, k]).sum(0) - np.abs(run["torque"][0, k, j]),
        }
        out.append(L)
    return out


def _when(strength: list[np.ndarray]) -> list[list]:
    """Return true samples in the recordings to fit: [recording, start, end] s where the strength [M] of the effect
    in each exceeds 25 % of its maximum."""
    strength = [np.asarray(x, float) for x in strength]
    most = max(float(np.percentile(np.concatenate(strength), 99.9)), 1e-12)
    out = []
    for letter, x in zip(RECORDINGS, strength, strict=False):
        edge = np.flatnonzero(np.diff(np.r_[0, (x > 0.25 * most).astype(int), 0]))
        out += [
            [letter, round(float(a) * 1e-3, 3), round(float(b) * 1e-3, 3)]
            for a, b in zip(edge[::2], edge[1::2], strict=True)
        ]
    return out


def _record(
    where: Path,
    d: rigs.Drawn,
    command: np.ndarray,
    run: dict,
    rng,
    quantum,
    extra,
    effort,
    current,
    current_at,
    joint,
    bad,
) -> None:
    for k, letter in enumerate(RECORDINGS):
        tau = run["torque"][0, k].copy()
        tau[current_at] = laws.effort(tau[current_at], current, _over(tau.shape[-1]))
        t, (angle, torque, heat) = plant.log(
            [run["position"][0, k], tau, run["temperature"][0, k].astype(float)], rng, 100.0, 1e-3
        )
        torque = torque + rng.normal(0, 1, torque.shape) * (NOISE_OF_EFFORT * d.unit[:, None])
        angle = np.round((angle + rng.normal(0, extra, angle.shape)) / quantum) * quantum
        torque = np.round(torque / 1e-4) * 1e-4
        if bad == "stale" and k == 0:  # the bus repeats what it read last
            a = int(0.3 * len(t))
            angle[joint, a : a + 180] = angle[joint, a]
        elif bad == "degrees":
            angle[joint] = np.degrees(angle[joint])
        elif bad == "wrap":  # a signed register read as unsigned
            torque[joint] = np.where(torque[joint] < 0, torque[joint] + 6.5536, torque[joint])
        with Writer(where / f"{letter}.mcap", d.rig.names, metadata(effort, d.hand), START_NS) as w:
            sent = np.arange(0, command.shape[2], 10)
            order = (
                [(i * 1e-3, 0, i) for i in sent]
                + [(x, 1, i) for i, x in enumerate(t)]
                + [(x, 2, i) for i, x in enumerate(t) if i % 10 == 0]
            )
            for x, which, i in sorted(order):
                if which == 0:
                    w.add_command(x, command[k, :, i])
                elif which == 1:
                    w.add_state(x, angle[:, i], None, torque[:, i] if effort else None)
                else:
                    w.add("temperature", x, np.round(heat[:, i]))


def stub(root: Path, number: int) -> Path:
    """Return the file that says that a case is made, and what `once` returns of it."""
    return root / "made" / f"{number}.json"


def once(job: tuple[dict, int, int, Path, str]) -> dict:
    """{name, digest, settings}: the case as it was made before, or made now. job: entry of the plan, number, seed,
    folder, laws."""
    entry, number, seed, root, which = job
    if not (file := stub(root, number)).is_file():
        make = touch_cases.build if entry["shape"] == "touch" else build
        made = make(entry, number, seed, root / "cases", root / "truth", which)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(made), encoding="utf-8")
    return json.loads(file.read_text(encoding="utf-8"))


def commit(answer: dict, folder: Path) -> str:
    """Writes the truth with a fresh salt; returns the SHA-256 that binds it and tells nothing."""
    import secrets

    text = json.dumps({"salt": secrets.token_hex(16), "truth": answer}, sort_keys=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{answer['name']}.json").write_text(text, encoding="utf-8")
    return hashlib.sha256(text.encode()).hexdigest()


def reveal(path: Path, digest: str) -> dict:
    """Return the truth of a case; ValueError where the file is not the one that was committed to."""
    text = path.read_text(encoding="utf-8")
    if hashlib.sha256(text.encode()).hexdigest() != digest:
        raise ValueError(f"{path}: is not the truth that was published before the diagnosis")
    return json.loads(text)["truth"]
