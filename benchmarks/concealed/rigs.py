"""The concealed rigs: pendulums on a bench, arms, a finger, a hand; what is true of each, and what is believed.

Every nominal quantity is a few percent off: gains, limits, masses, rotors, frictions, each drawn by joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from benchmarks.concealed.plant import Rig, dynamics, pendulum

OFF = 0.03  # how far off each nominal quantity may be
SPATIAL = tuple(f"spatial{n}" for n in range(2, 8))
SHAPES = ("one", "bench2", "bench4", "arm2", "arm3", "finger", "hand", *SPATIAL)
# how far off a spatial rig is, as a calibrated machine is: lengths and centres of mass (shares), axes [rad], gravity
# and gravity by run [rad], eccentricity of encoders [rad], cables (share of the weight), supply (share lost while the
# others give their typical torque), torque constant and friction (share per degC)
GEOMETRY, AXES, TILT, TILT_BY_RUN, ECCENTRIC = 0.012, 0.005, 0.009, 0.0026, (4e-4, 9e-4)
CABLE, SAG, WARM_TORQUE, WARM_FRICTION = 0.01, 0.01, -0.001, -0.003
RADIUS = 0.012  # m, of the bobs
COLUMNS = {"kp": "kp", "kd": "kd", "torque_limit": "torque_limit", "no_load_speed": "no_load_speed",
           "coulomb": "coulomb_friction", "viscous": "viscous_friction"}


@dataclass
class Drawn:
    """A rig as it is and as it is believed to be. true, believed: parameters [J]; unit [J]: a typical torque, N.m; low,
    high [J]: where its joints may be sent, rad; voltage: whether the loop gives a duty; motor_side: whether it reads
    the motor; hand: what recordings of a hand call it, reach [J, 2] rad: the ranges of its joints. believed_rig: as its
    file has the rig, None for the true one; gravity [R, 3] m/s2: of each recording, None for the rig's."""

    rig: Rig
    shape: str
    true: dict[str, np.ndarray]
    believed: dict[str, np.ndarray]
    unit: np.ndarray
    inertia: np.ndarray
    low: np.ndarray
    high: np.ndarray
    voltage: bool
    motor_side: bool
    hand: str = ""
    reach: np.ndarray | None = None
    believed_rig: Rig | None = None
    gravity: np.ndarray | None = None

    @property
    def joints(self) -> int:
        return len(self.rig.names)


def _chain(rng: np.random.Generator, axes: list[str], start: float) -> Rig:
    """Return a serial arm that hangs along -z; each link shorter than the one before."""
    n, vectors = len(axes), {"x": [1.0, 0, 0], "y": [0, 1.0, 0], "z": [0, 0, 1.0]}
    lengths = start * np.cumprod(np.r_[1.0, rng.uniform(0.6, 0.9, n - 1)])
    if axes[0] != axes[-1]:
        lengths[0] = 0.02  # a knuckle: two axes close together
    offset = np.zeros((1, n, 3))
    offset[0, 1:, 2] = -lengths[:-1]
    com = np.zeros((1, n, 3))
    com[0, :, 2] = -lengths * rng.uniform(0.5, 0.9, n)
    place = np.stack([np.zeros(n, int), np.arange(n)], 1)
    return Rig(tuple(f"joint{i}" for i in range(n)), place, np.tile(np.eye(3), (1, n, 1, 1)), offset,
               np.array([[vectors[a] for a in axes]]), com,
               np.tile(0.4 * RADIUS**2 * np.eye(3), (1, n, 1, 1)), np.array([0, 0, -9.81]))  # fmt: skip


def draw(rng: np.random.Generator, shape: str, hand: dict | None = None) -> Drawn:
    """Return a rig of a shape. hand: which, as `dexsim.hand.Hand.identity` says it (None: the right xHand). Raises
    ValueError for a shape that there is not."""
    if shape == "hand":
        return _hand(rng, hand)
    if shape in SPATIAL:
        return _spatial(rng, shape)
    if shape in ("one", "bench2", "bench4"):
        n = {"one": 1, "bench2": 2, "bench4": 4}[shape]
        rig = pendulum(radius=RADIUS, names=tuple(f"joint{i}" for i in range(n)),
                       lengths=tuple(float("%.4g" % rng.uniform(0.07, 0.14)) for _ in range(n)))
        mass = rng.uniform(0.08, 0.3, n)
    elif shape in ("arm2", "arm3", "finger"):
        rig = _chain(rng, {"arm2": ["y", "y"], "arm3": ["y", "y", "y"], "finger": ["x", "y", "y"]}[shape],
                     rng.uniform(0.07, 0.12))
        n = len(rig.names)
        mass = rng.uniform(0.1, 0.2) * np.cumprod(np.r_[1.0, rng.uniform(0.6, 0.9, n - 1)])
    else:
        raise ValueError(f"no shape '{shape}'; there are {', '.join(SHAPES)}")
    return _driven(rng, rig, shape, mass)


