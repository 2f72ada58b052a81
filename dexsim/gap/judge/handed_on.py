"""What is handed on to training: fitted effects as servo columns and as model fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexsim.actuator.columns import COLUMNS, FEATURES, INDEX
from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import CATALOGUE, model_columns
from dexsim.gap.finding import Finding
from dexsim.gap.judge import confidence
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX as PLANT_INDEX
from dexsim.gap.plant.columns import SERIES_INDEX, Param, expand
from dexsim.gap.rules import BELIEF
from dexsim.gap.search.search import Trial

if TYPE_CHECKING:
    import mujoco

    from dexsim.gap.search.hypotheses import Member, Trial


# -- effects as servo columns and model fields ------------------------------------------------------------------------


def handed(p: Param, case: Case) -> bool:
    """Return whether training is given a fitted parameter: not the figures of the plant's own that only absorb its
    inaccuracy."""
    return not (
        p.nuisance
        and p.key in ("delay", "lag", "speed_lag", "inertia", "gravity", "damping", "presliding", "effort_gain")
        and p.key not in case.ranges
        and p.key not in case.unknown
    )


def undamped(trial: Trial, kp: float) -> float:
    """Return what the age of the position that the loop acts on takes of its damping, in units of kd: kp (q - age v) =
    kp q - kp age v. The loop that trains acts on the position of now, so it is given kd without it."""
    return next(
        (kp * float(x) for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if p.columns == ("feedback_delay",)),
        0.0,
    )


APPROXIMATED = frozenset(name for e in CATALOGUE for name in e.approximated)
BY_WARMTH = frozenset(name for e in CATALOGUE for name in e.by_warmth)


def columns_beside(case: Case, trial: Trial, joints: Sequence[str]) -> dict[str, float]:
    """Return servo columns that go with the effects of a trial beside their fitted ones: which kind a deadband is,
    which of the mechanism's joints drags this one, the rotor's inertia [kg.m2] where the model has no armature to take
    it from."""
    out: dict[str, float] = {}
    fitted = {name for p in trial.fit.params for name in p.columns}
    for x in trial.members:
        row = expand(case.plant, trial.fit.params, trial.fit.x[None], trial.fixed)[0, 0]
        out |= x.effect.columns_beside(x.variant, joints, row, case)
    if fitted & {*FEATURES["play"]} and "rotor" not in fitted and case.constants.armature <= 0:
        out["rotor"] = float(case.plant.base()[0, PLANT_INDEX["rotor"]])
    return out


def on_motor(case: Case, trial: Trial) -> float:
    """Share of the model's friction and damping of the joint that a trial has on the motor's side of a play or an
    elasticity; 0 where nothing parts the two."""
    params, x = trial.fit.params, trial.fit.x
    share = next((float(v) for p, v in zip(params, x, strict=True) if p.columns == ("motor_share",)), 0.0)
    if share < BELIEF.tolerance:
        return 0.0
    row = expand(case.plant, params, x[None])[0, 0]
    parted = row[PLANT_INDEX["backlash"]] > 0.0 or row[PLANT_INDEX["softness"]] > 0.0
    return share if parted else 0.0


def moved_friction(case: Case, trial: Trial) -> dict[str, float]:
    """Return what goes from the model's joint to the servo's columns, which act on the motor, with `on_motor`: friction
    N.m, damping N.m.s/rad."""
    share = on_motor(case, trial)
    if share <= 0.0:
        return {}
    return {
        "coulomb_friction": share * case.constants.friction,
        "viscous_friction": share * case.constants.damping,
    }


def state(table: ServoTable, case: Case, name: str, value: float, low: float, high: float) -> None:
    """Writes a fitted column of a joint with its interval into the servo table; where the recordings state different
    ones, also the factor on what each states."""
    stated = [float(row[INDEX[name]]) for row in case.plant.nominal]
    if table.fitted is not None and np.ptp(stated) > 0 and case.scales.nominal[name]:
        table.fitted.setdefault(case.joint, {})[name] = round(value / case.scales.nominal[name], 9)
    table.set(case.joint, name, round(value, 9), round(min(low, value), 9), round(max(high, value), 9))


def servo_changes(
    table: ServoTable, case: Case, trial: Trial, bounds: np.ndarray, joints: Sequence[str], whole: bool = False
) -> None:
    """Writes what was fitted into the servo table, with intervals, for a mechanism with these joints; whole: what is
    not `handed` too. Where something changes with temperature, training is given the temperatures that were
    recorded."""
    for p, x, (low, high) in zip(trial.fit.params, trial.fit.x, bounds, strict=True):
        if not (whole or handed(p, case)):
            continue
        for name in p.columns:
            if name not in INDEX:
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
            state(table, case, name, value, lo, hi)
    kp, kd = table.value(case.joint, "kp"), table.value(case.joint, "kd")
    assert kp.value is not None  # a table with an unknown one is refused
    lost = undamped(trial, kp.value)
    if lost > 0.0 and kd.value is not None:
        table.set(case.joint, "kd", *(round(max(x - lost, 0.0), 9) for x in (kd.value, kd.low, kd.high)))
    for name, value in columns_beside(case, trial, joints).items():
        table.set(case.joint, name, value)
    for name, more in moved_friction(case, trial).items():
        now = table.value(case.joint, name)
        if now.value is None:
            continue  # what is added to the unknown is unknown
        table.set(case.joint, name, *(round(x + more, 9) for x in (now.value, now.low, now.high)))
    if any(name in BY_WARMTH for p in trial.fit.params for name in p.columns):
        warmth = case.plant.series[:, SERIES_INDEX["warmth"]]
        table.set(case.joint, "warmth", *(round(float(v), 2) for v in (np.median(warmth), warmth.min(), warmth.max())))


def values_of(trial: Trial) -> dict[str, dict[str, float]]:
    """Return fitted values of each member by parameter."""
    known = dict(zip([p.key for p in trial.fit.params], trial.fit.x, strict=True))
    return {x.id: {p.key: float(known[f"{x.id}.{p.key}"]) for p in x.variant.params} for x in trial.members}


def missing_of(case: Case, trial: Trial) -> tuple[str, ...]:
    """Return what of a fitted hypothesis training cannot be given, as effect@joint, with what it is given instead if
    anything."""
    out = []
    for x in trial.members:
        columns = {c for p in x.variant.params for c in p.columns} | {n for n, v in x.variant.fixed if v}
        if lacks := x.effect.lacks(x.variant):
            out.append(f"{lacks[0]}@{case.joint} ({lacks[1]})")
        elif columns - set(INDEX) - model_columns() - APPROXIMATED:
            out.append(f"{x.id} ({x.variant.label})@{case.joint}" if x.variant.label else f"{x.id}@{case.joint}")
    return tuple(out)


def earned(finding: Finding) -> float:
    """Return 0 to 1: what an effect has earned as a part of the drive, whatever its name is worth: 1 where it takes a
    tenth or more off the error on what was held out (against all others fitted again without it), less by what other
    names claim of it, which would go on in another way where nothing was recorded."""
    error, others = finding.held_out or {}, sum(float(x["confidence"]) for x in finding.alternatives)
    if not error or error["before"] is None or error["after"] is None:
        return 0.0
    return confidence.earned(error["before"], error["after"]) * max(1.0 - others, 0.0)


def widen(table: ServoTable, case: Case, member: Member, sure: float, earned: float = 0.0) -> bool:
    """Widens the ranges of an effect's columns towards what was believed before the fit: all the way where its name is
    half `sure` and less, 2 (1 - sure) of the way above, so that what training draws is on average as far from the
    belief as the effect is sure; and of that way only the share that is not `earned`: a policy meets the drive, not the
    name. The fitted values stay. Returns whether a range changed."""
    changed, share = False, min(1.0, 2.0 * (1.0 - sure)) * (1.0 - earned)
    if share <= 0.0:
        return False
    for name in (name for p in member.variant.params for name in p.columns if name in INDEX):
        column, now = COLUMNS[INDEX[name]], table.value(case.joint, name)
        believed = float(np.clip(case.scales.nominal[name], column.low, min(column.high, 1e9)))
        if now.value is None or now.low <= believed <= now.high:
            continue
        reach = now.value + share * (believed - now.value)
        if now.low <= reach <= now.high:
            continue
        table.set(case.joint, name, now.value, round(min(now.low, reach), 9), round(max(now.high, reach), 9))
        changed = True
    return changed


def model_changes(spec: mujoco.MjSpec, case: Case, trial: Trial, by_member: dict[str, dict[str, float]]) -> list[str]:
    """Writes effects that live in the model into its spec (by_member: fitted values by effect; trial: None for values
    alone); returns what was changed, in words."""
    notes = {m.id: m.variant.note for m in trial.members} if trial is not None else {}
    said = [
        x for e in CATALOGUE if e.id in by_member for x in e.to_model(spec, case, by_member[e.id], notes.get(e.id, {}))
    ]
    share = on_motor(case, trial) if trial is not None else 0.0
    if share > 0.0:
        joint = spec.joint(case.joint)
        joint.frictionloss = float(np.ravel(joint.frictionloss)[0]) * (1.0 - share)
        joint.damping = np.asarray(joint.damping, float) * (1.0 - share)
        said.append(
            f"model.xml: {100 * share:.0f} % of the friction and damping of {case.joint} went to its motor (servo.yaml)"
        )
    return said


MODEL_FILES = "model_files"  # folder beside model.xml


def save_model(spec: mujoco.MjSpec, path: Path) -> None:
    """The model as `path`, with the mesh, height field and texture files that it names by relative paths copied into
    `model_files` beside it, so that it loads from there; nothing is written anywhere else, whatever those paths say."""
    import shutil

    spec, folder = spec.copy(), Path(spec.modelfiledir or ".")
    places: dict[Path, str] = {}
    for things, where in ((spec.meshes, spec.meshdir), (spec.hfields, spec.meshdir), (spec.textures, spec.texturedir)):
        for thing in things:
            source = folder / (where or ".") / thing.file
            if (
                not thing.file
                or Path(thing.file).is_absolute()
                or Path(where or ".").is_absolute()
                or not source.is_file()
            ):
                continue
            source = source.resolve()
            if source not in places:
                places[source] = f"{len(places)}_{source.name}"
                (path.parent / MODEL_FILES).mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, path.parent / MODEL_FILES / places[source])
            thing.file = places[source]
    if places:
        spec.meshdir = spec.texturedir = MODEL_FILES
        spec.modelfiledir = str(path.parent)
        spec.compile()
    path.write_text(spec.to_xml(), encoding="utf-8")
