"""From a model file to a hand's folder: every step, its guesses, and what a person says instead."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from dexsim import surface, yaml_text
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.import_hand import (
    build,
    corrections,
    drives,
    figures,
    folder,
    frame,
    geometry,
    moves,
    poses,
    shapes,
    source,
    taxels,
    ties,
    tree,
)
from dexsim.import_hand import skin as links
from dexsim.import_hand.corrections import Corrections
from dexsim.import_hand.drives import Pull
from dexsim.import_hand.text import write

DROPS = 256  # objects let fall to find where they are held: some 40 s of one core, with the trial
SWEEP = 0.28  # rad of error at which a motor gives its full torque: the servo's stiffness where nothing is known


@dataclass
class Settings:
    """packages: where package:// is looked for; palm: body to take for the palm; coupled: "keep" or "independent";
    density: kg/m3 of links without inertia; inertia: "shapes" or "balance", where one is none; effort
    N m, speed rad/s: of joints whose file says none; pads: (rows,
    columns), None for none, or a CSV file; skin: touch on further links (`dexsim.import_hand.skin`), None: as before;
    holes: "hull" or "refuse"; drops: objects let fall to find where the hand
    holds them, 0: its cupped pose alone tells; name of the hand; said: places of hand.yaml and their values."""

    packages: Sequence[Path] = ()
    palm: str | None = None
    coupled: str = "keep"
    density: float | None = None
    inertia: str | None = None
    effort: float | None = None
    speed: float | None = None
    pads: tuple[int, int] | Path | None = (8, 6)
    skin: str | None = None
    holes: str = "hull"
    drops: int = field(default_factory=lambda: DROPS)
    name: str | None = None
    said: dict[str, Any] = field(default_factory=dict)


@dataclass
class Result:
    """folder; hand: content of hand.yaml; lines: what was found, for a person; carried: files a person changed;
    corrected: places whose values a person gave."""

    folder: Path
    hand: dict[str, Any]
    lines: list[str]
    carried: list[str]
    corrected: list[str]


def import_hand(
    model: Path, out: Path, settings: Settings | None = None, say: Callable[[str], None] = lambda text: None,
    picture: bool = True,
) -> Result:  # fmt: skip
    """Read the robot in `model` (URDF or MJCF) and write the hand's folder `out`.

    say: is given every line of what was found, as it is found. Raises UserError, one line, with nothing written.
    """
    settings = settings or Settings()
    note = folder.claim(out)
    lines: list[str] = []

    def tell(text: str) -> None:
        lines.append(text)
        say(text)

    robot = source.read(model, settings.packages, settings.coupled, settings.density, settings.inertia)
    where, m = f"model {model}", robot.model
    found = tree.find(m, where, settings.palm)
    found.passive = {j for j in found.every if m.joint(j).name in robot.passive}
    figures.mesh_sizes(robot, found)
    mended = figures.mended(robot, found, settings.inertia)
    pulls = drives.within(robot.drives.pulls, m, {m.joint(j).name for j in found.every})
    fixes = _corrections(out, note, found, m, settings, _driven(m, found, pulls))
    guessed: list[str] = []

    def pick(place: str, guess: Any, sure: bool = False) -> Any:
        value = fixes.pick(place, guess)
        if not fixes.has(place) and not sure:
            guessed.append(place)
        return value

    for text in [*robot.notes, *mended]:
        tell(text)
    for text in robot.coupled:
        tell(f"coupled: {text}" if settings.coupled == "keep" else
             f"taken apart: {text}: each of these joints has a motor of its own here")  # fmt: skip
    if found.before_palm:
        tell(f"fixed: {', '.join(found.before_palm)} (before the palm '{m.body(found.palm).name}')")

    undriven = [m.joint(j).name for j in found.joints if m.joint(j).name not in robot.drives.moved]
    if robot.drives.moved and undriven and settings.coupled == "keep":
        tell(f"check:   no actuator of the file moves {', '.join(undriven)}: each has a motor of its own here")

    motions, doubts = _motions(m, found.fingers, fixes, pick, pulls)
    said = fixes.pick("opposing", None)
    names = [f.name for f in found.fingers]
    if said is not None and (not isinstance(said, list) or not said or any(n not in names for n in said)):
        raise UserError(f"{out / folder.HAND}: opposing ({said}): must name fingers; there are {', '.join(names)}")
    thumbs = [names.index(n) for n in said] if said is not None else frame.opposing(m, motions)
    if said is None:
        guessed.append("opposing")
    palm = frame.palm(m, found, motions, thumbs)
    palm = _palm(palm, pick)
    tell(f"palm     {m.body(found.palm).name}: forward {_axis(palm.forward)}, normal {_axis(palm.normal)} of it;"
         f" {frame.handedness(m, found, motions, thumbs, palm)} hand")  # fmt: skip
    for k, x in enumerate(motions):
        bend = [m.joint(j).name for j in x.flexion]
        side = [m.joint(j).name for j in x.finger.joints if j not in x.flexion]
        tell(f"finger   {x.finger.name + ('*' if k in thumbs else ''):<9}tip {m.body(x.finger.tip).name}, bends:"
             f" {' '.join(bend)}{'; turns: ' + ' '.join(side) if side else ''}; {1e3 * x.reach:.0f} mm")  # fmt: skip
    tell(f"         * presses against the others: {', '.join(names[k] for k in thumbs)}")
    for text in doubts:
        tell(f"check:   {text}")

    known = figures.check(robot, found, motions, settings.effort, settings.speed)
    for what, missing, guess, unit in (
        ("effort", known.guessed_effort, known.effort, "N m"), ("speed", known.guessed_speed, known.speed, "rad/s"),
    ):  # fmt: skip
        if missing:
            values = sorted({guess[j] for j in missing})
            values_text = f"{values[0]:g}" if len(values) == 1 else f"{values[0]:g} to {values[-1]:g}"
            first = ", ".join(missing[:4]) + (" ..." if len(missing) > 4 else "")
            tell(f"missing: {what} of {len(missing)} joints ({first}):"
                 f" guessed {values_text} {unit}; say {what}=NUMBER, or correct joints in hand.yaml")  # fmt: skip
    if known.guessed_armature:
        tell(
            f"missing: rotor inertia (armature) of {len(known.guessed_armature)} joints: put at {figures.ROTOR:g} kg m2"
            " per N m"
        )
    if known.guessed_damping:
        tell(f"missing: damping of {len(known.guessed_damping)} joints: put at {figures.DAMPING:g} N m s/rad per N m")
    if known.massless:
        tell(f"no mass: {', '.join(known.massless)}")
    for text in known.warnings:
        tell(f"check:   {text}")

    reach = ties.reach(m, found.joints, where)
    for j, (low, high, follower) in reach.items():
        tell(f"check:   joint '{m.joint(j).name}' goes from {low:.3g} to {high:.3g} only: there '{follower}', which"
             " follows it, is at its limit")  # fmt: skip
    made = shapes.make(m, found, motions, palm)
    name = settings.name or _word(fixes.pick("name", robot.name))
    text = f"{name}: written by dexsim import-hand from {model.name}"
    exclusions = poses.near_the_palm(m, found)
    own = build.build(name, m, found, made, known, exclusions, text, pulls)
    search = _search(own, m, found, motions, thumbs, palm, pulls, reach)
    drawn = poses.always_overlapping(search)
    if drawn:
        own = build.build(name, m, found, made, known, exclusions + drawn, text, pulls)
        search = _search(own, m, found, motions, thumbs, palm, pulls, reach)
    never, meet = poses.meetings(search)
    tell(f"shapes   {len(made.capsules)} capsules on links and palm, {len(made.cores)} tips of {shapes.CORNERS}"
         f" corners at most; {1e3 * made.error[0]:.1f} mm off the links; {meet} pairs of links can meet")  # fmt: skip

    order = [str(j) for j in fixes.pick(corrections.ORDER, _driven(m, found, pulls))]
    closed, open_ = _poses(search, order, fixes, pick, out, where, tell)
    own = build.build(name, m, found, made, known, sorted(set(exclusions + drawn + never)), text, pulls)

    pads = _pads(m, motions, made, settings, where, tell)
    hand = _hand(
        name, model, m, found, motions, thumbs, palm, known, order, open_, closed, search, pads, pulls, fixes, pick
    )
    corrections.lay_over(hand, fixes)
    if sensed := fixes.pick("sensed", [j for j in robot.sensed if search.m.joint(j).id >= 0]):
        hand["sensed"] = sensed
    hand["guessed"] = sorted(dict.fromkeys(guessed), key=_rank(hand))
    hand["source"] = {"file": model.name, "written by": "dexsim import-hand"}
    carried: list[str] = []
    with folder.staged(out, note, carried) as stage:
        own.write(stage)
        for finger, pad in pads.items():
            (stage / f"taxels_{finger}.csv").write_text(pad.csv(), encoding="ascii")
        if pads:
            for finger, skin in zip(names, made.skins, strict=True):
                (stage / f"skin_{finger}.obj").write_text(surface.obj(surface.hull(skin)), encoding="ascii")
        (stage / "servo.yaml").write_text(_servo(name, hand, robot), encoding="utf-8")
        write(hand, stage)
        if settings.drops and not fixes.has("places.catch"):
            _drop_region(stage, hand, settings.drops, tell)
            write(hand, stage)
        loaded = _loads(stage)
        before = yaml_text.load(out / folder.HAND, "hand") if note and (out / folder.HAND).is_file() else {}
        requested = settings.skin or (before.get("source") or {}).get("skin")
        if requested:
            hand["skin"], hand["source"]["skin"] = links.write_pads(loaded, stage, requested, tell), requested
            write(hand, stage)
            loaded = _loads(stage)
            if picture:
                links.show(loaded, stage, tell)
        for line in moves.faults(moves.moves(loaded)):
            tell(f"check:   {line}")
        if picture:
            _picture(loaded, stage, tell)
        folder.write_note(stage, hand, sorted(fixes.used - {corrections.ORDER}))
    return Result(out, hand, lines, carried, sorted(fixes.used))


def _driven(m: mujoco.MjModel, found: tree.Tree, pulls: Sequence[Pull]) -> list[str]:
    """Return names of what commands go to: joints with a drive of their own, and actuators that pull tendons."""
    return [m.joint(j).name for j in found.joints] + [p.name for p in pulls]


def _corrections(
    out: Path, note: dict[str, Any] | None, found: tree.Tree, m: mujoco.MjModel, settings: Settings, theirs: list[str]
) -> Corrections:
    """Return what a person said: in the hand.yaml that is there, and in the command."""
    fixes = Corrections()
    file = out / folder.HAND
    if note is not None and file.is_file():
        from dexsim.hand import schema

        schema.read(file)  # refuses what is no hand.yaml, with the place
        now, before = yaml_text.load(file, "hand"), note["hand"]
        new = {f["tip"]["body"]: f["name"] for f in now["fingers"]}
        old = {f["name"]: new.get(f["tip"]["body"], f["name"]) for f in before["fingers"]}
        for finger in before["fingers"]:
            finger["name"] = old[finger["name"]]
        before["opposing"] = [old.get(n, n) for n in before["opposing"]]
        before["guessed"] = [_renamed(p, old) for p in before.get("guessed") or []]
        for f in found.fingers:
            f.name = new.get(m.body(f.tip).name, f.name)
        first = [f["name"] for f in now["fingers"]]
        found.fingers.sort(key=lambda f: first.index(f.name) if f.name in first else len(first))
        fixes = corrections.read(now, before, [_renamed(p, old) for p in note.get("said") or []])
        wire = [j["name"] for j in now["joints"]]
        if len(set(wire)) == len(theirs) and set(wire) == set(theirs) and wire != theirs:
            fixes.values[corrections.ORDER] = wire
    fixes.values |= settings.said
    return fixes


def _renamed(place: str, names: dict[str, str]) -> str:
    parts = place.split(".")
    return (
        ".".join(["fingers", names.get(parts[1], parts[1]), *parts[2:]])
        if parts[0] == "fingers" and len(parts) > 2
        else place
    )


def _motions(
    m: mujoco.MjModel, fingers: list[tree.Finger], fixes: Corrections, pick: Callable[..., Any], pulls: list[Pull]
) -> tuple[list[frame.Motion], list[str]]:
    """Return how each finger moves, with what a person said of it, and what is not sure of its closing side."""
    bends: list[list[int] | None] = []
    for finger in fingers:
        place = f"fingers.{finger.name}.flexion"
        flexion = fixes.pick(place, None)
        theirs = [m.joint(j).name for j in finger.joints]
        drums = [p.name for p in pulls if set(p.arms) & set(theirs)]
        if flexion is not None and any(j in drums for j in flexion):
            flexion = None  # the joints that it pulls bend the finger; that they do is no guess
        if flexion is not None and (
            not isinstance(flexion, list) or not flexion or any(j not in theirs for j in flexion)
        ):
            raise UserError(f"{place} ({flexion}): must name joints of the finger: {', '.join(theirs)}")
        bends.append([m.joint(j).id for j in flexion] if flexion is not None else None)
    closes = [fixes.pick(f"fingers.{finger.name}.closes", None) for finger in fingers]
    motions, doubts = frame.motions(m, fingers, bends, closes)
    for x in motions:
        base = f"fingers.{x.finger.name}"
        pick(f"{base}.flexion", None)
        pick(f"{base}.closes", None)
        x.position = _vector(pick(f"{base}.tip.position", x.position), f"{base}.tip.position")
        x.normal = frame.unit(_vector(pick(f"{base}.tip.normal", x.normal), f"{base}.tip.normal"))
    return motions, doubts


def _vector(value: Any, place: str) -> np.ndarray:
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError):
        out = np.zeros(0)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise UserError(f"{place} ({value}): must be three numbers")
    return out


def _palm(guess: frame.Palm, pick: Callable[..., Any]) -> frame.Palm:
    position = _vector(pick("palm.position", guess.position), "palm.position")
    normal = frame.unit(_vector(pick("palm.normal", guess.normal), "palm.normal"))
    forward = _vector(pick("palm.forward", guess.forward), "palm.forward")
    forward = forward - normal * (normal @ forward)
    if np.linalg.norm(forward) < 1e-3:
        raise UserError(f"palm.forward ({forward}): must differ in direction from palm.normal")
    return frame.Palm(position, frame.unit(forward), normal)


def _search(
    own: build.Model, m: mujoco.MjModel, found: tree.Tree, motions: list[frame.Motion], thumbs: list[int],
    palm: frame.Palm, pulls: list[Pull], reach: dict[int, tuple[float, float, str]],
) -> poses.Search:  # fmt: skip
    """Return the search over the hand's own model, whose ids differ from the source's. reach: by id of a joint, where
    its followers let it go."""
    new = own.compile()
    for j, (low, high, _) in reach.items():
        new.jnt_range[new.joint(m.joint(j).name).id] = low, high
    moved = []
    for x in motions:
        finger = tree.Finger(x.finger.name, [new.joint(m.joint(j).name).id for j in x.finger.joints],
                             new.body(m.body(x.finger.tip).name).id)  # fmt: skip
        flexion = [new.joint(m.joint(j).name).id for j in x.flexion]
        moved.append(frame.Motion(finger, flexion, x.closes, x.position, x.normal, x.reach, x.straight))
    points = frame.palm_points(m, found.palm)
    ground = float(np.quantile((points - palm.position) @ palm.normal, 0.95)) if len(points) else 0.0
    drums = {new.joint(p.name).id: {new.joint(j).id: c for j, c in p.arms.items()} for p in pulls}
    passive = {m.joint(j).name for j in found.passive}
    return poses.Search(new, moved, thumbs, palm, 1, ground, passive, drums)


def _poses(
    s: poses.Search, order: list[str], fixes: Corrections, pick: Callable[..., Any], out: Path, where: str,
    tell: Callable[[str], None],
) -> tuple[dict[str, float], dict[str, float]]:  # fmt: skip
    """Return cupped and open pose by joint name."""
    ids = {j: s.m.joint(j).id for j in order}

    def said(pose: str) -> np.ndarray:
        out_ = np.full(s.m.nq, np.nan)
        for j, k in ids.items():
            if fixes.has(f"poses.{pose}.{j}"):
                value = fixes.pick(f"poses.{pose}.{j}", 0.0)
                low, high = s.m.jnt_range[k]
                if not isinstance(value, (int, float)) or not low - 1e-6 <= value <= high + 1e-6:
                    raise UserError(f"poses.{pose}.{j} ({value}): the joint's range is [{low:.4g}, {high:.4g}] rad")
                out_[k] = value
        return out_

    fixed = said("cupped")
    if np.isnan(fixed[list(ids.values())]).any():
        closed, miss = poses.cupped(s, keep=fixed)
        if miss > 1.0:
            tell(
                f"check:   no cupped pose with every fingertip around a ball was found (off by {miss:.1f}): see the"
                " picture"
            )
    else:
        closed = s.complete(np.nan_to_num(fixed))
    fixed = said("open")
    opened = poses.opened(s, closed)
    opened = s.complete(np.where(np.isnan(fixed), opened, fixed))
    for pose, q in (("open", opened), ("cupped", closed)):
        deep = [(a, b, d) for a, b, d in s.overlaps(q) if d > 2 * poses.TOUCH]
        if deep:
            a, b, d = max(deep, key=lambda x: x[2])
            raise UserError(
                f"{where}: self-collision at the {pose} pose: '{a}' and '{b}' overlap by {1e3 * d:.1f} mm; give another"
                f" with poses.{pose}.JOINT=ANGLE (rad; in the command, or in {out / folder.HAND} once it is there)"
            )
    result = []
    for pose, q in (("cupped", closed), ("open", opened)):
        if any(not fixes.has(f"poses.{pose}.{j}") for j in order):
            pick(f"poses.{pose}", None)
        result.append({j: round(float(q[k]), 4) for j, k in ids.items()})
    wide, gap = poses.gap(s, opened), poses.gap(s, closed)
    tell(f"poses    fingertips {1e3 * wide:.0f} mm apart open, {1e3 * gap:.0f} mm cupped; no link in another")
    return result[0], result[1]


def _pads(
    m: mujoco.MjModel, motions: list[frame.Motion], made: shapes.Shapes, settings: Settings, where: str,
    tell: Callable[[str], None],
) -> dict[str, taxels.Pad]:  # fmt: skip
    if settings.pads is None:
        return {}
    if isinstance(settings.pads, Path):
        pads = taxels.read(settings.pads)
        names = [x.finger.name for x in motions]
        for finger in pads:
            if finger not in names:
                raise UserError(f"taxels {settings.pads}: no finger '{finger}'; there are {', '.join(names)}")
        bare = [n for n in names if n not in pads]
        if bare:
            raise UserError(
                f"taxels {settings.pads}: none for finger {', '.join(bare)}; every finger has a pad, or none has"
            )
    else:
        pads = {}
        d = geometry.posed(m, frame.neutral(m))
        for x, skin in zip(motions, made.skins, strict=True):
            tip = surface.of_geoms(m, x.finger.geoms)
            if len(x.finger.geoms) > 1:
                tip = surface.hull(skin)
            anchor = d.xmat[x.finger.tip].reshape(3, 3).T @ (d.xanchor[x.finger.joints[-1]] - d.xpos[x.finger.tip])
            axis = d.xmat[x.finger.tip].reshape(3, 3).T @ d.xaxis[x.flexion[-1]]
            along = x.position - anchor
            along -= axis * (axis @ along)
            pads[x.finger.name] = taxels.paint(x.finger.name, tip, x.position, x.normal, along, settings.pads,
                                                  settings.holes)  # fmt: skip
    for (finger, pad), skin in zip(((x.finger.name, pads[x.finger.name]) for x in motions), made.skins, strict=True):
        taxels.check(finger, pad, skin, where)
        note = f"; {pad.note}" if pad.note else ""
        tell(f"pad      {finger:<9}{len(pad.point)} taxels on {1e4 * pad.area.sum():.2f} cm2{note}")
    return {x.finger.name: pads[x.finger.name] for x in motions}


def _hand(
    name: str, model: Path, m: mujoco.MjModel, found: tree.Tree, motions: list[frame.Motion], thumbs: list[int],
    palm: frame.Palm, known: figures.Figures, order: list[str], open_: dict[str, float], closed: dict[str, float],
    search: poses.Search, pads: dict[str, taxels.Pad], pulls: list[Pull], fixes: Corrections, pick: Callable[..., Any],
) -> dict[str, Any]:  # fmt: skip
    """Return content of hand.yaml."""

    def number(place: str, guess: float, missing: list[str], joint: str) -> float:
        return float(pick(place, float(f"{guess:.4g}"), sure=joint not in missing))

    joints = [
        {"name": j, "effort": number(f"joints.{j}.effort", known.effort[j], known.guessed_effort, j),
         "speed": number(f"joints.{j}.speed", known.speed[j], known.guessed_speed, j)}
        for j in order
    ]  # fmt: skip
    fingers = []
    for x in motions:
        n = x.finger.name
        own, flexion, closes = _of_drives(m, found, x, pulls)
        pulls = [p for p in pulls if p.name not in own]  # one that pulls several fingers is the first one's
        pad = None
        if n in pads:
            pad = {"taxels": f"taxels_{n}.csv", "kind": fixes.pick(f"fingers.{n}.pad.kind", "finger"),
                   "rows": pads[n].rows, "skin": f"skin_{n}.obj"}  # fmt: skip
        fingers.append({
            "name": n, "joints": own, "flexion": flexion, "closes": closes,
            "tip": {"body": m.body(x.finger.tip).name, "position": _list(x.position), "normal": _list(x.normal),
                    "geoms": [f"tip_{n}"]},
            "pad": pad,
        })  # fmt: skip
    ids = [search.m.joint(j).id for j in order]
    qo, qc = np.zeros(search.m.nq), np.zeros(search.m.nq)
    qo[ids], qc[ids] = [open_[j] for j in order], [closed[j] for j in order]
    qo, qc = search.complete(qo), search.complete(qc)
    return {
        "format": "dexsim-hand", "version": 1, "name": name,
        "handedness": pick("handedness", frame.handedness(m, found, motions, thumbs, palm)),
        "model": "model.xml", "servo": fixes.pick("servo", "servo.yaml"),
        "joints": joints,
        "palm": {"body": m.body(found.palm).name, "position": _list(palm.position), "forward": _list(palm.forward),
                 "normal": _list(palm.normal)},
        "fingers": fingers, "opposing": [found.fingers[k].name for k in thumbs],
        "poses": {"open": open_, "cupped": closed},
        "span": float(pick("span", round(poses.span(search, qo, qc), 4))),
        "force": fixes.pick("force", None),
    }  # fmt: skip


def _of_drives(
    m: mujoco.MjModel, found: tree.Tree, x: frame.Motion, pulls: list[Pull]
) -> tuple[list[str], list[str], list[int]]:
    """Return a finger's driven joints and the actuators that pull it; of these, those that bend it, and the sign that
    does."""
    inside = {m.joint(j).name for j in x.finger.joints}
    own = [m.joint(j).name for j in x.finger.joints if j not in found.passive]
    mine = [p for p in pulls if set(p.arms) & inside]
    bends = {m.joint(j).name: int(c) for j, c in zip(x.flexion, x.closes, strict=True)}
    flexion = {n: bends[n] for n in own if n in bends}
    for pull in mine:
        votes = [c * bends[j] for j, c in pull.arms.items() if j in bends]
        if votes:
            flexion[pull.name] = int(np.sign(sum(votes) or votes[0]))
    return own + [p.name for p in mine], list(flexion), list(flexion.values())


def _list(v: np.ndarray) -> list[float]:
    return [round(float(x), 6) + 0.0 for x in v]


def _servo(name: str, hand: dict[str, Any], robot: source.Source) -> str:
    """Return a servo table: what the file says of its drives, the rest from efforts and speeds."""
    m, said = robot.model, robot.drives
    friction = {m.joint(j).name: float(m.dof_frictionloss[m.jnt_dofadr[j]]) for j in range(m.njnt)}
    joints, guessed = {}, {"kp": 0, "kd": 0, "coulomb_friction": 0}
    for j in hand["joints"]:
        stiff = j["effort"] / (SWEEP * figures.radius(m, j["name"]))
        guess = {"kp": stiff, "kd": 0.025 * stiff, "coulomb_friction": 0.02 * j["effort"]}
        own = {"kp": said.kp.get(j["name"]), "kd": said.kd.get(j["name"]), "coulomb_friction": friction.get(j["name"])}
        if own["kp"] and not own["kd"]:
            guess["kd"] = 0.025 * own["kp"]
        for key in guess:
            guessed[key] += not own[key]
        value = {key: float(f"{own[key] or guess[key]:.3g}") for key in guess}
        joints[j["name"]] = {
            "kp": value["kp"], "kd": value["kd"], "torque_limit": j["effort"], "no_load_speed": j["speed"],
            "delay": said.delay.get(j["name"], 0.01), "coulomb_friction": value["coulomb_friction"],
        }  # fmt: skip
    rules = {
        "kp": f"full torque at {SWEEP:g} rad of error, a slide's force at {SWEEP / figures.TRAVEL:.0%} of its range",
        "kd": "a fortieth of kp",
        "coulomb_friction": "2 % of the torque",
    }  # fmt: skip
    text = "; ".join(f"{key} of {guessed[key]} joints ({rule})" for key, rule in rules.items() if guessed[key])
    head = (
        f"# The drives of {name}. Guesses, until a diagnosis of the real hand replaces them: delay of"
        f" {len(joints) - len(set(joints) & set(said.delay))} joints (100 Hz){'; ' + text if text else ''}.\n"
        "# All else is from the model's file and from hand.yaml.\n"
    )
    data = {
        "drive": "torque",
        "joints": joints,
        "current_per_torque": "unknown",
        "loop_encoder": "joint",
        "position_encoder": "joint",
    }
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200)


def _word(text: str) -> str:
    """Return a hand's name: letters, digits, _ and -."""
    out = "".join(c if c.isalnum() and c.isascii() or c in "_-" else "_" for c in str(text)).strip("_-")[:48]
    return out or "hand"


