"""What a recording says of touch: each pad's readings beside the distances of its taxels to what it presses.

Where pads are is in the model: bodies named as the hand names them (`dexsim.tactile.sensors`). What is pressed
is either led along `/object_pose` (shape from the recording's attached config) or a body of the model with a primitive
geom.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from dexsim import yaml_text
from dexsim.assets.objects.shape import Grid
from dexsim.errors import UserError
from dexsim.gap.plant.mechanics import chain
from dexsim.gap.read import spans
from dexsim.gap.read.noise import noise
from dexsim.gap.rules import TOUCH
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording
from dexsim.recording.smooth import local_polynomial
from dexsim.tactile import reference as ref
from dexsim.tactile.sensors import Sensors

STIFFNESS, FRICTION = (
    7000.0,
    0.8,
)  # N/m and 1: what is believed of a fingertip's contact where the recording states nothing
ASSUMED_LSB = 0.1  # N a count where nothing is stated; the common scale is then fitted freely
SHIFT = 3e-4  # m by which the object is moved to learn how distances change
RATE = 100.0  # Hz of the grid on which touch is simulated
LONGEST = 60.0  # s of one recording that are simulated: the stretch with the most touch
GRIP = 6.0  # counts of normal force from which a taxel's shear is summed
NEAR = 4e-3  # m: what comes nearer than this to a pad may press it
KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
}


@dataclass
class PadRun:
    """One pad in one recording, K taxels, on a regular grid of G times and at the S readings.

    pad, name: its number and name; beside [K], mixing [K, K]: as `Sensors` has them;
    grid [G] s; dist [G, K] m signed distance of each taxel to the object (NaN where nothing is known of it); along,
    across [G, K]: the same with the object moved by SHIFT along the pad's two directions; depth [G] m of the skin's
    deepest point; slide [G, 2] m: the object's path over the pad, in its tangent plane; t [S] s; z [S, K] N normal
    readings; shear [S, 2] N their tangential sum in the same plane, or None; load [G] N of a load cell, or None; full
    [S, K]: readings at the largest count; warm [G] degC above the coldest, or s since the first recording's start where
    no temperature was logged.
    """

    recording: str
    pad: int
    name: str
    beside: list[list[int]]
    mixing: np.ndarray
    grid: np.ndarray
    dist: np.ndarray
    along: np.ndarray
    across: np.ndarray
    depth: np.ndarray
    slide: np.ndarray
    area: np.ndarray
    t: np.ndarray
    z: np.ndarray
    shear: np.ndarray | None
    load: np.ndarray | None
    full: np.ndarray
    warm: np.ndarray
    lsb: float
    stiffness: float = STIFFNESS
    friction: float = FRICTION
    doubt: float = 1.5e-4  # m by which the object may be elsewhere over the pad than the joints say
    pressed: np.ndarray = None  # type: ignore[assignment]  # [S, K] taxels that `shear` sums; `_pad_run` says them
    memory: dict = field(default_factory=dict)  # contacts that were computed

    @property
    def grip(self) -> np.ndarray:
        """[S] N, normal force of the taxels that `shear` sums."""
        return np.where(self.pressed, self.z, 0.0).sum(1)

    @cached_property
    def near(self) -> np.ndarray:
        """[n] grid points at which the object may touch."""
        close = self.dist.min(1) < 2e-3 + 2 * self.doubt
        return np.flatnonzero(close if self.load is None else close | (self.load > 0.02 * self.load.max()))


@dataclass
class TouchData:
    """Pads with what is known of them. scale_known: whether counts have newtons. blind: pads that felt something
    although the object's pose is not known, by recording. thermometer: whether `warm` is in degC."""

    runs: list[PadRun] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    scale_known: bool = True
    blind: list[tuple[str, int]] = field(default_factory=list)
    thermometer: bool = False

    def pads(self) -> list[int]:
        return sorted({r.pad for r in self.runs})


