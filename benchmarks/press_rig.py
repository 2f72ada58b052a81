"""A press rig with hidden effects, for tests and benchmarks of touch: one fingertip of a hand with its taxels, a ball
on two slides, a load cell.

The ball's motion and the contact's depth come from MuJoCo's geometry (the tip's hull), the readings from the touch
kernels that train policies (`dexsim.tactile`): neither is the diagnosis's own plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from dexsim.hand import Hand, load_hand
from dexsim.hand.skin import geom_points
from dexsim.recording import write
from dexsim.recording.schema import COMMANDS, DEFAULTS, EXTERNAL_FORCE, STATES, TACTILE, Recording, Series, States
from dexsim.tactile.sensors import Sensors

RADIUS = 0.012  # m
SERVO = {"drive": "torque", "joints": {"*": {"kp": 4000.0, "kd": 40.0, "torque_limit": 60.0, "no_load_speed": 0.5}}}
LSB, RATE = 0.1, 90.0
TIP = "tip"  # name of the tip's first geom


def spec(
    finger: str = "index", hand: Hand | None = None
) -> tuple[mujoco.MjSpec, np.ndarray, np.ndarray, np.ndarray]:
    """Return the rig: the distal body of a hand's finger (the xHand's) fixed at the origin, a ball on a slide
    against the pad's middle and one along it. Also the pressed point [3] m, the direction in which the ball presses
    [3] and the one in which it slides [3]."""
    hand = hand or load_hand()
    f = hand.finger_names.index(finger)
    sensors = Sensors(hand)
    pads, k = sensors.layout, sensors.middle(f)
    point, normal, along = pads.point[f, k], pads.normal[f, k], pads.tx[f, k]
    out = mujoco.MjSpec()
    out.modelname = "press_rig"
    out.compiler.degree = False
    out.option.gravity = [0, 0, -9.81]
    pad = out.worldbody.add_body(name=hand.tip_bodies[f], pos=[0, 0, 0.1])
    for name in hand.fingers[f].geoms:  # the body's frame is the taxels' frame
        called = TIP if name == hand.fingers[f].geoms[0] else name
        out.add_mesh(name=called, uservert=geom_points(hand, (name,)).ravel().tolist())
        # the hand's tip is a hull inside the skin, rounded by its margin
        pad.add_geom(
            name=called,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=called,
            margin=float(hand.compiled.geom(name).margin[0]),
            contype=0,
            conaffinity=0,
            mass=0.01,
        )
    at = point + normal * (RADIUS + 2e-3) + [0, 0, 0.1]
    side = out.worldbody.add_body(name="slider", pos=at.tolist())
    side.add_joint(name="slide", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=along.tolist(), range=[-0.01, 0.01])
    side.add_geom(
        name="slider",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[1e-3, 0, 0],
        pos=(normal * 0.05).tolist(),
        mass=0.1,
        contype=0,
        conaffinity=0,
    )
    ball = side.add_body(name="indenter")
    ball.add_joint(name="press", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(-normal).tolist(), range=[-0.002, 0.006])
    ball.add_geom(
        name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.1, contype=0, conaffinity=0
    )
    return out, point, -normal, along


def path(kind: int, seconds: float, rng: np.random.Generator, slides: bool) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] s and targets [T, 2] m of (slide, press): presses of several depths, fast and slow, some held."""
    t = np.arange(0.0, seconds, 0.01)
    q = np.zeros((len(t), 2))
    at = 0.2
    while at < seconds - 0.8:
        deep = 2e-3 + rng.uniform(0.3e-3, 1.1e-3)
        ramp, hold = rng.choice([0.08, 0.25, 0.7]), rng.choice([0.1, 0.5, 2.5 if kind == 1 else 1.0])
        x = np.interp(t, [at, at + ramp, at + ramp + hold, at + 2 * ramp + hold], [0, 1, 1, 0]) * deep
        q[:, 1] = np.maximum(q[:, 1], x)
        if slides:
            q[:, 0] += np.interp(t, [at + ramp, at + ramp + 0.5 * hold, at + ramp + hold], [0, 1, 0]) * rng.uniform(
                1e-3, 3e-3
            )
        else:
            q[:, 0] += (
                np.interp(t, [at - 0.2, at], [0, 1]) * rng.uniform(-2e-3, 2e-3) * (t < at + 2 * ramp + hold + 0.05)
            )
        at += 2 * ramp + hold + rng.uniform(0.25, 0.6)
    return t, q


