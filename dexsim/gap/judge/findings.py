"""A fitted effect as physical parameters with intervals, as servo columns and as model fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.actuator.columns import COLUMNS, INDEX
from dexsim.actuator.table import ServoTable
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX as PLANT_INDEX
from dexsim.gap.plant.columns import SERIES_INDEX
from dexsim.gap.search.fit import Param

MODEL_COLUMNS = ("armature", "payload", "own_payload", "com_out", "com_across")  # those of the plant that are fields of the model


def _entry(value: float, low: float, high: float, unit: str) -> dict[str, Any]:
    low, high = min(low, high), max(low, high)
    return {"value": float(value), "low": float(low), "high": float(high), "unit": unit}


def finding_parameters(member, raw: dict[str, float], spread: dict[str, tuple[float, float]], case: Case, table: ServoTable) -> dict[str, Any]:
    """Parameters by the keys of the catalogue, with 90 % intervals. Units of a slide joint have N, m for N.m, rad."""
    s, out = case.scales, {}
    get = lambda k: (raw[k], *spread[k])  # noqa: E731
    force, length = ("N", "m") if s.slide else ("N.m", "rad")
    e = member.id
    if e == "coulomb_friction":
        base = s.base_friction
        out["torque"] = _entry(*(x + base for x in get("torque")), force)
        out["asymmetry"] = _entry(*get("asymmetry"), "1")
    elif e == "stribeck_friction":
        out = {"peak": _entry(*get("peak"), force), "v_s": _entry(*get("v_s"), f"{length}/s")}
    elif e == "viscous_friction":
        out["coefficient"] = _entry(*(x + s.base_damping for x in get("coefficient")), f"{force}.s/{length}")
    elif e == "load_friction":
        out = {k: _entry(*get(k), "1") for k in ("fraction", "fraction_backdriven")}
    elif e == "backlash":
        out["gap"] = _entry(*get("gap"), length)
    elif e == "compliance":
        value, low, high = get("softness")
        invert = lambda x: 1.0 / max(x, 1e-9)  # noqa: E731
        out["stiffness"] = _entry(invert(value), invert(high), invert(low), f"{force}/{length}")
        if "hardening" in raw:  # torque k x (1 + hardening x^2)
            k = invert(value)
            out["hardening"] = _entry(*(h * k**2 for h in get("hardening")), f"1/{length}2")
    elif e == "command_delay":
        out["delay"] = _entry(*get("delay"), "s")
    elif e == "lag":
        out["time_constant"] = _entry(*get("time_constant"), "s")
    elif e == "torque_limit":
        out["torque"] = _entry(*get("torque"), force)
    elif e == "torque_speed_limit":
        out["no_load_speed"] = _entry(*get("no_load_speed"), f"{length}/s")
    elif e == "supply_sag":
        out["sag"] = _entry(*get("sag"), f"1/({force})")
    elif e == "torque_ripple":
        out = {"amplitude": _entry(*get("amplitude"), force), "per_turn": _entry(*get("per_turn"), "1")}
    elif e == "thermal":
        out["per_degree"] = _entry(*get("per_degree"), "1/degC")
        out["of"] = {"value": member.variant.note["of"], "low": None, "high": None, "unit": ""}
    elif e == "joint_coupling":
        out["ratio"] = _entry(*get("ratio"), "1")
        out["from_joint"] = {"value": member.variant.note["from_joint"], "low": None, "high": None, "unit": ""}
    elif e == "position_offset":
        out["offset"] = _entry(*get("offset"), length)
    elif e == "position_scale":
        if "scale" in raw:
            out["scale"] = _entry(*get("scale"), "1")
        else:
            size = np.hypot(raw["ecc_sin"], raw["ecc_cos"])
            half = 0.5 * max(np.ptp(spread["ecc_sin"]), np.ptp(spread["ecc_cos"]))
            out["eccentricity"] = _entry(size, max(size - half, 0.0), size + half, "rad")
    elif e == "payload":
        if "mass" in raw:
            out["mass"] = _entry(*get("mass"), "kg")
            if "com_out" in raw:
                out["com"] = centre_of_mass(case, raw, spread)
        else:
            tilt = [raw.get(f"tilt_{k}", 0.0) for k in "xyz"]
            lows = [spread.get(f"tilt_{k}", (0.0, 0.0))[0] for k in "xyz"]
            highs = [spread.get(f"tilt_{k}", (0.0, 0.0))[1] for k in "xyz"]
            out["tilt"] = {"value": [float(x) for x in tilt], "low": [float(x) for x in lows], "high": [float(x) for x in highs], "unit": "rad"}
    elif e == "inertia":
        out["armature"] = _entry(*get("armature"), "kg" if s.slide else "kg.m2")
    elif e == "gain_mismatch":
        out = {k: _entry(*get(k), "1") for k in raw}
    elif e == "deadband":
        out["width"] = _entry(*get("width"), length)
    elif e == "current_sensor":
        out["gain"] = _entry(*get("gain"), "1")
        per = table.current([case.joint])[0]
        factor = per if np.isfinite(per) else 1.0
        out["offset"] = _entry(*(x * factor for x in get("offset")), "A" if np.isfinite(per) else force)
    return out


def centre_of_mass(case: Case, raw: dict[str, float], spread: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """[3] m: where the added mass sits in the last link's frame, with its interval. Along the hinge the joint feels nothing: there it is
    taken to sit as the link's own centre does."""
    c = case.constants
    value = c.centre + raw["com_out"] * c.places[0] + raw["com_across"] * c.places[1]
    half = np.sqrt(sum((0.5 * np.ptp(spread[k]) * way) ** 2 for k, way in zip(("com_out", "com_across"), c.places, strict=True)))
    lists = {k: [round(float(v), 6) for v in x] for k, x in (("value", value), ("low", value - half), ("high", value + half))}
    return lists | {"unit": "m"}


