"""The simulated half: each joint presses its fingertip on a fixed ball at several forces, through its servo, in C
MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.hand.skin import tip_skins
from dexsim.recording import mechanism
from dexsim.recording.schema import COMMANDS, DEFAULTS, EXTERNAL_FORCE, STATES, TACTILE, Recording, Series, States
from dexsim.sim import ContactPair
from dexsim.tactile.layout import TaxelLayout, hand_layout

RADIUS = 0.012  # m, of the ball
STIFFNESS = 7000.0  # N/m of a fingertip, as in training
PLANTED_DEAD, PLANTED_SWAP = (0.35, 0.36, 0.645), (0.25, 0.55)
"""Faults that are planted in a pad, as shares of its taxels."""
GAP = 0.0015  # m between skin and ball at the start
RAMP_S, HOLD_S, RATE = 0.2, 0.4, 100.0


def pads_of(hand: Hand) -> TaxelLayout:
    """Return a hand's taxels. Raises UserError for one without touch."""
    layout = hand_layout(hand)
    if layout is None:
        raise UserError(f"hand={hand.name}: has no touch pads, and without the fingertips' force none is calibrated")
    return layout


def press_recording(
    hand: Hand, joint: str, servo: dict | str | Path | None = None, levels: int = 8, most: float = 0.8,
    stiffness: float = STIFFNESS, timestep: float = 0.002,
) -> Recording:  # fmt: skip
    """Return one joint presses, from the hand's open pose: up a ladder of `levels` torques to the share `most` of
    its torque limit (less where another joint of the finger could not hold against it), and down again; torque in
    N.m, touch in N. The finger's other joints lean in by what they carry (arm times force over kp), so that the
    finger stands still and every lever arm stays what it is."""
    fingers = dict(zip(hand.joints, hand.finger_of_joint, strict=True))
    if fingers.get(joint, -1) < 0:
        raise UserError(
            f"joints={joint}: no joint of a finger; those are: {', '.join(x for x, f in fingers.items() if f >= 0)}"
        )
    m = mechanism.of_hand(hand, servo, gravity=[0.0, 0.0, -9.81])
    f, j = fingers[joint], hand.joints.index(joint)
    finger = hand.fingers[f]
    place, arms = _site(hand, j, f)
    body = m.spec.worldbody.add_body(name="anvil", pos=list(place))
    body.add_geom(name="anvil", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], contype=0, conaffinity=0)
    for geom in finger.geoms:
        _pair(m.spec, geom, stiffness)
    limit, kp = m.column("torque_limit"), m.column("kp")
    friction = m.column("coulomb_friction")
    top = most * limit[j]
    for other in finger.joints:
        if other != j and abs(arms[other]) > 1e-4:  # what this joint can hold, as torque of the pressing one
            top = min(top, 0.8 * limit[other] * abs(arms[j]) / abs(arms[other]))
    low, high = hand.limits[j]
    reach = GAP / arms[j]
    force = top / abs(arms[j]) * np.concatenate([np.arange(1, levels + 1), np.arange(levels - 1, 0, -1)]) / levels
    pose = hand.pose("open")
    goals = np.tile(pose, (len(force), 1))
    goals[:, j] += reach
    for other in finger.joints:  # every joint leans in by what it will carry, so that none gives way
        goals[:, other] += force * arms[other] / kp[other]
    if goals[:, j].max() > high + 1.0 or goals[:, j].min() < low - 1.0:
        raise UserError(
            f"{joint}: pressing to {top:.2f} N.m would need a target of {goals[:, j].max():.2f} rad: kp {kp[j]:g} is"
            " too soft"
        )
    commands = _ladder(pose, goals, (j, pose[j] + reach))
    run = mechanism.drive(
        m, commands, hand.joints, float(commands.t[-1]), pose, timestep, frame_s=0.01,
        pairs=[ContactPair("press", ("body", finger.body), ("geom", "anvil"))],
    )  # fmt: skip
    out = mechanism.recorded(run, m, commands, hand.joints)
    times = np.minimum((np.arange(len(run.qpos)) + 1) * run.frame_s, run.t[-1])
    out.tactile = Series(times, _taxels(hand, run, f, place), TACTILE)
    out.meta |= {
        "tactile_unit": "N",
        "tactile_lsb": "1",
        "tactile_layout": hand.robot,
        "notes": f"press: joint={joint}; ball of {RADIUS * 1e3:g} mm; friction {friction[j]:g} N.m",
    }
    return out