def record(
    folder: Path,
    count: int = 3,
    seconds: float = 8.0,
    seed: int = 0,
    finger: str = "index",
    load_cell: bool = True,
    stiffness: float = 7000.0,
    friction: float = 0.8,
    sensor: dict | None = None,
    gains: dict[int, float] | None = None,
    swapped: Sequence[tuple[int, int]] = (),
    stuck: dict[int, float] | None = None,
    crosstalk: float = 0.0,
    rubber: tuple[float, float] | None = None,
    drift: float = 0.0,
    slides: bool = False,
    shear: bool = False,
    pressed: Sequence[np.ndarray] = (),
    hand: Hand | None = None,
) -> tuple[list[Path], Path, Path]:
    """Writes `count` recordings, the rig's model and its servo; returns their paths.

    stiffness N/m, friction: of the contact. sensor: settings of `dexsim.tactile` (hysteresis, delay, ...). gains: taxel
    -> gain; swapped: pairs of taxels; stuck: taxel -> N; crosstalk: share of its force that a taxel gives its
    neighbours; rubber: (c10, c01) Pa of a Mooney-Rivlin skin in place of the linear contact; drift: relative gain lost
    or won a second over all recordings. pressed: contact forces [T] N of each recording that are given, in place of
    what the spring makes of the depth. hand: whose finger it is (the xHand).
    """
    import yaml

    folder.mkdir(parents=True, exist_ok=True)
    hand = hand or load_hand()
    s, *_ = spec(finger, hand)
    model = s.compile()
    (folder / "rig.xml").write_text(s.to_xml(), encoding="utf-8")
    (folder / "rig.yaml").write_text(yaml.safe_dump(SERVO, sort_keys=False), encoding="utf-8")
    rng = np.random.default_rng(seed)
    paths = []
    for k in range(count):
        t, q = path(k, seconds, rng, slides)
        recording = _one(
            model,
            hand,
            finger,
            t,
            q,
            rng,
            load_cell,
            stiffness,
            friction,
            sensor or {},
            rubber,
            slides or shear,
            crosstalk,
            pressed[k] if len(pressed) else None,
        )
        z = recording.tactile.value
        f = hand.finger_names.index(finger)
        z[:, f] *= 1 + drift * (recording.tactile.t + k * seconds)[:, None, None]
        for taxel, g in (gains or {}).items():
            z[:, f, taxel] *= g
        for a, b in swapped:
            z[:, f, [a, b]] = z[:, f, [b, a]]
        for taxel, value in (stuck or {}).items():
            z[:, f, taxel, 2] = value
        z[:] = np.round(np.clip(z / LSB, [-128, -128, 0], [127, 127, 255]))
        recording.start_ns = int(1e9 + k * seconds * 1e9)
        target = folder / f"press_{k + 1}.mcap"
        write(target, recording)
        paths.append(target)
    return paths, folder / "rig.xml", folder / "rig.yaml"


def as_trained(content: dict) -> dict:
    """Return the settings of `record` for the rig that training would have with a tactile.yaml (its content): every
    best guess, and what was believed elsewhere."""

    def value(x):
        if not isinstance(x, dict):
            return x
        return x["value"] if "value" in x else {k: value(v) for k, v in x.items()}

    tactile, shared = content.get("tactile", {}), content.get("randomize", {})
    out: dict = {"sensor": {"pads": value(tactile["pads"])}} if "pads" in tactile else {}
    for name, key in (("contact.stiffness", "stiffness"), ("object.friction", "friction")):
        if name in shared:
            out[key] = value(shared[name])
    return out


