"""Fingertip presses in a concealed reality, and what their diagnosis says of its touch sensors as training takes it.

    python -m benchmarks.loop.presses record world=late finger=index out=DIR      # press_1.mcap ..., rig.xml, rig.yaml
    python -m benchmarks.loop.presses pinch world=late out=pinch.mcap             # the thumb's tip on the index's,
    nothing between them python -m benchmarks.loop.presses sum found=DIR,DIR,... out=tactile.yaml      # folders that
    record made and diagnose.py wrote found/ into

What a user does with a hand that lies on a bench: a ball of known size, on three hand-driven slides that are read, is
pressed on each fingertip at places all over its pad, fast and slow, some held; a load cell under the ball. What the
fingertip answers is the reality's touch sensor: the code and the numbers (delay, hysteresis, gains, dead taxels, noise,
threshold, counts) with which policies are judged there, running faster than it is read. `diagnose.py model=rig.xml
servo=rig.yaml` finds it from the recordings alone.

In the judged episodes of a reality, gains and dead taxels are drawn anew each time: another set of fingertips, of one
make. So it is not the single taxels of the pressed fingertips that training is given, but how far gains scatter and how
many are dead. Thresholds and noise far under one count cannot be read off counts and are not handed on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import yaml

from dexsim.gap.rules import TOUCH
from dexsim.paths import CONFIGS

ROOT = Path(__file__).parents[2]
SETS = 3  # recordings of a fingertip; diagnose keeps the last out of the fit
RATE, INNER = 90.0, 4  # readings a second; times the sensor itself runs between two
ALONG, ACROSS = (-5.0e-3, 0.0, 5.0e-3), (-11.0e-3, -5.5e-3, 0.0, 5.5e-3)  # m from the pad's middle: places
DEPTH = (0.5e-3, 1.2e-3)  # m
AWAY = 1.5e-3  # m above the skin between presses
LISTED = TOUCH.law  # the diagnosis lists no gain that is less off
DRAWN = 0.25  # share of what was found by which training draws about it, at most (as for the drives)


def rig(finger: str):
    """Return the press rig of `touch_rig` with a third slide, so that the ball reaches all of the pad: spec."""
    from benchmarks import press_rig

    s, _, direction, along = press_rig.spec(finger)
    side = s.body("slider")
    side.add_joint(
        name="across", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.cross(-direction, along).tolist(), range=[-0.025, 0.02]
    )
    s.joint("slide").range = [-0.02, 0.02]
    s.joint("press").range = [-0.01, 0.02]
    return s


def path(places: list[tuple[float, float]], onset, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] s and positions [T, 3] m (slide, across, press): a press at each place (along, across), then up and on
    to the next. onset(along, across): position of `press` at which the ball touches."""
    knots, at, up = [(0.0, *places[0], onset(*places[0]) - AWAY)], 0.0, None
    for k, (u, v) in enumerate(places):
        touch, deep = onset(u, v), rng.uniform(*DEPTH)
        ramp, hold = rng.choice([0.06, 0.2, 0.4]), 2.0 if k in (1, 6) else rng.choice([0.1, 0.3, 0.8])
        up = touch - AWAY
        at += 0.3
        knots.append((at, u, v, up))
        for wait, press in ((ramp, touch + deep), (hold, touch + deep), (ramp, up), (rng.uniform(0.1, 0.3), up)):
            at += wait
            knots.append((at, u, v, press))
    knots = np.array(knots)
    t = np.arange(0.0, knots[-1, 0], 1e-3)
    return t, np.stack([np.interp(t, knots[:, 0], x) for x in knots[:, 1:].T], 1)


def record(given: dict[str, str]) -> None:
    """Writes SETS recordings of one fingertip, the rig's model and its drives (which nothing commands: the slides are
    led by hand)."""
    from benchmarks.press_rig import SERVO
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    world = yaml.safe_load((CONFIGS / "reality" / f"{given['world']}.yaml").read_text(encoding="utf-8"))
    finger, out = given["finger"], Path(given["out"])
    out.mkdir(parents=True, exist_ok=True)
    s = rig(finger)
    model = s.compile()
    (out / "rig.xml").write_text(s.to_xml(), encoding="utf-8")
    (out / "rig.yaml").write_text(yaml.safe_dump(SERVO, sort_keys=False), encoding="utf-8")
    sensor = Sensor(world, finger)
    rng = np.random.default_rng([world["seed"], sensor.pad])
    places = [(u, v) for u in ALONG for v in ACROSS]
    for k in range(SETS):
        # each time all of them: what is kept out presses no taxel for the first time
        mine = [places[i] for i in rng.permutation(len(places))]
        _one(model, sensor, path(mine, lambda u, v: _onset(model, u, v), rng), k, rng, out / f"press_{k + 1}.mcap")
    print(f"{out}: {finger}, {SETS} recordings", flush=True)