def handed(p: Param, case: Case) -> bool:
    """Whether training is given a fitted parameter: not the figures of the plant's own that only absorb its inaccuracy."""
    return not (p.nuisance and p.key in ("delay", "lag", "speed_lag", "inertia", "gravity", "damping", "effort_gain") and p.key not in case.ranges and p.key not in case.unknown)


def undamped(trial, kp: float) -> float:
    """What the age of the position that the loop acts on takes of its damping, in units of kd: kp (q - age v) = kp q - kp age v. The loop
    that trains acts on the position of now, so it is given kd without it."""
    return next((kp * float(x) for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if p.columns == ("feedback_delay",)), 0.0)


def columns_beside(case: Case, trial, joints: Sequence[str]) -> dict[str, float]:
    """Servo columns that go with the effects of a trial beside their fitted ones: which kind a deadband is, which of the mechanism's
    joints drags this one, the rotor's inertia [kg.m2] where the model has no armature to take it from."""
    out, fitted = {}, {name for p in trial.fit.params for name in p.columns}
    for x in trial.members:
        for name, value in x.variant.fixed:
            if name in INDEX:
                out[name] = float(joints.index(x.variant.note["from_joint"])) if name == "coupling_from" else value
    if fitted & {"backlash", "softness"} and "rotor" not in fitted and case.constants.armature <= 0:
        out["rotor"] = float(case.plant.base()[0, PLANT_INDEX["rotor"]])
    return out


def servo_changes(table: ServoTable, case: Case, trial, bounds: np.ndarray, joints: Sequence[str]) -> list[str]:
    """Writes what was fitted into the servo table, with intervals, for a mechanism with these joints; returns what the table has no
    column for. Where something changes with temperature, training is given the temperatures that were recorded."""
    left = []
    for p, x, (low, high) in zip(trial.fit.params, trial.fit.x, bounds, strict=True):
        if not handed(p, case):
            continue
        for name in p.columns:
            if name not in INDEX:
                if not p.nuisance and name not in MODEL_COLUMNS:
                    left.append(f"{name}@{case.joint}")
                continue
            column = COLUMNS[INDEX[name]]
            nominal = case.scales.nominal[name]
            if p.mode == "factor":
                value, lo, hi = x * nominal, low * nominal, high * nominal
            elif p.mode == "add":
                value, lo, hi = nominal + x, nominal + low, nominal + high
            else:
                value, lo, hi = x, low, high
            value, lo, hi = (float(np.clip(v, column.low, min(column.high, 1e9))) for v in (value, lo, hi))
            table.set(case.joint, name, round(value, 9), round(min(lo, value), 9), round(max(hi, value), 9))
    lost = undamped(trial, table.value(case.joint, "kp").value)
    kd = table.value(case.joint, "kd")
    if lost > 0.0 and not kd.unknown:
        table.set(case.joint, "kd", *(round(max(x - lost, 0.0), 9) for x in (kd.value, kd.low, kd.high)))
    for name, value in columns_beside(case, trial, joints).items():
        table.set(case.joint, name, value)
    if any(name.startswith("thermal_") for p in trial.fit.params for name in p.columns):
        warmth = case.plant.series[:, SERIES_INDEX["warmth"]]
        table.set(case.joint, "warmth", *(round(float(v), 2) for v in (np.median(warmth), warmth.min(), warmth.max())))
    return left


def earned(finding: dict[str, Any]) -> float:
    """0 to 1: what an effect has earned as a part of the drive, whatever its name is worth: 1 where it takes a tenth or more off the error
    on what was kept out (against all others fitted again without it), less by what other names claim of it, which would go on in another
    way where nothing was recorded."""
    error, others = finding.get("held_out") or {}, sum(float(x["confidence"]) for x in finding.get("alternatives") or ())
    if not error or error["before"] is None or error["after"] is None:
        return 0.0
    less = float(np.clip((error["before"] - error["after"]) / (0.1 * error["before"] + 1e-12), 0.0, 1.0))
    return less * max(1.0 - others, 0.0)