def _one(
    model, hand, finger, t, q, rng, load_cell, stiffness, friction, sensor, rubber, shear, crosstalk, pressed
) -> Recording:
    import torch

    from dexsim.assets.objects import library
    from dexsim.tactile.posed import PosedEngine
    from dexsim.tactile.shapes import ShapeSet
    from dexsim.tactile.tactile import Tactile

    f, sensors = hand.finger_names.index(finger), Sensors(hand)
    # the drives follow with a lag of 20 ms
    a = 1 - np.exp(-0.01 / 0.02)
    real = np.zeros_like(q)
    for i in range(1, len(q)):
        real[i] = real[i - 1] + a * (q[i - 1] - real[i - 1])
    seen = np.sort(rng.uniform(0, 1e-3, int((t[-1] - 0.02) * RATE)) + np.arange(int((t[-1] - 0.02) * RATE)) / RATE)
    now = np.stack([np.interp(seen, t, x) for x in real.T], 1)
    n = len(seen)
    data = mujoco.MjData(model)
    body, ball = model.body(hand.tip_bodies[f]).id, model.geom("ball").id
    tips = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    force = np.zeros(n)
    pads = [f"tip_{x}" for x in hand.finger_names]
    posed = PosedEngine(1, [*hand.tip_bodies, "indenter"], pads)
    settings = {"raw": True, "others": False, "period": 0.5 / RATE, "friction": friction, "shear": shear} | sensor
    if rubber:
        settings |= {
            "sum": "spring",
            "law": "mooney_rivlin",
            "rubber": {"c10": rubber[0], "c01": rubber[1], "thickness": 2e-3},
            "stiffness": {"mooney_rivlin": dict.fromkeys(sensors.layout.kinds, 1.0)},
        }
    touch = Tactile(posed, sensors.layout, ShapeSet([library()["sphere"]], "cpu"), "indenter", settings, pairs=pads,
                    tips=sensors.tips)  # fmt: skip
    touch.shape_id.fill_(0)
    touch.shape_size[:] = torch.tensor([RADIUS, 0.0, 0.0])
    F, away = len(hand.fingers), np.zeros(6)
    posed.t.xpos[0, :F] = 10.0 * torch.arange(1, F + 1)[:, None]
    out = np.zeros((n, *sensors.shape, 3))
    cell = np.zeros((n, 6))
    for i in range(n):
        data.qpos[:] = now[i]
        mujoco.mj_kinematics(model, data)
        gap = min(mujoco.mj_geomDistance(model, data, g, ball, 0.01, away) - model.geom_margin[g] for g in tips)
        force[i] = stiffness * max(-gap, 0.0) if pressed is None else pressed[i]
        posed.t.xpos[0, f] = torch.as_tensor(data.xpos[body], dtype=torch.float32)
        posed.t.xmat[0, f] = torch.as_tensor(data.xmat[body].reshape(3, 3), dtype=torch.float32)
        posed.t.xpos[0, F] = torch.as_tensor(data.geom_xpos[ball], dtype=torch.float32)
        posed.t.pair_normal[0] = 0.0
        posed.t.pair_normal[0, f] = float(force[i])
        posed.t.time[0] = float(seen[i])
        touch.launch()
        if rubber:
            force[i] = float(touch.force_clean[0, f])
        if touch.raw3 is not None:
            out[i] = touch.raw3[0].numpy()
        else:
            out[i, ..., 2] = touch.raw[0].numpy()
        cell[i, 0] = force[i]
    if crosstalk:
        mixed = np.einsum("kl,tlc->tkc", sensors.mixing(f), out[:, f, : sensors.layout.count[f]])
        out[:, f, : mixed.shape[1]] *= 1 - crosstalk
        out[:, f, : mixed.shape[1]] += crosstalk * mixed
    joints = ("slide", "press")
    lsb = 1e-5
    value = np.round(now / lsb) * lsb
    meta = DEFAULTS | {
        "source": "sim",
        "robot": "press_rig",
        "joint_names": ",".join(joints),
        "effort_is": "none",
        "tactile_unit": "count",
        "tactile_lsb": f"{LSB:g}",
        "notes": "a fingertip pressed by a ball",
    }
    recording = Recording(
        Path("press.mcap"),
        meta,
        joints,
        Series(t, q, COMMANDS, t.copy()),
        States(Series(seen, value, STATES, seen.copy())),
        tactile=Series(seen, out, TACTILE),
        start_ns=1_000_000_000,
    )
    if load_cell:
        cell[:, 0] += 0.02 * rng.standard_normal(n)
        recording.external_force = Series(seen, cell, EXTERNAL_FORCE, seen.copy(), "indenter")
    return recording