class Sensor:
    """The touch sensor of one hand in a reality: the kernels and settings with which policies are judged there. Gains
    and dead taxels are one draw of them, of the same seed for every finger."""

    def __init__(self, world: dict, finger: str, pinched: bool = False):
        import torch

        from benchmarks.press_rig import RADIUS
        from dexsim.assets import xhand
        from dexsim.assets.objects import library
        from dexsim.hand import load_hand
        from dexsim.tactile.layout import hand_layout
        from dexsim.tactile.posed import PosedEngine
        from dexsim.tactile.shapes import ShapeSet
        from dexsim.tactile.tactile import Tactile

        self.pad, self.stiffness, self.lsb = (
            xhand.FINGERS.index(finger),
            world["tasks"]["grasp"]["randomize"]["contact.stiffness"],
            world["tactile"]["lsb"],
        )
        pads = [f"tip_{x}" for x in xhand.FINGERS]
        self.engine = PosedEngine(1, [*xhand.TIP_BODIES, "indenter"], pads)
        settings = yaml.safe_load((CONFIGS / "tactile" / "default.yaml").read_text(encoding="utf-8")) | world["tactile"]
        if not pinched:  # nothing but the ball comes near, and the work is spared
            settings |= {"feel_others": False, "others": False}
        settings |= {"raw": True, "period": 0.5 / (RATE * INNER)}
        self.touch = Tactile(self.engine, hand_layout(load_hand()), ShapeSet([library()["sphere"]], "cpu"), "indenter",
                             settings, pairs=pads,
                             tips=[xhand.tip_skin_mesh(x)[0] for x in xhand.FINGERS],
                             seed=int(world["seed"]))  # fmt: skip
        self.touch.shape_id.fill_(0)
        self.touch.shape_size[:] = torch.tensor([RADIUS, 0.0, 0.0])
        self.engine.t.xpos[0, :5] = 10.0 * torch.arange(1, 6)[:, None]
        self.body = xhand.TIP_BODIES[self.pad]

    def feel_thumb(self, t: float, depth: float) -> np.ndarray:
        """Return [5, K] N that are reported at time t s, with the thumb's tip pressed `depth` m into this one."""
        import torch

        from dexsim.assets import xhand

        k, x = 5 * xhand.ROWS + 6, self.engine.t
        thumb, mine = xhand.taxel_table("thumb"), xhand.taxel_table(xhand.FINGERS[self.pad])
        turn = _onto(thumb["normal"][k], -mine["normal"][k])
        x.xpos[0, self.pad], x.xmat[0, self.pad] = 0.0, torch.eye(3)
        x.xmat[0, 0] = torch.as_tensor(turn, dtype=torch.float32)
        x.xpos[0, 0] = torch.as_tensor(
            mine["position"][k] - depth * mine["normal"][k] - turn @ thumb["position"][k], dtype=torch.float32
        )
        x.xpos[0, 5] = 100.0  # no ball
        x.pair_normal[0] = 0.0
        x.time[0] = t
        self.touch.launch()
        return self.touch.raw[0].numpy().copy()

    def forget(self) -> None:
        import torch

        self.touch.reset(torch.ones(1, dtype=torch.bool))

    def feel(self, t: float, data, force: float) -> np.ndarray:
        """Return [5, K] N that are reported at time t s, with the rig as it stands and this contact force [N]."""
        import torch

        x, place, m = self.engine.t, self.pad, data.model
        body = m.body(self.body).id
        x.xpos[0, place] = torch.as_tensor(data.xpos[body], dtype=torch.float32)
        x.xmat[0, place] = torch.as_tensor(data.xmat[body].reshape(3, 3), dtype=torch.float32)
        x.xpos[0, 5] = torch.as_tensor(data.geom_xpos[m.geom("ball").id], dtype=torch.float32)
        x.pair_normal[0] = 0.0
        x.pair_normal[0, place] = float(force)
        x.time[0] = t
        self.touch.launch()
        return self.touch.raw[0].numpy().copy()