def _driven(rng: np.random.Generator, rig: Rig, shape: str, mass: np.ndarray) -> Drawn:
    """Return a rig with drives that suit links of mass [J] kg."""
    n = len(mass)
    b = {"mass": mass, "rotor": rng.uniform(2e-4, 8e-4, n)}
    weight, link = _scales(rig, mass)
    inertia = link + b["rotor"]
    kp = weight * rng.uniform(6, 14, n)
    b |= {"torque_limit": weight * rng.uniform(5, 9, n), "no_load_speed": rng.uniform(9, 18, n),
          "coulomb": weight * rng.uniform(0.04, 0.1, n),
          "viscous": weight * rng.uniform(0.005, 0.02, n)}  # fmt: skip
    kd = 2 * rng.uniform(0.3, 0.6, n) * np.sqrt(kp * inertia)
    if rig.com.shape[1] > 1:  # links shake one another
        b["no_load_speed"] = 1.5 * b["no_load_speed"]
    voltage = bool(rng.uniform() < 0.25)
    if voltage:  # the motor's own back-EMF is the damping, as in a small hobby servo
        b["no_load_speed"] = np.maximum(b["no_load_speed"], b["torque_limit"] / (1.6 * np.sqrt(kp * inertia)))
        b["kp"], b["kd"] = kp / b["torque_limit"], 0.2 * kd / b["torque_limit"]
    else:
        b["kp"], b["kd"] = kp, kd
    return _finish(rng, rig, shape, b, 0.1 * kp, inertia, np.full(n, -0.8), np.full(n, 0.8), voltage,
                   bool(rng.uniform() < 0.3))


def _spatial(rng: np.random.Generator, shape: str) -> Drawn:
    """Return an arm, or a hand of two or three fingers, of joints about any axis, whose geometry, gravity, encoders,
    cables, supply and warmth are a little off."""
    n = int(shape.removeprefix("spatial"))
    C = int(rng.integers(2, 4)) if n >= 4 and rng.uniform() < 0.5 else 1
    depth = [len(x) for x in np.array_split(np.arange(n), C)]
    D = max(depth)
    place = np.array([(c, d) for c in range(C) for d in range(depth[c])])
    lengths = rng.uniform(0.07, 0.12, (C, 1)) * np.cumprod(np.c_[np.ones(C), rng.uniform(0.6, 0.9, (C, D - 1))], 1)
    offset, com, axis = np.zeros((C, D, 3)), np.zeros((C, D, 3)), np.zeros((C, D, 3))
    offset[:, 1:, 2] = -lengths[:, :-1]
    offset[:, 0, 1] = 0.04 * (np.arange(C) - 0.5 * (C - 1))
    com[..., 2] = -lengths * rng.uniform(0.5, 0.9, (C, D))
    com[..., :2] = 0.1 * lengths[..., None] * rng.uniform(-1, 1, (C, D, 2))
    for c in range(C):
        for d in range(D):  # two neighbours are not alike everywhere, the last bears its link
            axis[c, d] = np.eye(3)[rng.choice(3, p=[0.4, 0.4, 0.2] if d < D - 1 else [0.5, 0.5, 0.0])]
    eye, spread = np.tile(np.eye(3), (C, D, 1, 1)), np.tile(0.4 * RADIUS**2 * np.eye(3), (C, D, 1, 1))
    names = tuple(f"joint{i}" for i in range(n))
    stated = Rig(names, place, eye, offset, axis, com, spread, np.array([0, 0, -9.81]))
    off = lambda size, of: size * rng.uniform(-1, 1, of)  # noqa: E731
    turned = axis + off(AXES, axis.shape)
    true = Rig(names, place, eye, offset * (1 + off(GEOMETRY, (C, D, 1))),
               turned / np.linalg.norm(turned, axis=2, keepdims=True),
               com * (1 + off(GEOMETRY, (C, D, 1))) + GEOMETRY * lengths[..., None] * rng.uniform(-1, 1, com.shape),
               spread, stated.gravity)  # fmt: skip
    mass = rng.uniform(0.1, 0.2) * np.cumprod(np.r_[1.0, rng.uniform(0.7, 0.95, n - 1)])
    out = _driven(rng, stated, shape, mass)
    weight = _scales(stated, mass)[0]
    lean = off(TILT, 2) + off(TILT_BY_RUN, (8, 2))
    out.rig, out.believed_rig = true, stated
    out.gravity = 9.81 * np.c_[np.sin(lean), -np.cos(np.linalg.norm(lean, axis=1))]
    out.true |= {"eccentric": rng.uniform(*ECCENTRIC, n), "cable": rng.uniform(0, CABLE, n) * weight / 0.8,
                 "thermal_torque": rng.uniform(WARM_TORQUE, 0, n), "thermal_friction": rng.uniform(WARM_FRICTION, 0, n),
                 "sag": np.full(n, rng.uniform(0, SAG) / max(float(out.unit.sum()), 1e-9))}  # fmt: skip
    return out