def _axis(v: np.ndarray) -> str:
    """Return a direction in words: +x, or its three numbers."""
    k = int(np.abs(v).argmax())
    return f"{'-' if v[k] < 0 else '+'}{'xyz'[k]}" if abs(v[k]) > 0.999 else f"({v[0]:.2f} {v[1]:.2f} {v[2]:.2f})"


def _rank(hand: dict[str, Any]) -> Callable[[str], int]:
    order = list(hand)
    return lambda place: order.index(place.split(".")[0]) if place.split(".")[0] in order else len(order)


def _loads(stage: Path) -> Hand:
    try:
        return load_hand(stage)
    except UserError as error:  # the name of the folder that is only being written helps nobody
        raise UserError(str(error).replace(str(stage / folder.HAND), folder.HAND).replace(str(stage), ".")) from None


def _drop_region(stage: Path, hand: dict[str, Any], drops: int, tell: Callable[[str], None]) -> None:
    """Search for where objects are let fall, and write it into the content of hand.yaml, as a guess."""
    from dexsim.import_hand import drop_region

    try:
        found = drop_region.search(stage, drops)
    except UserError as error:
        tell(f"check:   nothing could be let fall into it, to find where it is held: {error}")
        return
    if found.catch is None:
        tell(f"check:   {found.held} of {found.drops} objects let fall where the cupped pose tells were held, and no"
             " more elsewhere: see the picture")  # fmt: skip
        return
    hand["places"] = (hand.get("places") or {}) | {"catch": _list(np.round(found.catch, 4))}
    hand["guessed"] = sorted([*hand["guessed"], "places.catch"], key=_rank(hand))
    x, y = 1e3 * found.catch[:2]
    than = "the middle of the cupped pose"
    if found.middle is not None:
        than = f"{1e3 * found.moved:.0f} mm from {than}, where {found.middle} are"
    tell(f"drops    {found.held} of {found.drops} objects let fall within {1e3 * found.within:.0f} mm of ({x:.0f}"
         f" {y:.0f}) mm are held, {than}")  # fmt: skip


def _picture(hand: Hand, stage: Path, tell: Callable[[str], None]) -> None:
    from dexsim.import_hand import picture
    from dexsim.view.video import drawn

    drawn(lambda: picture.draw(hand, stage / "picture.png"), tell, "no picture: ")