def _onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [3, 3] rotation that takes the unit vector a to b (not its opposite)."""
    v, c = np.cross(a, b), float(a @ b)
    k = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + k + k @ k / (1 + c)


def _gap(model, data, q) -> float:
    """Return m between the ball and the fingertip; negative: pressed in."""
    for name, x in zip(("slide", "across", "press"), q, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = x
    mujoco.mj_kinematics(model, data)
    tip, ball = model.geom("tip").id, model.geom("ball").id
    return mujoco.mj_geomDistance(model, data, tip, ball, 0.05, np.zeros(6)) - model.geom_margin[tip]


def _onset(model, u: float, v: float) -> float:
    """Return the position of `press` [m] at which the ball begins to touch at (u, v)."""
    data, low, high = mujoco.MjData(model), -0.01, 0.02
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _gap(model, data, (u, v, middle)) > 0 else (low, middle)
    return 0.5 * (low + high)


def _one(model, sensor: Sensor, motion, k: int, rng: np.random.Generator, target: Path) -> None:
    """Write one recording: readings as the bus delivers them, the load cell, the slides' positions."""
    from dexsim.recording import write
    from dexsim.recording.schema import COMMANDS, DEFAULTS, EXTERNAL_FORCE, STATES, TACTILE, Recording, Series, States

    t, q = motion
    reads = np.arange(int((t[-1] - 0.05) * RATE)) / RATE + rng.uniform(0, 1e-3, int((t[-1] - 0.05) * RATE))
    every = np.concatenate(
        [np.linspace(a, b, INNER, endpoint=False) for a, b in zip(reads[:-1], reads[1:], strict=True)] + [reads[-1:]]
    )
    data, n = mujoco.MjData(model), len(reads)
    forces, force = np.zeros((n, 5, sensor.touch.layout.taxels, 3)), np.zeros(n)
    sensor.forget()
    start = float(sensor.engine.t.time[0]) + 1.0  # the sensor's clock goes on
    for i, now in enumerate(every):
        f = sensor.stiffness * max(-_gap(model, data, [np.interp(now, t, x) for x in q.T]), 0.0)
        out = sensor.feel(start + now, data, f)
        if i % INNER == 0:
            forces[i // INNER, ..., 2], force[i // INNER] = out, f
    sensor.touch.check()
    forces[..., 2] = np.round(np.clip(forces[..., 2] / sensor.lsb, 0, 255))
    names = [model.joint(j).name for j in range(model.njnt)]
    order = [("slide", "across", "press").index(x) for x in names]
    at = np.stack([np.interp(reads, t, x) for x in q.T], 1)[:, order]
    cell = np.zeros((n, 6))
    cell[:, 0] = force + 0.02 * rng.standard_normal(n)
    meta = DEFAULTS | {"source": "real", "robot": "press_rig", "joint_names": ",".join(names), "effort_is": "none",
                       "tactile_unit": "count",
                       "tactile_lsb": f"{sensor.lsb:g}",
                       "notes": "a fingertip pressed by a ball of 12 mm radius, led by hand"}  # fmt: skip
    recording = Recording(Path("press.mcap"), meta, tuple(names),
                          Series(np.zeros(0), np.zeros((0, len(names))), COMMANDS, np.zeros(0)),
                          States(Series(reads, np.round(at / 1e-5) * 1e-5, STATES, reads.copy())),
                          tactile=Series(reads, forces, TACTILE),
                          external_force=Series(reads, cell, EXTERNAL_FORCE, reads.copy(), "indenter"),
                          start_ns=int(1e9 + k * 60e9))  # fmt: skip
    write(target, recording)


def pinch(given: dict[str, str]) -> None:
    """Writes a recording of the index's fingertip pressed by the thumb's: whether a fingertip feels another."""
    from dexsim.assets import xhand
    from dexsim.recording import write
    from dexsim.recording.schema import COMMANDS, DEFAULTS, STATES, TACTILE, Recording, Series, States
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    world = yaml.safe_load((CONFIGS / "reality" / f"{given['world']}.yaml").read_text(encoding="utf-8"))
    sensor, rng = Sensor(world, "index", pinched=True), np.random.default_rng(world["seed"])
    t = np.cumsum(rng.uniform(0.9, 1.1, 270)) / RATE
    depth = 0.8e-3 * np.sin(np.pi * t) ** 2
    forces = np.zeros((len(t), 5, xhand.TAXELS_PER_FINGER, 3))
    for i, now in enumerate(t):
        forces[i, ..., 2] = np.round(sensor.feel_thumb(float(now), float(depth[i])) / sensor.lsb)
    meta = DEFAULTS | {"source": "real", "robot": "xhand_right", "joint_names": "distance", "effort_is": "none",
                       "tactile_unit": "count", "tactile_lsb": f"{sensor.lsb:g}",
                       "notes": "the thumb's tip pressed on the index's by hand"}  # fmt: skip
    out = Path(given["out"])
    out.parent.mkdir(parents=True, exist_ok=True)
    states = States(Series(t, np.round(-depth[:, None] / 1e-5) * 1e-5, STATES, t.copy()))
    write(
        out,
        Recording(
            out,
            meta,
            ("distance",),
            Series(np.zeros(0), np.zeros((0, 1)), COMMANDS, np.zeros(0)),
            states,
            tactile=Series(t, forces, TACTILE),
            start_ns=1_000_000_000,
        ),
    )


def make(folders: list[Path], taxels: list[int], lsb: float) -> dict:
    """Return what training is given of all fingertips: (tactile settings). folders: diagnose.py's, one a fingertip;
    felt: taxels of each that felt anything; lsb N a count.

    delay, hysteresis: the median of what was found, from the lowest to the highest, where most fingertips show it;
    where fewer do, from nothing to the highest. Gains: the normal spread that makes those listed, and that the others
    are within LISTED, most likely (1 + spread * normal, as the sensor has it); dead: their share, with a Jeffreys
    prior.
    """
    from scipy.stats import beta

    values: dict[str, list[float]] = {"delay": [], "hysteresis": [], "hysteresis_time": []}
    listed, dead, total = [], 0, 0
    for folder, n in zip(folders, taxels, strict=True):
        effects = {
            f["effect"]: f["parameters"]
            for f in json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))["findings"]
        }
        values["delay"].append(effects["tactile_delay"]["delay"]["value"] if "tactile_delay" in effects else 0.0)
        if "tactile_hysteresis" in effects:
            values["hysteresis"].append(effects["tactile_hysteresis"]["fraction"]["value"])
            values["hysteresis_time"].append(effects["tactile_hysteresis"]["time_constant"]["value"])
        else:
            values["hysteresis"].append(0.0)
        gains = []
        # not one gain for all of the pad
        if "tactile_gain" in effects and ":" in str(effects["tactile_gain"]["taxels"]["value"]):
            gains = np.broadcast_to(
                effects["tactile_gain"]["gain"]["value"],
                (len(str(effects["tactile_gain"]["taxels"]["value"]).split(",")),),
            ).tolist()
        dead += sum(g == 0.0 for g in gains)
        listed += [g for g in gains if g > 0.0]
        total += n
    out: dict = {"lsb": lsb}
    for key, x in values.items():
        found = [v for v in x if v > 0]
        if len(found) > 0.5 * len(x):
            out[key] = _near(float(np.median(found)), min(found), max(found))
        elif found:  # not sure: what was believed is in the range
            out[key] = {"value": float(f"{np.mean(x):.5g}"), "low": 0.0, "high": float(f"{max(found):.5g}")}
    out["gain_spread"] = _near(*spread(np.array(listed), max(total - len(listed), 0)))
    if dead:
        everyone = total + dead  # dead ones did not feel anything
        out["dead"] = _near(dead / everyone, *beta.ppf([0.05, 0.95], dead + 0.5, everyone - dead + 0.5))
    return {"tactile": out}


