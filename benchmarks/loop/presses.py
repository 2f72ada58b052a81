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

from benchmarks import press_rig
from benchmarks.real import common
from dexsim.gap.rules import TOUCH
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from tools.assets import xhand

SETS = 3  # recordings of a fingertip; diagnose keeps the last out of the fit
RATE, INNER = 90.0, 4  # readings a second; times the sensor itself runs between two
ALONG, ACROSS = (-5.0e-3, 0.0, 5.0e-3), (-11.0e-3, -5.5e-3, 0.0, 5.5e-3)  # m from the pad's middle: places
DEPTH = (0.5e-3, 1.2e-3)  # m
AWAY = 1.5e-3  # m above the skin between presses
LISTED = TOUCH.law  # the diagnosis lists no gain that is less off
DRAWN = 0.25  # share of what was found by which training draws about it, at most (as for the drives)


def rig(finger: str):
    """Return the press rig of `touch_rig` with a third slide, so that the ball reaches all of the pad: spec."""
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
    """Write SETS recordings of one fingertip, the rig's model and its drives (which nothing commands: the slides are
    led by hand)."""
    world, finger, out = world_of(given["world"]), given["finger"], Path(given["out"])
    s = rig(finger)
    model = s.compile()
    common.rig(out, "rig", s.to_xml(), press_rig.SERVO)
    sensor = Sensor(world, finger)
    rng = np.random.default_rng([world["seed"], sensor.pad])
    places = [(u, v) for u in ALONG for v in ACROSS]
    for k in range(SETS):
        # each time all of them: what is kept out presses no taxel for the first time
        mine = [places[i] for i in rng.permutation(len(places))]
        _one(model, sensor, path(mine, lambda u, v: _onset(model, u, v), rng), k, rng, out / f"press_{k + 1}.mcap")
    print(f"{out}: {finger}, {SETS} recordings", flush=True)


class Sensor(press_rig.Touch):
    """The touch sensor of one hand in a reality: the kernels and settings with which policies are judged there. Gains
    and dead taxels are one draw of them, of the same seed for every finger."""

    def __init__(self, world: dict, finger: str, pinched: bool = False):
        self.stiffness = world["tasks"]["grasp"]["randomize"]["contact.stiffness"]
        self.lsb = world["tactile"]["lsb"]
        settings = yaml.safe_load((CONFIGS / "tactile" / "default.yaml").read_text(encoding="utf-8")) | world["tactile"]
        if not pinched:  # nothing but the ball comes near, and the work is spared
            settings |= {"feel_others": False, "others": False}
        super().__init__(load_hand(), finger, settings | {"raw": True, "period": 0.5 / (RATE * INNER)},
                         int(world["seed"]))  # fmt: skip

    def feel_thumb(self, t: float, depth: float) -> np.ndarray:
        """Return [5, K, 3] N that are reported at time t s, with the thumb's tip pressed `depth` m into this one."""
        import torch

        k, x = 5 * xhand.ROWS + 6, self.engine.t
        thumb, mine = xhand.taxel_table("thumb"), xhand.taxel_table(xhand.FINGERS[self.pad])
        turn = _onto(thumb["normal"][k], -mine["normal"][k])
        x.xpos[0, self.pad], x.xmat[0, self.pad] = 0.0, torch.eye(3)
        x.xmat[0, 0] = torch.as_tensor(turn, dtype=torch.float32)
        x.xpos[0, 0] = torch.as_tensor(
            mine["position"][k] - depth * mine["normal"][k] - turn @ thumb["position"][k], dtype=torch.float32
        )
        x.xpos[0, self.ball] = 100.0  # no ball
        return self.reported(t)

    def forget(self) -> None:
        import torch

        self.touch.reset(torch.ones(1, dtype=torch.bool))


def _onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [3, 3] rotation that takes the unit vector a to b (not its opposite)."""
    v, c = np.cross(a, b), float(a @ b)
    k = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + k + k @ k / (1 + c)


def _onset(model, u: float, v: float) -> float:
    """Return the position of `press` [m] at which the ball begins to touch at (u, v)."""
    data, low, high = mujoco.MjData(model), -0.01, 0.02
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if press_rig.gap(model, data, (u, v, middle)) > 0 else (low, middle)
    return 0.5 * (low + high)


def _one(model, sensor: Sensor, motion, k: int, rng: np.random.Generator, target: Path) -> None:
    """Write one recording: readings as the bus delivers them, the load cell, the slides' positions."""
    t, q = motion
    reads = np.arange(int((t[-1] - 0.05) * RATE)) / RATE + rng.uniform(0, 1e-3, int((t[-1] - 0.05) * RATE))
    every = np.concatenate(
        [np.linspace(a, b, INNER, endpoint=False) for a, b in zip(reads[:-1], reads[1:], strict=True)] + [reads[-1:]]
    )
    data, forces, cell = mujoco.MjData(model), [], np.zeros((len(reads), 6))
    sensor.forget()
    start = float(sensor.engine.t.time[0]) + 1.0  # the sensor's clock goes on
    for i, now in enumerate(every):
        f = sensor.stiffness * max(-press_rig.gap(model, data, [np.interp(now, t, x) for x in q.T]), 0.0)
        out = sensor.feel(start + now, data, f)
        if i % INNER == 0:
            cell[len(forces), 0] = f
            forces.append(out)
    sensor.touch.check()
    cell[:, 0] += 0.02 * rng.standard_normal(len(reads))
    at = np.stack([np.interp(reads, t, x) for x in q.T], 1)
    press_rig.write(target, model, reads, at, np.array(forces, float), sensor.lsb, cell=cell, start=1 + k * 60,
                    notes="a fingertip pressed by a ball of 12 mm radius, led by hand")  # fmt: skip


def pinch(given: dict[str, str]) -> None:
    """Write a recording of the index's fingertip pressed by the thumb's: whether a fingertip feels another."""
    world = world_of(given["world"])
    sensor, rng = Sensor(world, "index", pinched=True), np.random.default_rng(world["seed"])
    t = np.cumsum(rng.uniform(0.9, 1.1, 270)) / RATE
    depth = 0.8e-3 * np.sin(np.pi * t) ** 2
    forces = np.array([sensor.feel_thumb(float(now), float(d)) for now, d in zip(t, depth, strict=True)], float)
    common.save(Path(given["out"]), ("distance",), np.zeros(0), np.zeros((0, 1)), t,
                np.round(-depth[:, None] / press_rig.STEP) * press_rig.STEP,
                tactile=np.round(forces / sensor.lsb), robot="xhand_right", tactile_unit="count",
                tactile_lsb=f"{sensor.lsb:g}", notes="the thumb's tip pressed on the index's by hand")  # fmt: skip


def world_of(name: str) -> dict:
    """Return the numbers of a reality."""
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    return yaml.safe_load((CONFIGS / "reality" / f"{name}.yaml").read_text(encoding="utf-8"))


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