@dataclass
class _Thing:
    """What presses: a shape led along poses, or a geom of the model; its contact [N/m, 1] as it is believed."""

    kind: str
    size: np.ndarray
    grid: Grid | None
    body: str | None  # None: led along /object_pose
    geom: int = -1
    stiffness: float = STIFFNESS
    friction: float = FRICTION


def newtons(r: Recording) -> tuple[np.ndarray, bool]:
    """Return readings [S, F, K, 3] in N and our axes, and whether the scale was stated."""
    lsb = r.tactile_lsb
    assert r.tactile is not None  # asked for where touch was recorded
    return r.tactile.value * ((ASSUMED_LSB if lsb is None else lsb) * r.tactile_axis_sign), lsb is not None


def collect(recordings: list[Recording], m: Mechanism, sensors: Sensors) -> TouchData:
    """Return every pad that is pressed in the recordings, with the geometry of its contact where it is known."""
    out = TouchData()
    model = m.spec.compile()
    layout = sensors.layout
    if layout is None:
        if any(r.tactile is not None for r in recordings):
            out.notes.append(f"/tactile is recorded, but {sensors.hand.robot} has no touch pads: touch is not judged")
        return out
    origin = min((r.start_ns for r in recordings), default=0)
    temps = [r.temperature for r in recordings if r.tactile is not None]
    warm = [x for x in temps if x is not None and np.isfinite(x.value).any()]
    out.thermometer = bool(temps) and len(warm) == len(temps)
    coldest = min((float(np.nanmin(x.value)) for x in warm), default=0.0) if out.thermometer else 0.0
    for r in recordings:
        if r.tactile is None or r.tactile.value.ndim != 4 or len(r.tactile) < 20:
            continue
        if r.tactile.value.shape[1:3] != (layout.pads, layout.taxels):
            out.notes.append(
                f"{r.path.name}: /tactile has {r.tactile.value.shape[1]} x {r.tactile.value.shape[2]} taxels, the "
                "layout "
                f"{sensors.hand.robot} has {layout.pads} x {layout.taxels}: touch is not judged"
            )
            continue
        force, known = newtons(r)
        out.scale_known &= known
        finite = np.isfinite(force)
        if not finite.all():
            out.notes.append(
                f"{r.path.name}: {int((~finite).any((1, 2, 3)).sum())} touch samples are not finite and count as 0"
            )
            force = np.where(finite, force, 0.0)
        lsb = 0.0 if r.meta["tactile_unit"] != "count" else r.tactile_lsb if r.tactile_lsb is not None else ASSUMED_LSB
        pressed = [f for f in range(layout.pads) if (force[:, f, :, 2].max(1) > max(2 * lsb, 0.05)).mean() > 0.01]
        things = _things(r, model, sensors)
        on = [f for f in pressed if layout.bodies[f] in [model.body(i).name for i in range(model.nbody)]]
        for f in set(pressed) - set(on):
            out.notes.append(
                f"{r.path.name}: pad {layout.names[f]} is pressed, but the model has no body '{layout.bodies[f]}' to "
                "carry it"
            )
        if not things:
            out.blind += [(r.path.name, f) for f in pressed]
            continue
        for f in on:
            run = _pad_run(r, m, model, sensors, f, force, lsb, things, origin, coldest if out.thermometer else None)
            if run is None:
                out.blind.append((r.path.name, f))
            else:
                out.runs.append(run)
    if out.blind and not out.runs:
        out.notes.append(
            "touch is recorded, but not what was touched (no /object_pose with a shape, no such body in the model): "
            "dead, stuck and "
            "swapped taxels can still be told, forces cannot be predicted"
        )
    if out.runs and not out.scale_known:
        out.notes.append(
            "tactile_lsb is unknown: the common scale of the taxels is fitted, so a gain common to all cannot be told"
        )
    return out