def make(
    out: str | Path, hand: Hand, joints: Sequence[str], servo: dict | str | Path | None = None, levels: int = 8,
    realistic: bool = False, seed: int = 0, say: Callable[[str], None] = print,
) -> list[Path]:  # fmt: skip
    """Write press_<joint>.mcap of each joint into a folder; realistic: as the hardware would have delivered it (mA,
    counts)."""
    from dexsim.console import folders
    from dexsim.recording.realistic import realistic as as_hardware
    from dexsim.recording.writer import write

    out = folders.make(Path(out).expanduser(), "out=")
    paths = []
    for k, joint in enumerate(joints):
        recording = press_recording(hand, joint, servo, levels)
        if realistic:
            recording = as_hardware(recording, seed + k)
        path = out / f"press_{joint}.mcap"
        write(path, recording)
        paths.append(path)
        say(f"mcap     {path.parent.name}/{path.name}: {recording.duration:.1f} s")
    return paths


def rolled_recording(hand: Hand, presses: int = 240, seed: int = 0, frames: int = 16) -> Recording:
    """Return a ball pressed all over every fingertip, one after the other, on a load cell: /tactile [N] and
    /external_force [N], the hand at rest. Each of `presses` places a finger is pressed to 2..8 N and let go within
    `frames` samples, and followed by a rest."""
    import torch

    rng = np.random.default_rng(seed)
    rest = 6
    layout, F = pads_of(hand), len(hand.fingers)
    n = F * presses * (frames + rest)
    centre, force = np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros((n, F))
    row = 0
    for f in range(F):
        for _ in range(presses):
            k = int(rng.integers(layout.count[f]))
            point = layout.point[f, k] + 1e-3 * rng.uniform(-1, 1, 3)
            size = rng.uniform(2.0, 8.0) * np.sin(np.pi * (np.arange(frames) + 0.5) / frames) ** 2
            force[row : row + frames, f] = size
            centre[row : row + frames] = point + np.outer(RADIUS - size / STIFFNESS, layout.normal[f, k])
            row += frames + rest
    active = force.argmax(1)
    away = 10.0 * (active[:, None] + 1) * [[1.0, 0, 0]]
    at = centre + np.where(force.max(1, keepdims=True) > 0, away, 0)

    def pose_pads(posed: Any) -> None:
        posed.t.xpos[:, :F] = torch.tensor([[10.0 * (f + 1), 0.0, 0.0] for f in range(F)])  # the pads, far apart
        posed.t.xmat[:] = torch.eye(3)
        posed.t.xpos[:, F] = torch.as_tensor(at, dtype=torch.float32)
        posed.t.pair_normal[:, :F] = torch.as_tensor(force, dtype=torch.float32)

    forces = _touched(hand, n, pose_pads)
    t = np.arange(n) / RATE
    load = np.zeros((n, 6))
    load[:, 2] = forces[..., 2].sum((1, 2))  # what the pad bears (a press beyond its rim meets no taxel)
    pose = np.tile(hand.pose("open"), (n, 1))
    notes = f"ball of {RADIUS * 1e3:g} mm pressed all over each fingertip, seed {seed}"
    meta = DEFAULTS | {"source": "sim", "robot": hand.robot, "joint_names": ",".join(hand.joints),
                       "effort_is": "torque_Nm", "tactile_layout": hand.robot,
                       "effort_sign": "+1", "tactile_unit": "N", "tactile_lsb": "1", "notes": notes}  # fmt: skip
    series = lambda x, topic: Series(t, x, topic, t.copy())  # noqa: E731
    states = States(series(pose, STATES), None, series(0 * pose, STATES))
    return Recording(Path("rolled.mcap"), meta, hand.joints, Series.empty(COMMANDS, len(hand.joints)), states,
                     tactile=Series(t, forces, TACTILE),
                     external_force=Series(t, load, EXTERNAL_FORCE, t.copy(), "load_cell"),
                     start_ns=1_000_000_000)  # fmt: skip