def _scales(rig: Rig, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weight [J] N.m (at its largest over some poses) and link inertia [J] seen by each hinge."""
    C, D = rig.com.shape[:2]
    m = np.zeros((1, C * D))
    m[0, rig.slots] = mass
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (64, C, D))
    tile = lambda x: np.tile(x.reshape(1, C, D), (64, 1, 1))  # noqa: E731
    M, h = dynamics(rig, tile(m), 0 * q, 0 * q + 1, q, 0 * q, np.tile(rig.gravity, (64, 1)))
    weight = np.abs(h.reshape(64, -1)).max(0)[rig.slots]
    inertia = np.einsum("bcdd->bcd", M).reshape(64, -1).mean(0)[rig.slots]
    return np.maximum(weight, 0.4 * weight.max()), inertia


def _finish(rng, rig, shape, b, unit, inertia, low, high, voltage, motor_side) -> Drawn:
    b = {k: np.array([float("%.5g" % x) for x in v]) for k, v in b.items()}
    n = len(rig.names)
    true = {k: v * (1 + rng.uniform(-OFF, OFF, n)) for k, v in b.items()}
    true["com"] = 1 + rng.uniform(-OFF / 3, OFF / 3, n)
    true["voltage"], true["motor_side"] = np.full(n, float(voltage)), np.full(n, float(motor_side))
    # drawn for every rig, used where an effect asks for them
    true |= {"peak_speed": rng.uniform(0.05, 0.4, n), "per_turn": rng.integers(6, 40, n).astype(float),
             "phase": rng.uniform(-3, 3, n),
             "eccentric_at": rng.uniform(-3, 3, n), "dwell_time": np.full(n, 1.5),
             "cable_rest": low + 0.5 * (high - low), "tooth_at": low + rng.uniform(0.3, 0.7, n) * (high - low),
             "tooth_width": 0.05 * (high - low), "mount_inertia": 0.5 * inertia,
             "heat": 15.0 / np.maximum(unit, 1e-3) ** 2}  # fmt: skip
    return Drawn(rig, shape, true, b, unit, inertia, low, high, voltage, motor_side)


def _hand(rng: np.random.Generator, which: dict | None) -> Drawn:
    """Return a hand by the numbers of its description (lengths, masses, axes), held still, gravity along -z of the
    palm."""
    import mujoco

    from dexsim.hand import load_hand
    from dexsim.recording.mechanism import mechanism, of_hand

    if which is None:
        m = mechanism(None, None)
    else:
        m = of_hand(load_hand(which["hand"], which["hand_mirror"], which["hand_scale"]))
    model = m.spec.compile()
    chains: list[list[int]] = []
    for b in range(1, model.nbody):
        if not model.body_jntnum[b]:
            continue
        parent = model.body_parentid[b]
        home = next((c for c in chains if c[-1] == parent), None)
        if home is None:
            chains.append([b])
        else:
            home.append(b)
    C, D = len(chains), max(map(len, chains))
    eye = np.tile(np.eye(3), (C, D, 1, 1))
    frame, offset, axis, com = eye.copy(), np.zeros((C, D, 3)), np.tile([0.0, 0, 1.0], (C, D, 1)), np.zeros((C, D, 3))
    spread = 1e-4 * eye
    names, place, mass = [None] * model.njnt, np.zeros((model.njnt, 2), int), np.zeros(model.njnt)

    def rotation(quat: np.ndarray) -> np.ndarray:
        out = np.zeros(9)
        mujoco.mju_quat2Mat(out, quat)
        return out.reshape(3, 3)

    for c, chain in enumerate(chains):
        for d, b in enumerate(chain):
            j = model.body_jntadr[b]
            own, base = rotation(model.body_quat[b]), model.body_pos[b]
            if d == 0:  # the palm is posed in the world
                root = rotation(model.body_quat[model.body_parentid[b]])
                own, base = root @ own, root @ base
            frame[c, d], offset[c, d], axis[c, d], com[c, d] = own, base, model.jnt_axis[j], model.body_ipos[b]
            turn = rotation(model.body_iquat[b])
            spread[c, d] = turn @ np.diag(model.body_inertia[b] / model.body_mass[b]) @ turn.T
            names[j], place[j], mass[j] = model.joint(j).name, (c, d), model.body_mass[b]
    rig = Rig(tuple(names), place, frame, offset, axis, com, spread, np.array([0, 0, -9.81]))
    column, dof = lambda key: m.column(key).astype(float), model.jnt_dofadr
    b = {"mass": mass, "rotor": model.dof_armature[dof].copy(), "kp": column("kp"), "kd": column("kd"),
         "torque_limit": column("torque_limit"),
         "no_load_speed": column("no_load_speed"), "coulomb": column("coulomb_friction"),
         "viscous": column("viscous_friction") + model.dof_damping[dof]}  # fmt: skip
    link = _scales(rig, mass)[1]
    span = model.jnt_range[:, 1] - model.jnt_range[:, 0]
    out = _finish(rng, rig, "hand", b, 0.1 * b["kp"], link + b["rotor"], model.jnt_range[:, 0] + 0.1 * span,
                  model.jnt_range[:, 1] - 0.15 * span, False, False)
    out.true["delay"] = column("delay")
    out.believed["delay"] = column("delay")
    out.hand, out.reach = m.robot, model.jnt_range.copy()
    return out


def files(where: Path, d: Drawn) -> list[str]:
    """Writes rig.xml and servo.yaml as they are believed (none for the right xHand, which `diagnose` knows); returns
    the settings that hand them to `diagnose.py`."""
    if d.hand == "xhand_right":
        return []
    g, rig, b = (lambda x: "%.5g" % x), d.believed_rig or d.rig, d.believed
    pos = lambda v: " ".join(g(x) for x in v)  # noqa: E731
    C, D = rig.com.shape[:2]
    lines = ['<mujoco model="rig">', '  <compiler angle="radian"/>', "  <worldbody>"]
    for c in range(C):
        depth = 0
        for k in range(D):
            j = next((i for i, at in enumerate(rig.place) if tuple(at) == (c, k)), None)
            if j is None:  # a finger of fewer joints than the longest
                continue
            depth += 1
            turn, low, high, inertia = "", -3.0, 3.0, ""
            if d.reach is not None:
                w = rig.spread[c, k] * b["mass"][j]
                (low, high), turn = d.reach[j], f' quat="{" ".join("%.12g" % x for x in _quaternion(rig.frame[c, k]))}"'
                parts = (w[0, 0], w[1, 1], w[2, 2], w[0, 1], w[0, 2], w[1, 2])
                inertia = (f'<inertial pos="{pos(rig.com[c, k])}" mass="{g(b["mass"][j])}"'
                           f' fullinertia="{" ".join("%.9g" % x for x in parts)}"/>')  # fmt: skip
            lines += [f'<body name="link{j}" pos="{pos(rig.offset[c, k])}"{turn}>{inertia}',
                      f'<joint name="{rig.names[j]}" type="hinge" axis="{pos(rig.axis[c, k])}"'
                      f' armature="{g(b["rotor"][j])}" range="{g(low)} {g(high)}"/>']  # fmt: skip
            if d.reach is None:
                lines += [f'<geom name="bob{j}" type="sphere" size="{RADIUS}" pos="{pos(rig.com[c, k])}"'
                          f' mass="{g(b["mass"][j])}" contype="0" conaffinity="0"/>']  # fmt: skip
        lines += ["</body>"] * depth
    lines += ["  </worldbody>", "</mujoco>", ""]
    (where / "rig.xml").write_text("\n".join(lines), encoding="utf-8")
    delay = {"delay": float(g(b["delay"][0]))} if "delay" in b else {}
    servo = {"drive": "voltage" if d.voltage else "torque",
             "joints": {name: {ours: float(g(b[k][j])) for k, ours in COLUMNS.items()} | delay for j,
                        name in enumerate(rig.names)}, "loop_rate": 1000,
             "loop_encoder": "motor" if d.motor_side else "joint", "position_encoder": "joint"}  # fmt: skip
    (where / "servo.yaml").write_text(yaml.safe_dump(servo, sort_keys=False), encoding="utf-8")
    return [f"model={where / 'rig.xml'}", f"servo={where / 'servo.yaml'}"]


def _quaternion(turn: np.ndarray) -> np.ndarray:
    import mujoco

    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, turn.reshape(-1))
    return out
