"""A press rig: one fingertip of a hand with its taxels, a ball on slides, a load cell; what is read of it, and its
recordings."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from benchmarks.real.common import save
from dexsim.hand import Hand, load_hand
from dexsim.hand.skin import geom_points
from dexsim.tactile.sensors import Sensors

RADIUS = 0.012  # m
SERVO = {"drive": "torque", "joints": {"*": {"kp": 4000.0, "kd": 40.0, "torque_limit": 60.0, "no_load_speed": 0.5}}}
TIP = "tip"  # name of the tip's first geom
FREE = {"contype": 0, "conaffinity": 0}  # of geoms: MuJoCo has nothing to do with their contacts
STEP = 1e-5  # m of the slides' encoders


def spec(finger: str = "index", hand: Hand | None = None) -> tuple[mujoco.MjSpec, np.ndarray, np.ndarray, np.ndarray]:
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
        margin = float(hand.compiled.geom(name).margin[0])
        pad.add_geom(name=called, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=called, margin=margin, mass=0.01, **FREE)
    at = point + normal * (RADIUS + 2e-3) + [0, 0, 0.1]
    side = out.worldbody.add_body(name="slider", pos=at.tolist())
    side.add_joint(name="slide", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=along.tolist(), range=[-0.01, 0.01])
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "mass": 0.1, **FREE}
    side.add_geom(name="slider", size=[1e-3, 0, 0], pos=(normal * 0.05).tolist(), **sphere)
    ball = side.add_body(name="indenter")
    ball.add_joint(name="press", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(-normal).tolist(), range=[-0.002, 0.006])
    ball.add_geom(name="ball", size=[RADIUS, 0, 0], **sphere)
    return out, point, -normal, along


def gap(model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray) -> float:
    """Return m between the ball and the fingertip of a rig with its slides at q; negative: pressed in."""
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    ball, body = model.geom("ball").id, model.geom(TIP).bodyid[0]
    tips = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    return min(mujoco.mj_geomDistance(model, data, g, ball, 0.05, np.zeros(6)) - model.geom_margin[g] for g in tips)


class Touch:
    """The touch sensor of a hand, one of whose fingertips is pressed by the ball: the kernels that train policies, with
    `settings` of theirs."""

    def __init__(self, hand: Hand, finger: str, settings: dict, seed: int = 0):
        import torch

        from dexsim.assets.objects import library
        from dexsim.tactile.posed import PosedEngine
        from dexsim.tactile.shapes import ShapeSet
        from dexsim.tactile.tactile import Tactile

        self.pad, self.body = hand.finger_names.index(finger), hand.tip_bodies[hand.finger_names.index(finger)]
        sensors, pads, self.ball = Sensors(hand), [f"tip_{x}" for x in hand.finger_names], len(hand.fingers)
        self.engine = PosedEngine(1, [*hand.tip_bodies, "indenter"], pads)
        self.touch = Tactile(self.engine, sensors.layout, ShapeSet([library()["sphere"]], "cpu"), "indenter",
                             {"raw": True} | settings, pairs=pads, tips=sensors.tips, seed=seed)  # fmt: skip
        self.touch.shape_id.fill_(0)
        self.touch.shape_size[:] = torch.tensor([RADIUS, 0.0, 0.0])
        self.engine.t.xpos[0, : self.ball] = 10.0 * torch.arange(1, self.ball + 1)[:, None]

    def feel(self, t: float, data: mujoco.MjData, force: float) -> np.ndarray:
        """Return [F, K, 3] N that are reported at t s, with the rig as it stands and this contact force [N]."""
        import torch

        x, m = self.engine.t, data.model
        body = m.body(self.body).id
        x.xpos[0, self.pad] = torch.as_tensor(data.xpos[body], dtype=torch.float32)
        x.xmat[0, self.pad] = torch.as_tensor(data.xmat[body].reshape(3, 3), dtype=torch.float32)
        x.xpos[0, self.ball] = torch.as_tensor(data.geom_xpos[m.geom("ball").id], dtype=torch.float32)
        return self.reported(t, force)

    def reported(self, t: float, force: float = 0.0) -> np.ndarray:
        """Return [F, K, 3] N that are reported at t s, with bodies where they are."""
        x = self.engine.t
        x.pair_normal[0] = 0.0
        x.pair_normal[0, self.pad] = float(force)
        x.time[0] = t
        self.touch.launch()
        if self.touch.raw3 is not None:
            return self.touch.raw3[0].numpy().copy()
        z = self.touch.raw[0].numpy()
        return np.stack([np.zeros_like(z), np.zeros_like(z), z], -1)


def write(path: Path, model: mujoco.MjModel, t: np.ndarray, q: np.ndarray, z: np.ndarray, lsb: float, **more) -> Path:
    """Write what a rig's bus delivers: its slides at q [S, J] and forces z [S, F, K, 3] N in counts of lsb [N]. more:
    of `save`."""
    joints = tuple(model.joint(j).name for j in range(model.njnt))
    sent = more.pop("sent", (np.zeros(0), np.zeros((0, len(joints)))))
    counts = np.round(np.clip(z / lsb, [-128, -128, 0], [127, 127, 255]))
    return save(path, joints, *sent, t, np.round(q / STEP) * STEP, tactile=counts, robot="press_rig",
                tactile_unit="count", tactile_lsb=f"{lsb:g}", **more)  # fmt: skip