def _things(r: Recording, model: mujoco.MjModel, sensors: Sensors) -> list[_Thing]:
    """Return what may press a pad, in this recording."""
    if r.object_pose is not None and len(r.object_pose) > 5 and r.config:
        try:
            o = yaml_text.parse(r.config, f"{r.path.name}: attached config")["recorded_world"]["object"]
        except (UserError, KeyError, TypeError):
            o = None
        if o:
            grid = None
            if o["kind"] == "grid":
                from dexsim.assets.objects import library

                shape = library().get(o["shape"])
                grid = None if shape is None else shape.grid
            if o["kind"] != "grid" or grid is not None:
                contact = float(o.get("stiffness", STIFFNESS)), float(o.get("friction", FRICTION))
                return [_Thing(o["kind"], np.asarray(o["size"], float), grid, None, -1, *contact)]
    out = []
    for g in range(model.ngeom):
        name = model.body(int(model.geom_bodyid[g])).name
        if name and name not in sensors.bodies and int(model.geom_type[g]) in KINDS:
            out.append(_Thing(KINDS[mujoco.mjtGeom(int(model.geom_type[g]))], model.geom_size[g].copy(), None, name, g))
    return out


def _pad_run(
    r: Recording,
    m: Mechanism,
    model: mujoco.MjModel,
    sensors: Sensors,
    f: int,
    force: np.ndarray,
    lsb: float,
    things: list[_Thing],
    origin: int,
    coldest: float | None,
) -> PadRun | None:
    layout = sensors.layout
    assert layout is not None and r.tactile is not None  # as `collect` has looked
    K = int(layout.count[f])
    t = r.tactile.t
    z = force[:, f, :K, 2]
    start, stop = _stretch(t, z.sum(1))
    keep = (t >= start) & (t <= stop)
    t, z = t[keep], z[keep]
    grid = np.arange(start, stop + 0.5 / RATE, 1 / RATE)
    rot, pos = _poses(r, m, model, grid, things, layout.bodies[f])
    if rot is None or pos is None:
        return None
    point, normal = sensors.lifted.point[f, :K], layout.normal[f, :K]
    skin = sensors.skin(f, fine=4)
    nearest = _nearest(things, rot, pos, point)
    if nearest is None:
        return None
    thing, R, p = nearest
    dist = _distance(thing, point, R, p)
    e1, e2 = _tangents(normal[int(np.argmax(z.sum(0)))])
    # moving the object by +e in the pad's frame moves the pad's points by -e in the object's
    along, across = (_distance(thing, point - SHIFT * e, R, p) for e in (e1, e2))
    hull = None if thing.geom < 0 else _hull_depth(r, m, model, grid, thing, layout.bodies[f])
    near = skin.points[np.linalg.norm(skin.points - point[int(np.argmin(dist.min(0)))], axis=1) < 0.02]
    depth = -_distance(thing, near, R, p).min(1) if hull is None else hull
    slide = _path(R, p, point[int(np.argmax(z.sum(0)))], e1, e2)
    shear, counted = None, z > 0
    if np.abs(force[..., :2]).max() > 0:
        # whole counts swallow the shear of taxels that hardly press
        counted = z >= GRIP * lsb
        sheared = np.einsum(
            "ski,kij->sj",
            force[keep][:, f, :K, :2] * counted[..., None],
            np.stack([layout.tx[f, :K], layout.ty[f, :K]], 1),
        )
        # the taxel shows what the finger exerts on the object, against the object's path
        shear = -sheared @ np.stack([e1, e2], 1)
    load = None
    if r.external_force is not None and len(r.external_force) > 5:
        load = np.interp(grid, r.external_force.t, np.linalg.norm(r.external_force.value[:, :3], axis=1))
    full = (
        np.abs(r.tactile.value[keep][:, f, :K, 2]) >= 255
        if r.meta["tactile_unit"] == "count"
        else np.zeros(z.shape, bool)
    )
    if coldest is not None and r.temperature is not None:
        warm = np.interp(grid, r.temperature.t, np.nanmean(r.temperature.value, 1)) - coldest
    else:
        warm = grid + (r.start_ns - origin) * 1e-9
    return PadRun(
        r.path.name,
        f,
        sensors.names[f],
        sensors.beside(f),
        sensors.mixing(f),
        grid,
        dist,
        along,
        across,
        depth,
        slide,
        layout.area[f, :K],
        t,
        z,
        shear,
        load,
        full,
        warm,
        lsb,
        thing.stiffness,
        thing.friction,
        _doubt(model, layout.bodies[f]),
        counted,
    )


