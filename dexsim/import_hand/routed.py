"""Takes tendons that a file routes over sites, geoms and pulleys as fixed coefficients, where that is near enough."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from dexsim.import_hand import drives, ties

STRAIGHT = 0.1
"""Of a tendon's travel: the most that its length may be off a line in the joints to be taken as one."""
POSES = 400
FREE = 1.0  # rad or m, either way: where a joint without limits is tried


def straighten(spec: mujoco.MjSpec, notes: list[str]) -> dict[str, float]:
    """Replace each routed tendon by one of fixed coefficients, in place, a line of notes each.

    Its length is measured at random poses within the joints' limits, where joint equalities hold. What carries nothing
    (no spring, damper, friction, limit, actuator or equality) is left out.

    Returns those that are not straight enough: by name, how far their length is off a line, a share of its travel.
    Raises MuJoCo's ValueError where it does not compile the file.
    """
    routed = [t for t in spec.tendons if not drives.fixed_arms(t)]
    if not routed:
        return {}
    for k, tendon in enumerate(spec.tendons):
        tendon.name = tendon.name or f"tendon_{k}"
    m, poses, lengths, moves = _lengths(spec)
    used = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON}
    used |= {n for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_TENDON for n in (e.name1, e.name2)}
    bent: dict[str, float] = {}
    idle = []
    for old in routed:
        name = old.name
        carries = [np.any(getattr(old, k)) for k in ("stiffness", "damping", "frictionloss", "armature")]
        if name not in used and not any(carries) and not _limited(old):
            idle.append(name)
            spec.delete(old)
            continue
        length, moved = lengths[:, m.tendon(name).id], np.flatnonzero(moves[m.tendon(name).id])
        rows = np.concatenate([poses[:, moved], np.ones((len(poses), 1))], 1)
        arms = np.linalg.lstsq(rows, length, rcond=None)[0]
        off = float(np.abs(length - rows @ arms).max() / max(np.ptp(length), 1e-9))
        if off > STRAIGHT or not len(moved):
            bent[name] = off
            continue
        _replace(spec, old, [m.joint(j).name for j in moved], arms)
        units = ["mm/m" if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "mm/rad" for j in moved]
        along = ", ".join(f"{1e3 * c:.2f} {unit} of {m.joint(j).name}"
                          for j, c, unit in zip(moved, arms, units, strict=False))  # fmt: skip
        notes.append(f"tendon '{name}' is routed over sites or geoms: taken as {along}; its length is off by at most"
                     f" {100 * off:.1f} % of its travel")  # fmt: skip
    if idle:
        notes.append(f"left out: tendons that carry nothing: {', '.join(idle)}")
    return bent


def _limited(tendon: Any) -> bool:
    return tendon.limited != 0 and bool(np.ptp(tendon.range))


def _lengths(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, np.ndarray, np.ndarray, np.ndarray]:
    """Return the model, joint positions [P, njnt] within limits, lengths [P, ntendon] m there, and which joints change
    which [ntendon, njnt]."""
    copy = spec.copy()  # lengths need neither masses nor volumes, which may be mended later
    for mesh in copy.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    copy.compiler.balanceinertia, copy.compiler.boundmass, copy.compiler.boundinertia = 1, 1e-6, 1e-9
    m = copy.compile()
    d, draw = mujoco.MjData(m), np.random.default_rng(0)
    laws = ties.laws_of(m)
    at = m.jnt_qposadr
    ends = np.where(m.jnt_limited[:, None] > 0, m.jnt_range, m.qpos0[at][:, None] + np.array([-FREE, FREE]))
    poses = draw.uniform(ends[:, 0], ends[:, 1], (POSES, m.njnt))
    for _ in laws:  # chains of followers are as long as there are laws, at most
        for law in laws:
            poses[:, law[0]] = ties.follow(m, law, poses[:, law[1]])
    inside = ((poses >= ends[:, 0] - 1e-9) & (poses <= ends[:, 1] + 1e-9)).all(1)
    poses = poses[inside] if inside.sum() > POSES // 4 else poses

    def measured(pose: np.ndarray) -> np.ndarray:
        d.qpos[:] = m.qpos0
        d.qpos[at] = pose
        mujoco.mj_fwdPosition(m, d)
        return np.array(d.ten_length)

    lengths = np.array([measured(pose) for pose in poses])
    moves = np.zeros((m.ntendon, m.njnt), bool)
    for k in range(0, len(poses), len(poses) // 8):
        for j in range(m.njnt):
            moves[:, j] |= np.abs(measured(poses[k] + 0.05 * np.ptp(ends[j]) * np.eye(m.njnt)[j]) - lengths[k]) > 1e-9
    return m, poses, lengths, moves


def _replace(spec: mujoco.MjSpec, old: Any, joints: Sequence[str], arms: np.ndarray) -> None:
    """Put a fixed tendon where a routed one was. arms: m/rad by joint, then the length where all joints are at 0 [m].

    A fixed tendon has no length of its own there, and this one is measured in turns of a drum as large as its largest
    arm, so that its drive is like a joint's [rad, N m]; the file's actuators pull it by that radius.
    """
    name, rest = old.name, float(arms[-1])
    tied = any(name in (e.name1, e.name2) for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_TENDON)
    drum = 1.0 if tied else float(np.abs(arms[:-1]).max())
    powers = {"stiffness": 2, "damping": 2, "armature": 2, "frictionloss": 1, "actfrcrange": 1, "range": -1,
              "springlength": -1}  # fmt: skip
    copied = {k: np.array(getattr(old, k), float) for k in powers}
    if np.any(copied["springlength"] != -1):  # -1: as long as it is in the file's pose
        copied["springlength"] = copied["springlength"] - rest
    else:
        powers["springlength"] = 0
    if np.ptp(copied["range"]):
        copied["range"] = copied["range"] - rest
    limited, bounded = old.limited, old.actfrclimited
    spec.delete(old)
    new = spec.add_tendon(name=name, limited=limited, actfrclimited=bounded)
    for key, power in powers.items():
        value = copied[key] * drum**power
        setattr(new, key, value if value.ndim else value.item())
    for joint, arm in zip(joints, arms, strict=False):
        new.wrap_joint(joint, float(arm / drum))
    for a in spec.actuators:
        if a.trntype == mujoco.mjtTrn.mjTRN_TENDON and a.target == name:
            if a.gainprm[0]:  # a position's command is a length
                a.ctrlrange = np.array(a.ctrlrange) + a.biasprm[1] * a.gear[0] * rest / a.gainprm[0]
            a.gear = np.array(a.gear) * drum