def delivered(recording: Recording, seed: int = 0) -> Recording:
    """Return a press recording as the hardware would have delivered it. The load cell is read with the taxels, which
    hold their last
    value: else that delay would look like hysteresis."""
    from dexsim.recording.realistic import realistic

    dense, out = recording.external_force, realistic(recording, seed)
    assert dense is not None and out.tactile is not None  # our own recording has both
    out.external_force = dense.latest(out.tactile.t)
    return out


def make_rolled(
    out: str | Path, hand: Hand, realistic: bool = True, seed: int = 0, faults: bool = False
) -> Path:
    """Write rolled.mcap. faults: with gains that differ by 15 %, three dead taxels and a swapped pair on one finger, as
    a rehearsal; what was planted is said."""
    from dexsim.console import folders
    from dexsim.recording.writer import write

    recording = rolled_recording(hand, seed=seed)
    if faults:
        rng = np.random.default_rng([seed, 1])
        assert recording.tactile is not None  # our own recording has it
        z = recording.tactile.value[..., 2]
        z /= np.exp(0.15 * rng.standard_normal(z.shape[1:]))
        f = hand.others[0]
        dead, swap = ([int(x * pads_of(hand).count[f]) for x in planted] for planted in (PLANTED_DEAD, PLANTED_SWAP))
        z[:, f, dead] = 0.0
        z[:, f, swap] = z[:, f, swap[::-1]]
        what = f"dead {dead}, swapped {tuple(swap)}; every pad: gains of 15 % spread"
        print(f"planted  {hand.finger_names[f]} finger: {what}")
    if realistic:
        recording = delivered(recording, seed)
    path = folders.make(Path(out).expanduser(), "out=") / "rolled.mcap"
    write(path, recording)
    print(f"mcap     {path.parent.name}/{path.name}: {recording.duration:.1f} s")
    return path


def _ladder(pose: np.ndarray, goals: np.ndarray, touch: tuple[int, float]) -> Series:
    """Commands [T, J] at RATE: ramps of RAMP_S between levels [L, J] held for HOLD_S. touch: (joint, its angle at
    contact), reached first."""
    first = pose.copy()
    first[touch[0]] = touch[1]
    t, q = [0.0, 0.3], [pose, first]
    for goal in (*goals, pose):
        t += [t[-1] + RAMP_S, t[-1] + RAMP_S + HOLD_S]
        q += [goal, goal]
    times = np.arange(0, t[-1] + 0.5 / RATE, 1 / RATE)
    value = np.stack([np.interp(times, t, x) for x in np.array(q).T], 1)
    return Series(times, value, COMMANDS, times.copy())