def _tangents(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions along a surface, across each other; axis [3]: its normal."""
    e1 = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(axis, e1)


def _path(R: np.ndarray, p: np.ndarray, middle: np.ndarray, e1: np.ndarray, e2: np.ndarray) -> np.ndarray:
    """Return [G, 2] m along e1 and e2: the path of the object over the pad, by where the pad's pressed point lies in
    the object's frame, seen from the pad. R [G, 3, 3], p [G, 3]: from the pad's frame to the object's; middle [3]."""
    q = np.einsum("gij,j->gi", R, middle) + p
    step = np.einsum("gji,gj->gi", R[:-1], np.diff(q, axis=0))  # pad over object, in the pad's axes
    return -np.concatenate([np.zeros((1, 2)), np.cumsum(step @ np.stack([e1, e2], 1), 0)])


def _doubt(model: mujoco.MjModel, pad: str) -> float:
    """Return m: a tenth of a millimetre and a half, and for every hinge that carries the pad an encoder zero off by 5
    mrad times its arm."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body, out = model.body(pad).id, 1.5e-4
    for b in chain(model, body):
        for i in range(int(model.body_jntadr[b]), int(model.body_jntadr[b]) + int(model.body_jntnum[b])):
            if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE:
                out += 5e-3 * float(np.linalg.norm(data.xpos[body] - data.xanchor[i]) + 0.02)
    return out


def _stretch(t: np.ndarray, total: np.ndarray) -> tuple[float, float]:
    """Start and end [s] of the LONGEST stretch with the most touch."""
    if t[-1] - t[0] <= LONGEST:
        return float(t[0]), float(t[-1])
    sums = np.concatenate([[0.0], np.cumsum(total)])
    last = np.searchsorted(t, t + LONGEST)
    first = int(np.argmax(sums[last] - sums[:-1]))
    return float(t[first]), float(min(t[first] + LONGEST, t[-1]))


def _poses(
    r: Recording, m: Mechanism, model: mujoco.MjModel, grid: np.ndarray, things: list[_Thing], pad: str
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """For every thing: rotation [G, 3, 3] and position [G, 3] that take a point of the pad's body frame to the
    thing's."""
    data = mujoco.MjData(model)
    address, values = _posture(r, m, model, grid)
    led, o = any(x.body is None for x in things), r.object_pose
    path, turns = np.zeros((0, 3)), np.zeros((0, 4))
    if led:
        assert o is not None  # what is led has a path
        raw = np.stack([np.interp(grid, o.t, v) for v in o.value.T], 1)
        path, turns = raw[:, :3], raw[:, 3:] / np.linalg.norm(raw[:, 3:], axis=1, keepdims=True)
    elif not address:
        return None, None
    body = model.body(pad).id
    rot, pos = np.zeros((len(things), len(grid), 3, 3)), np.zeros((len(things), len(grid), 3))
    quat = np.zeros(9)
    for i in range(len(grid)):
        data.qpos[address] = values[i]
        mujoco.mj_kinematics(model, data)
        A, a = data.xmat[body].reshape(3, 3), data.xpos[body]
        for k, thing in enumerate(things):
            if thing.body is None:
                mujoco.mju_quat2Mat(quat, turns[i])
                B, b = quat.reshape(3, 3), path[i]
            else:
                B, b = data.geom_xmat[thing.geom].reshape(3, 3), data.geom_xpos[thing.geom]
            rot[k, i], pos[k, i] = B.T @ A, B.T @ (a - b)
    return rot, pos


def _posture(r: Recording, m: Mechanism, model: mujoco.MjModel, grid: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Return (addresses in qpos, values [G, n]) of the joints that were read."""
    p = r.states.position
    address, values = [], []
    for joint in (j for j in m.joints if j in r.joints):
        x = p.value[:, r.joints.index(joint)] if len(p) else np.zeros(0)
        ok = np.isfinite(x)
        if ok.sum() < 5:
            continue
        # a press is over in tens of milliseconds: smooth no more than the encoder's noise asks for
        rough, _ = noise(p.t[ok], x[ok])
        smooth = local_polynomial(p.t[ok], x[ok][:, None], width=0.015)[0][:, 0] if rough > 1e-5 else x[ok]
        address.append(int(model.joint(joint).qposadr[0]))
        values.append(np.interp(grid, p.t[ok], smooth))
    return address, np.array(values).T if values else np.zeros((len(grid), 0))


def _hull_depth(
    r: Recording, m: Mechanism, model: mujoco.MjModel, grid: np.ndarray, thing: _Thing, pad: str
) -> np.ndarray | None:
    """Return [G] m: depth of the thing's geom in the pad's own collision geoms, which is what the physics presses
    (their margin rounds them); None where the pad has none that are convex."""
    body = model.body(pad).id
    tips = [
        g
        for g in range(model.ngeom)
        if int(model.geom_bodyid[g]) == body
        and model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE
        and (model.geom_margin[g] > 0 or model.geom_contype[g] or model.geom_conaffinity[g])
    ]
    if not tips:
        return None
    data, where = mujoco.MjData(model), np.zeros(6)
    address, values = _posture(r, m, model, grid)
    out = np.empty(len(grid))
    for i in range(len(grid)):
        data.qpos[address] = values[i]
        mujoco.mj_kinematics(model, data)
        out[i] = max(
            model.geom_margin[g]
            + model.geom_margin[thing.geom]
            - mujoco.mj_geomDistance(model, data, g, thing.geom, 0.02, where)
            for g in tips
        )
    return out


def _nearest(
    things: list[_Thing], rot: np.ndarray, pos: np.ndarray, point: np.ndarray
) -> tuple[_Thing, np.ndarray, np.ndarray] | None:
    """Return the thing that comes nearest to the pad, and its poses; None where none comes near."""
    least, nearest = NEAR, -1
    for k, thing in enumerate(things):
        gap = float(_distance(thing, point[::7], rot[k][::5], pos[k][::5]).min())
        if gap < least:
            least, nearest = gap, k
    if nearest < 0:
        return None
    return things[nearest], rot[nearest], pos[nearest]


def _distance(thing: _Thing, point: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return signed distances [G, n] of points [n, 3] (pad's frame), a few thousand samples at a time."""
    out = np.empty((len(R), len(point)))
    chunk = max(1, int(4e5 // max(len(point), 1)))
    for a in range(0, len(R), chunk):
        q = np.einsum("gij,nj->gni", R[a : a + chunk], point) + p[a : a + chunk, None]
        out[a : a + chunk] = ref.distance(thing.kind, thing.size, q, thing.grid)
    return out


def stretches(r: Recording) -> list[tuple[float, float]]:
    """Times (start, end) [s] in which something is touched: taxels, or a load cell where there are none."""
    if r.tactile is not None and r.tactile.value.ndim == 4 and len(r.tactile) > 5:
        z = np.nan_to_num(newtons(r)[0][..., 2])
        still = np.ptp(z, axis=0) == 0  # a stuck taxel is no touch
        t, on = r.tactile.t, np.where(still, 0.0, z).max((1, 2)) > TOUCH.touched
    elif r.external_force is not None and len(r.external_force) > 5:
        size = np.linalg.norm(np.nan_to_num(r.external_force.value[:, :3]), axis=1)
        size = size - np.percentile(size, 5)
        t, on = r.external_force.t, size > max(TOUCH.loaded, 0.05 * float(size.max()))
    else:
        return []
    return [(a, b) for a, b in spans(t, on, 0.3) if b - a > 0.03]
