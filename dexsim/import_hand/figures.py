"""Masses, inertias, limits, efforts: what is missing or absurd, one clear line each."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.import_hand import geometry, inertias
from dexsim.import_hand.frame import Motion
from dexsim.import_hand.source import Source
from dexsim.import_hand.tree import Tree
from dexsim.surface import geom_surface

PRESS = 5.0  # N, what a fingertip is taken to press with where no file says the motor's torque
HOLD = 2.0  # times the weight of what it moves, in its worst pose: such a motor has at least that
SPEED = 6.0  # rad/s, of a small geared motor, where no file says it
MESH = 12.0  # times the size of the hand, or a twelve-hundredth of it: no mesh of a hand is so large, or so small
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}  # m
ANY_MESH = (3e-4, 1.0)  # m, of any hand
BODY = 3.0  # m within which a hand's joints lie
REACH = (0.015, 0.6)  # m from a finger's root to its tip
LINK_MASS = (1e-4, 3.0)  # kg
TORQUE = (0.005, 50.0)  # N m
FORCE, MOVE_SPEED = (0.1, 500.0), (0.002, 2.0)  # N, m/s, of a slide
TURN_SPEED = (0.05, 100.0)  # rad/s
# Order of magnitude of a small motor's rotor seen at the joint (g cm2 times a gear ratio of 100 to 200 squared), per
# N m of its largest torque; without one, the light links of a hand are stiffer than a physics step can follow.
ROTOR = 4.5e-4  # kg m2 per N m
DAMPING = 0.01  # N m s/rad per N m
TRAVEL = 0.5 * np.pi  # rad for which the range of a slide stands where what moves it is guessed as if it turned


@dataclass
class Figures:
    """By joint name: effort [N m], speed [rad/s], armature [kg m2], damping [N m s/rad]; guessed: joints whose
    effort or speed no file says; massless: links that are taken without a mass, and why; warnings: one line each."""

    effort: dict[str, float]
    speed: dict[str, float]
    armature: dict[str, float]
    damping: dict[str, float]
    guessed_effort: list[str] = field(default_factory=list)
    guessed_speed: list[str] = field(default_factory=list)
    guessed_armature: list[str] = field(default_factory=list)
    guessed_damping: list[str] = field(default_factory=list)
    massless: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check(
    source: Source, tree: Tree, motions: list[Motion], effort: float | None = None, speed: float | None = None
) -> Figures:
    """Return the hand's figures. effort, speed: for every joint whose file says none.

    Raises UserError for what no hand has: a size that is not in metres, joints without limits, angles in degrees.
    """
    m, where = source.model, f"model {source.path}"
    _size(motions, where)
    for j in tree.every:
        _limits(m, j, where, source.limits.get(m.joint(j).name))
    _degrees(m, tree, where)
    out = Figures({}, {}, {}, {})
    for x in motions:
        for j in x.finger.joints:
            name = m.joint(j).name
            if name in out.armature:
                continue
            dof = int(m.jnt_dofadr[j])
            out.armature[name], out.damping[name] = float(m.dof_armature[dof]), float(m.dof_damping[dof])
            if j in tree.passive:
                continue
            slides = m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
            press, fast = (PRESS, SPEED * x.reach) if slides else (PRESS * x.reach, SPEED)
            guess = max(press, HOLD * _weight(m, j)), fast
            out.effort[name] = _stated(source.drives.effort, name, effort, out.guessed_effort, guess[0])
            out.speed[name] = _stated(source.speeds, name, speed, out.guessed_speed, guess[1])
            for what, value, (low, high), unit in (
                ("effort", out.effort[name], FORCE if slides else TORQUE, "N" if slides else "N m"),
                ("speed", out.speed[name], MOVE_SPEED if slides else TURN_SPEED, "m/s" if slides else "rad/s"),
            ):  # fmt: skip
                if not low <= value <= high:
                    out.warnings.append(
                        f"joint '{name}': {what} {value:g} {unit} is unusual for a hand ({low:g} to {high:g}): check it"
                    )
            if out.armature[name] <= 0:
                out.armature[name] = ROTOR * out.effort[name] / radius(m, name)
                out.guessed_armature.append(name)
            if out.damping[name] <= 0:
                out.damping[name] = DAMPING * out.effort[name] / radius(m, name)
                out.guessed_damping.append(name)
    for pull in source.drives.pulls:
        reach = max(
            (x.reach for x in motions if {m.joint(j).name for j in x.finger.joints} & set(pull.arms)), default=0
        )
        out.effort[pull.name] = _stated(source.drives.effort, pull.name, effort, out.guessed_effort, PRESS * reach)
        out.speed[pull.name] = _stated(source.speeds, pull.name, speed, out.guessed_speed, SPEED)
        out.armature[pull.name] = ROTOR * out.effort[pull.name]
        out.damping[pull.name] = DAMPING * out.effort[pull.name]
        out.guessed_armature.append(pull.name)
    out.warnings += _inertias(m, tree)
    out.massless = _massless(m, tree)
    return out


def radius(m: mujoco.MjModel, name: str) -> float:
    """Return the metres that a slide moves for a radian of what is guessed to drive it; 1 for all that turns."""
    j = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, name)
    slides = j >= 0 and m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
    return float(np.ptp(m.jnt_range[j])) / TRAVEL if slides else 1.0


def _weight(m: mujoco.MjModel, j: int) -> float:
    """Return the torque [N m] (a slide's force, N) of the weight of all that a joint moves, at the worst attitude of
    the hand, drawn as the file has it."""
    d = geometry.posed(m)
    moved = [b for b in range(m.nbody) if m.jnt_bodyid[j] in geometry.path(m, b)]
    arms = np.linalg.norm(np.cross(d.xaxis[j], d.xipos[moved] - d.xanchor[j]), axis=1)
    if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
        arms = np.ones(len(moved))
    return float(9.81 * arms @ m.body_mass[moved])


def mended(source: Source, tree: Tree, inertia: str | None) -> list[str]:
    """Return a line for each inertia that is none and was mended; inertia: "shapes", "balance", or None: not asked for.

    Raises UserError, which lists them, for links that move, where nobody asked. What is held has an inertia that never
    counts.
    """
    m = source.model
    moved = {name: moments for name, moments in source.mended.items() if _moves(m, m.body(name).id, tree.palm)}
    if moved and inertia is None:
        raise inertias.refused(moved, source.path)
    out = []
    for name, moments in source.mended.items():
        how = "of its shapes taken" if inertia == "shapes" else "the mean of the three taken"
        if name not in moved:
            how = "it is held fast, its inertia never counts"
        out.append(f"inertia of '{name}' ({' '.join(f'{x:.3g}' for x in moments)} kg m2) is no body's: {how}")
    return out


def _moves(m: mujoco.MjModel, body: int, palm: int) -> bool:
    """Return whether a joint lies between the palm and a body."""
    way = geometry.path(m, body)
    return palm in way and any(m.body_jntnum[b] for b in way[way.index(palm) + 1 :])


def _stated(stated: dict[str, float], name: str, given: float | None, guessed: list[str], guess: float) -> float:
    value = stated.get(name) or given
    if not value:
        guessed.append(name)
        return float(f"{guess:.2g}")
    return float(value)


def _size(motions: list[Motion], where: str) -> None:
    reach = max(x.reach for x in motions)
    if REACH[0] <= reach <= REACH[1]:
        return
    fix = "state lengths in metres"
    for unit, factor in UNITS.items():
        if REACH[0] <= reach * factor <= REACH[1]:
            fix = f'the file is probably in {unit}: a mesh has scale="0.001 0.001 0.001" and every origin is in metres'
            break
    raise UserError(f"{where}: its longest finger is {reach:.3g} m, allowed {REACH[0]:g} to {REACH[1]:g} m; {fix}")


def mesh_sizes(source: Source, tree: Tree) -> None:
    """Raise UserError, naming them, for meshes whose size is out of all proportion to the distances between the
    hand's joints: those in another unit than the rest."""
    m = source.model
    d = geometry.posed(m)
    bodies = [b for b in range(1, m.nbody) if tree.palm in geometry.path(m, b)]
    hand = max(float(np.linalg.norm(np.ptp(d.xpos[bodies], axis=0))), 0.01)
    if hand > BODY:  # all of it is in another unit
        return
    said: dict[str, str] = {}
    for g in range(m.ngeom):
        if m.geom_bodyid[g] not in bodies or m.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH:
            continue
        size = float(np.ptp(geom_surface(m, g)[0], axis=0).max())
        if max(hand / (100 * MESH), ANY_MESH[0]) < size < min(hand * MESH, ANY_MESH[1]):
            continue
        units = {u: f for u, f in UNITS.items() if 0.1 * hand < size * f < 1.2 * hand} or UNITS
        why = f"in {' or '.join(units)}? scale=" + " or ".join(f'"{f:g} {f:g} {f:g}"' for f in units.values())
        if size < hand:
            why = "scaled twice? leave scale= out"
        name = m.mesh(m.geom_dataid[g]).name
        said.setdefault(name, f"'{name}' of '{m.body(m.geom_bodyid[g]).name}' is {size:.3g} m across ({why})")
    if said:
        raise UserError(
            f"model {source.path}: mesh {'; '.join(said.values())}: the hand's joints lie within {hand:.2g} m"
        )


def _limits(m: mujoco.MjModel, j: int, where: str, stated: tuple[float, float] | None) -> None:
    name, (low, high) = m.joint(j).name, m.jnt_range[j]
    if not m.jnt_limited[j] or not low < high:
        unit = "rad" if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE else "m"
        low, high = stated or (low, high)
        state = f"limits {low:g} to {high:g} {unit}" if stated or m.jnt_limited[j] else "no limits"
        raise UserError(
            f"{where}: joint '{name}' has {state}; give it two, low < high"
            ' (URDF: type="revolute" with <limit lower= upper=>, MJCF: range=), or make it fixed'
        )
    if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and max(abs(low), abs(high)) > 2 * np.pi + 0.01:
        raise UserError(
            f"{where}: joint '{name}' has limits {low:g} to {high:g} rad, more than a turn: in degrees?"
            ' (MJCF: <compiler angle="degree">; URDF: radians)'
        )


def _degrees(m: mujoco.MjModel, tree: Tree, where: str) -> None:
    """Raise UserError where no hinge turns farther than a turn in radians would be in degrees."""
    hinges = [j for j in tree.every if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    most = np.abs(m.jnt_range[hinges]).max(initial=0.0)
    if hinges and most < np.deg2rad(2 * np.pi):
        raise UserError(
            f"{where}: no joint turns farther than {most:.2g} rad: limits in radians, read as degrees? (MJCF, which"
            ' reads degrees by default, also in a file that others include: <compiler angle="radian">)'
        )


def _inertias(m: mujoco.MjModel, tree: Tree) -> list[str]:
    """Return masses and inertias against the shapes that carry them."""
    out = []
    bodies = {b for f in tree.fingers for j in f.joints for b in [int(m.jnt_bodyid[j])]}
    for b in sorted(bodies):
        name, mass, inertia = m.body(b).name, m.body_mass[b], m.body_inertia[b]
        below = sum(m.body_mass[c] for c in range(b, m.nbody) if b in geometry.path(m, c))
        if below < LINK_MASS[0]:
            out.append(f"link '{name}': mass {mass:g} kg: nothing that moves is so light; in tonnes or grams?")
        elif mass > LINK_MASS[1]:
            out.append(f"link '{name}': mass {mass:g} kg: heavy for a finger; in grams?")
        points = geometry.surface(m, b)[0]
        if mass <= 0 or len(points) < 4:
            continue
        size = np.linalg.norm(np.ptp(points, axis=0))
        gyration = np.sqrt(inertia.max() / mass)
        if gyration > size:
            out.append(
                f"link '{name}': inertia {inertia.max():.2g} kg m2 is that of a thing {3500 * gyration:.0f} mm long;"
                f" its shape is {1e3 * size:.0f} mm: check the units"
            )
        elif gyration < 0.02 * size:
            out.append(
                f"link '{name}': inertia {inertia.max():.2g} kg m2 is too small for its {1e3 * size:.0f} mm and"
                f" {1e3 * mass:.0f} g (about {mass * size**2 / 20:.1g}): check the units"
            )
        if np.linalg.norm(m.body_ipos[b] - points.mean(0)) > 1.5 * size:
            out.append(
                f"link '{name}': its centre of mass lies {1e3 * np.linalg.norm(m.body_ipos[b]):.0f} mm off its shape"
            )
    return out


def _massless(m: mujoco.MjModel, tree: Tree) -> list[str]:
    """Links with a shape and no mass that simulation takes as they are: the palm, which never moves (its base path is
    gravity's), and what is fixed to a moving link, which carries it."""
    out = []
    for b in range(1, m.nbody):
        if m.body_mass[b] > 0 or m.body_jntnum[b] or tree.palm not in geometry.path(m, b) or not geometry.solid(m, b):
            continue
        on = b
        while on != tree.palm and not m.body_jntnum[on]:
            on = int(m.body_parentid[on])
        why = f"fixed to '{m.body(on).name}', whose mass counts"
        if on == tree.palm:
            why = "the base is held fast, its mass never counts"
        out.append(f"'{m.body(b).name}' ({why})")
    return out