def _site(hand: Hand, joint: int, finger: int) -> tuple[np.ndarray, dict[int, float]]:
    """Return where the ball goes: against the taxel whose normal lies most along the motion there of a joint that
    closes. Returns its centre [3] m and the lever arms [m] of the finger's joints about the contact's normal."""
    model = hand.compiled
    data = mujoco.MjData(model)
    hand.couplings.put(data, hand.pose("open"))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    layout, count = pads_of(hand), pads_of(hand).count[finger]
    body = data.body(hand.tip_bodies[finger])
    rot = body.xmat.reshape(3, 3)
    point = layout.point[finger, :count] @ rot.T + body.xpos
    normal = layout.normal[finger, :count] @ rot.T

    jacobian = np.zeros((count, 3, model.nv))
    for k in range(count):
        mujoco.mj_jac(model, data, jacobian[k], None, point[k], body.id)
    moves = hand.couplings.along(jacobian, data.qpos)  # [count, 3, J]: what follows moves along
    way = moves[:, :, joint] * (hand.closing[joint] or 1.0)
    size = np.linalg.norm(way, axis=1)
    good = (way * normal).sum(1) / size
    if rows := layout.rows[finger]:  # away from both ends of the pad
        row = np.arange(count) % rows
        good = good - 10.0 * ((row < rows // 4) | (row > 2 * rows // 3))
    k = int(good.argmax())
    arms = {i: float(moves[k, :, i] @ normal[k]) for i in hand.fingers[finger].joints}
    return point[k] + normal[k] * (RADIUS + GAP), arms


def _pair(spec: mujoco.MjSpec, tip: str, stiffness: float) -> None:
    """Let the ball touch this tip and nothing else, with the tips' stiffness [N/m]."""
    model = spec.compile()
    d = 0.95
    k = stiffness * (1 - d) * model.body_invweight0[model.geom(tip).bodyid[0], 0]
    spec.add_pair(
        name=f"press_{tip}", geomname1=tip, geomname2="anvil", condim=3, friction=[0.8, 0.8, 0.005, 1e-4, 1e-4],
        solref=[-k, -2 * np.sqrt(k)], solimp=[d, d, 1e-3, 0.5, 2],
    )  # fmt: skip


def _taxels(hand: Hand, run: mechanism.Run, finger: int, place: np.ndarray) -> np.ndarray:
    """Return the taxel forces [T, F, K, 3] N of each frame: the physics' contact force, spread by the touch model."""
    import torch

    def pose_hand(posed: Any) -> None:
        F, data = len(hand.fingers), mujoco.MjData(run.model)
        ids = [run.model.body(b).id for b in hand.tip_bodies]
        for w, qpos in enumerate(run.qpos):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(run.model, data)
            posed.t.xpos[w, :F] = torch.as_tensor(data.xpos[ids], dtype=torch.float32)
            posed.t.xmat[w, :F] = torch.as_tensor(data.xmat[ids].reshape(F, 3, 3), dtype=torch.float32)
        posed.t.xpos[:, F] = torch.as_tensor(place, dtype=torch.float32)
        posed.t.pair_normal[:, finger] = torch.as_tensor(run.pair_normal[:, 0], dtype=torch.float32)

    return _touched(hand, len(run.qpos), pose_hand)


def _touched(hand: Hand, n: int, place: Callable[[Any], None]) -> np.ndarray:
    """Return the taxel forces [n, F, K, 3] N of poses in which `place` puts fingertips, the ball behind them, and the
    normal force of each tip (`PosedEngine`)."""
    import torch

    from dexsim.assets.objects import library
    from dexsim.tactile.posed import PosedEngine
    from dexsim.tactile.shapes import ShapeSet
    from dexsim.tactile.tactile import Tactile

    layout, pairs = pads_of(hand), [f"tip_{x}" for x in hand.finger_names]
    posed = PosedEngine(n, [*hand.tip_bodies, "anvil"], pairs)
    touch = Tactile(
        posed, layout, ShapeSet([library()["sphere"]], "cpu"), "anvil", {"raw": True, "others": False}, pairs=pairs,
        tips=tip_skins(hand),
    )  # fmt: skip
    place(posed)
    touch.shape_id.fill_(0)
    touch.shape_size[:] = torch.tensor([RADIUS, 0.0, 0.0])
    touch.launch()
    assert touch.raw is not None  # asked for above
    out = np.zeros((n, len(hand.fingers), layout.taxels, 3))
    out[..., 2] = touch.raw.numpy()
    return out