def widen(table: ServoTable, case: Case, member, confidence: float, earned: float = 0.0) -> bool:
    """Widens the ranges of an effect's columns towards what was believed before the fit: all the way at a confidence of a half and
    less, 2 (1 - confidence) of the way above, so that what training draws is on average as far from the belief as the effect is sure;
    and of that way only the share that is not `earned`: a policy meets the drive, not the name. The fitted values stay. Returns whether a
    range changed."""
    changed, share = False, min(1.0, 2.0 * (1.0 - confidence)) * (1.0 - earned)
    if share <= 0.0:
        return False
    for name in (name for p in member.variant.params for name in p.columns if name in INDEX):
        column, now = COLUMNS[INDEX[name]], table.value(case.joint, name)
        believed = float(np.clip(case.scales.nominal[name], column.low, min(column.high, 1e9)))
        if now.unknown or now.low <= believed <= now.high:
            continue
        reach = now.value + share * (believed - now.value)
        if now.low <= reach <= now.high:
            continue
        table.set(case.joint, name, now.value, round(min(now.low, reach), 9), round(max(now.high, reach), 9))
        changed = True
    return changed


def model_changes(spec, case: Case, trial, by_member: dict[str, dict[str, float]]) -> list[str]:
    """Writes effects that live in the model into its spec; returns what was changed, in words."""
    said = []
    if "inertia" in by_member:
        joint = spec.joint(case.joint)
        armature = float(np.ravel(joint.armature)[0]) + by_member["inertia"]["armature"]
        if armature >= 0:
            joint.armature = armature
            said.append(f"model.xml: armature of {case.joint} is {armature:.3g}")
        else:
            said.append(f"{case.joint} has {-by_member['inertia']['armature']:.3g} kg.m2 less inertia than the model's links and armature together; "
                        "change its links' inertia")  # fmt: skip
    payload = by_member.get("payload", {})
    if payload.get("mass"):
        place = None
        if "com_out" in payload:
            c = case.constants
            place = c.centre + payload["com_out"] * c.places[0] + payload["com_across"] * c.places[1]
        own = trial is not None and any(m.id == "payload" and m.variant.note.get("own") for m in trial.members)
        said.append(add_mass(spec, case.joint, payload["mass"], place, own))
    return said


def add_mass(spec, joint: str, mass: float, place: np.ndarray | None, own: bool = False) -> str:
    """Adds a point mass [kg] (or takes it away) at `place` [3] m in the frame of the last link after a joint (own: of the joint's own),
    by default at that link's centre of mass; returns what was done, in words."""
    import mujoco

    from dexsim.gap.plant.mechanics import leaf_of

    model = spec.compile()
    body = int(model.jnt_bodyid[model.joint(joint).id])
    leaf = body if own else leaf_of(model, body)
    name, m0, c0 = model.body(leaf).name or f"the link of {joint}", float(model.body_mass[leaf]), model.body_ipos[leaf].copy()
    place = c0 if place is None else np.asarray(place, float)
    if m0 + mass < 0.05 * m0:
        return f"{joint} carries {-mass:.3g} kg less than the model's links after it; change their masses"
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[leaf])
    rotation = rotation.reshape(3, 3)
    centre = (m0 * c0 + mass * place) / (m0 + mass)
    inertia = rotation @ np.diag(model.body_inertia[leaf]) @ rotation.T
    for m, r in ((m0, c0 - centre), (mass, place - centre)):
        inertia += m * (r @ r * np.eye(3) - np.outer(r, r))
    values, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    body = next(b for b in spec.bodies if b.id == leaf)  # names may be missing
    body.fullinertia = [np.nan] * 6  # not given: principal axes instead
    body.explicitinertial, body.mass, body.ipos, body.iquat, body.inertia = True, m0 + mass, centre, quat, np.maximum(values, 1e-12)
    where = "" if np.allclose(place, c0) else f" at {' '.join(f'{x:.4f}' for x in place)} m in its frame"
    return f"model.xml: {mass:.3g} kg {'added to' if mass > 0 else 'on'} {name}{where}"


def save_model(spec, path: Path) -> None:
    """The model as `path`, with the mesh files that it names by relative paths copied beside it, so that it loads from there."""
    import shutil

    folder = Path(spec.modelfiledir or ".")
    for mesh in spec.meshes:
        if mesh.file and not Path(mesh.file).is_absolute():
            name = Path(spec.meshdir or ".") / mesh.file
            target = path.parent / name
            if (folder / name).is_file() and (folder / name).resolve() != target.resolve():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / name, target)
    path.write_text(spec.to_xml(), encoding="utf-8")