def spread(listed: np.ndarray, others: int) -> tuple[float, float, float]:
    """Return the standard deviation (value, low, high: 90 % by the likelihood ratio) of gains about 1: `listed` ones as
    they are, `others` known to be within LISTED only."""
    from scipy.stats import norm

    s = np.geomspace(1e-3, 1.0, 600)
    like = norm.logpdf(listed[:, None] - 1.0, scale=s).sum(0) + others * np.log(
        np.maximum(norm.cdf(LISTED / s) - norm.cdf(-LISTED / s), 1e-300)
    )
    inside = s[like > like.max() - 0.5 * 2.706]
    return float(s[np.argmax(like)]), float(inside.min()), float(inside.max())


def _near(value: float, low: float, high: float) -> dict[str, float]:
    """Return the range, no further than DRAWN of the value from it."""
    low, high = max(min(low, value), value * (1 - DRAWN)), min(max(high, value), value * (1 + DRAWN))
    return {k: float(f"{x:.5g}") for k, x in (("value", value), ("low", low), ("high", high))}


def summed(given: dict[str, str]) -> None:
    """Writes tactile.yaml for `train.py tactile_file=` from what diagnose.py found on the fingertips."""
    from dexsim.recording import read

    roots = [Path(p) for p in given["found"].split(",")]
    taxels, lsb = [], 0.0
    for root in roots:
        counts = [read(p, audit=False) for p in sorted(root.glob("press_*.mcap"))]
        pad = max(range(5), key=lambda f: sum(r.tactile.value[:, f, :, 2].sum() for r in counts))
        taxels.append(int((sum((r.tactile.value[:, pad, :, 2] > 2).sum(0) for r in counts) > 3).sum()))
        lsb = counts[0].tactile_lsb
    content = make([r / "found" for r in roots], taxels, lsb)
    head = (
        f"# From presses on {len(roots)} fingertips ({sum(taxels)} taxels felt them), diagnosed one by one: python -m "
        "benchmarks.loop.presses sum\n"
    )
    Path(given["out"]).write_text(
        head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130), encoding="utf-8"
    )
    print(Path(given["out"]).read_text(encoding="utf-8"), flush=True)


def feels_others(path: Path) -> bool:
    """Return whether a fingertip read anything while only another fingertip touched it, in a recording of `pinch`."""
    from dexsim.recording import read

    return bool((read(path, audit=False).tactile.value[..., 2] > 1).any())


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    {"record": record, "pinch": pinch, "sum": summed}[what](dict(item.split("=", 1) for item in rest))
