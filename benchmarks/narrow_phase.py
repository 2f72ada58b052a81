"""Contacts of convex hulls: how exact and how fast, of dexsim's own narrow phase and of MuJoCo-Warp's, in one run.

    python -m benchmarks.narrow_phase [poses=100000] [device=cuda:0] [worlds=8192] [out=narrow_phase.json]

Random poses of every pair of types that a hand has with a hull: a sphere, a capsule, a box, a fingertip, and another
hull, against hulls of the object library; surfaces from 2 mm deep to 1.5 mm (the margin) apart. The reference is C
MuJoCo's `mj_geomDistance` in float64 with a tolerance of 1e-10 m. Printed for each pair of types and both settings:
percentiles of the error of the distance, of the angle of the normal and of the contact's place, and microseconds a pair
of the narrow phase alone (of all worlds at once, cold: no pair has been there before).
 Normals and places are compared where the reference is well-posed: not where overlapping bodies have two ways out of
equal length (to 1 um), nor at gaps below 10 um, where a normal is a quotient of two roundings; places also only where a
corner of one body is nearest, since parallel edges and faces have no single nearest point. The number compared is
printed.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from benchmarks import tools
from dexsim.assets import xhand
from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.sim.collision import NarrowPhase
from dexsim.sim.collision.shapes import hull_corners

MARGIN = 0.0015
KINDS = ("sphere", "capsule", "box", "fingertip", "hull")
SETTINGS = ("hand", "mujoco")
GEOM = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}


def scene(kind: str) -> tuple[mujoco.MjModel, list[int], list[int]]:
    """A model of two bodies with a geom each, A of `kind` and B a hull; meshes that A and B may be."""
    spec = mujoco.MjSpec()
    spec.option.ccd_tolerance = 1e-10
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    hand = xhand.hand_spec()
    names: dict[str, list[str]] = {"fingertip": [], "hull": []}
    tips = {m.name: m for m in hand.meshes if m.name in ("tip_thumb", "tip_finger")}
    for name in tips:
        model = _tip_vertices(name)
        spec.add_mesh(name=name, uservert=model.ravel())
        names["fingertip"].append(name)
    for shape in library().values():
        for k, vertices in enumerate(shape.hulls if shape.kind == "grid" else ()):
            name = f"{shape.name}_{k}"
            spec.add_mesh(name=name, uservert=(np.asarray(vertices) * 1.25).ravel())
            names["hull"].append(name)
    for body, geom in (("a", kind), ("b", "hull")):
        b = spec.worldbody.add_body(name=body)
        b.add_freejoint()
        b.mass, b.inertia, b.explicitinertial = 0.1, [1e-4] * 3, True
        common = dict(name=body, margin=MARGIN / 2, condim=4)
        if geom in GEOM:
            b.add_geom(type=GEOM[geom], size=[0.01, 0.02, 0.03], **common)
        else:
            b.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=names[geom][0], **common)
    model = spec.compile()
    ids = {key: [model.mesh(n).id for n in found] for key, found in names.items()}
    return model, ids.get(kind, [-1]), ids["hull"]


def _tip_vertices(name: str) -> np.ndarray:
    model = xhand.hand_spec().compile()
    mesh = model.mesh(name)
    adr, number = int(mesh.vertadr[0]), int(mesh.vertnum[0])
    return np.asarray(model.mesh_vert[adr : adr + number], float)


@dataclass
class Poses:
    """n placements: position [n, 2, 3], rotation [n, 2, 3, 3], mesh [n, 2], size [n, 2, 3] of A and B."""

    pos: np.ndarray
    rot: np.ndarray
    mesh: np.ndarray
    size: np.ndarray

    def __getitem__(self, i) -> Poses:
        return Poses(self.pos[i], self.rot[i], self.mesh[i], self.size[i])


def draw(model: mujoco.MjModel, kind: str, a: list[int], b: list[int], n: int, rng: np.random.Generator) -> Poses:
    """Turned at random, moved along a random direction until the gap along it is -2 to 1.5 mm; a tenth with faces
    parallel."""
    q = rng.normal(size=(n, 2, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    rot = np.empty((n, 2, 9))
    for i in range(n):
        for k in range(2):
            mujoco.mju_quat2Mat(rot[i, k], q[i, k])
    rot = rot.reshape(n, 2, 3, 3)
    parallel = rng.random(n) < 0.1
    rot[parallel] = np.eye(3)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u[parallel] = np.eye(3)[rng.integers(0, 3, int(parallel.sum()))]
    mesh = np.stack([rng.choice(a, n), rng.choice(b, n)], 1)
    size = np.zeros((n, 2, 3))
    size[:, 0] = rng.uniform(0.006, 0.03, (n, 3)) if kind in GEOM else 0.0
    if kind in ("sphere", "capsule"):
        size[:, 0, 0] = rng.uniform(0.006, 0.014, n)
    pos = rng.uniform(-0.05, 0.05, (n, 2, 3))
    reach = _reach(model, kind, mesh[:, 0], size[:, 0], rot[:, 0], u) + _reach(
        model, "hull", mesh[:, 1], size[:, 1], rot[:, 1], -u
    )
    pos[:, 1] = pos[:, 0] + u * (reach + rng.uniform(-0.002, MARGIN, n))[:, None]
    f = np.float32  # what both are given
    return Poses(pos.astype(f).astype(float), rot.astype(f).astype(float), mesh, size.astype(f).astype(float))


def _reach(
    model: mujoco.MjModel, kind: str, mesh: np.ndarray, size: np.ndarray, rot: np.ndarray, u: np.ndarray
) -> np.ndarray:
    d = np.einsum("nji,nj->ni", rot, u)
    if kind == "sphere":
        return size[:, 0]
    if kind == "capsule":
        return size[:, 0] + size[:, 1] * np.abs(d[:, 2])
    if kind == "box":
        return (np.abs(d) * size).sum(1)
    first, count, corners = hull_corners(model)
    out = np.empty(len(mesh))
    for m in np.unique(mesh):
        own = mesh == m
        out[own] = (d[own] @ corners[first[m] :][: count[m]].T.astype(float)).max(1)
    return out


def reference(model: mujoco.MjModel, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(distance [n], normal from A to B [n, 3], point halfway [n, 3]) of C MuJoCo, in float64."""
    data = mujoco.MjData(model)
    n = len(poses.pos)
    dist, ends = np.empty(n), np.empty((n, 6))
    for i in range(n):
        data.geom_xpos[:] = poses.pos[i]
        data.geom_xmat[:] = poses.rot[i].reshape(2, 9)
        model.geom_dataid[:] = poses.mesh[i]
        model.geom_size[:] = poses.size[i]
        dist[i] = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, ends[i])
    along = (ends[:, 3:] - ends[:, :3]) * np.sign(dist)[:, None]
    return (
        dist,
        along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300),
        0.5 * (ends[:, :3] + ends[:, 3:]),
    )


class Worlds:
    """One pose a world, on MuJoCo-Warp; `setting` as sim.collision."""

    def __init__(self, model: mujoco.MjModel, n: int, device: str, setting: str):
        self.n, self.device, self.setting = n, device, setting
        model.opt.ccd_tolerance = 1e-6
        with wp.ScopedDevice(device):
            self.m = mjw.put_model(model, batch_sizes={"geom_dataid": n, "geom_size": n})
            self.d = mjw.put_data(model, mujoco.MjData(model), nworld=n, nconmax=1, njmax=16)
            self.m.opt.warn_overflow = False
            self.m.opt.broadphase_filter = 0
            self.narrow = NarrowPhase(model, self.m, self.d) if setting == "hand" else None
        model.opt.ccd_tolerance = 1e-10

    def put(self, poses: Poses) -> None:
        d, m = self.d, self.m
        d.geom_xpos.assign(poses.pos.astype(np.float32))
        d.geom_xmat.assign(poses.rot.astype(np.float32))
        m.geom_dataid.assign(poses.mesh.astype(np.int32))
        m.geom_size.assign(poses.size.astype(np.float32))
        self.forget()

    def forget(self) -> None:
        if self.narrow is not None:
            self.narrow.simplex.fill_(wp.vec3i(-1, -1, -1))

    def collide(self) -> None:
        with wp.ScopedDevice(self.device):
            if self.narrow is None:
                mjw.collision(self.m, self.d)
            else:
                with self.narrow.in_place():
                    mjw.collision(self.m, self.d)

    def found(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(distance [n], inf where there is no contact; normal from A to B [n, 3]; position [n, 3])."""
        c, number = self.d.contact, int(self.d.nacon.numpy()[0])
        w = c.worldid.numpy()[:number]
        if len(np.unique(w)) != number:
            raise AssertionError("more than one contact a pair")
        dist, normal, pos = np.full(self.n, np.inf), np.zeros((self.n, 3)), np.zeros((self.n, 3))
        turned = np.where(c.geom.numpy()[:number, :1] == 0, 1.0, -1.0)
        dist[w], pos[w] = c.dist.numpy()[:number], c.pos.numpy()[:number]
        normal[w] = c.frame.numpy()[:number, 0] * turned
        return dist, normal, pos


def compare(model: mujoco.MjModel, poses: Poses, want, got) -> dict[str, np.ndarray]:
    """Errors of all poses that either side calls a contact: m, rad, m; NaN where that is not well-posed."""
    dist, normal, pos = want
    near = dist < MARGIN - 1e-6
    missed = near & ~np.isfinite(got[0])
    extra = (dist > MARGIN + 1e-6) & np.isfinite(got[0])
    both = near & np.isfinite(got[0])
    error = np.where(both, got[0] - dist, np.nan)
    angle = np.arctan2(np.linalg.norm(np.cross(normal, got[1]), axis=1), (normal * got[1]).sum(1))
    sound, unique = well_posed(model, poses, want)
    rival = (dist < 0) & (angle > 1e-3) & (np.abs(confirmed(model, poses, got[1]) - confirmed(model, poses,
                                                                                              normal)) < 1e-6)
    sound &= ~rival  # two ways out, equally long
    return {
        "missed": missed, "extra": extra, "dist": error, "angle": np.where(both & sound, angle, np.nan),
        "pos": np.where(both & sound & unique, np.linalg.norm(pos - got[2], axis=1), np.nan),
    }  # fmt: skip


def well_posed(model: mujoco.MjModel, poses: Poses, want) -> tuple[np.ndarray, np.ndarray]:
    """Of each pose: whether its normal, and whether its nearest points are determined to the accuracy of float32."""
    dist, normal, _ = want
    core = dist + poses.size[:, 0, 0] * np.isin(
        model.geom_type[0], (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
    )
    sound = np.abs(core) > 1e-5
    rivals = np.ones(len(dist), int)
    for k, sign in ((0, 1.0), (1, -1.0)):
        rivals *= _rivals(model, k, poses, sign * normal)
    return sound, rivals <= 2  # a corner of one of them


def _rivals(model: mujoco.MjModel, k: int, poses: Poses, u: np.ndarray) -> np.ndarray:
    """1 if the core's furthest feature along u is a point, 2 if it is an edge or face (within 1e-3 rad)."""
    d = np.einsum("nji,nj->ni", poses.rot[:, k], u)
    kind = model.geom_type[k]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.ones(len(d), int)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.where(np.abs(d[:, 2]) < 1e-3, 2, 1)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.where(np.abs(d).min(1) < 1e-3, 2, 1)
    first, count, corners = hull_corners(model)
    out = np.empty(len(d), int)
    for m in np.unique(poses.mesh[:, k]):
        own = poses.mesh[:, k] == m
        height = d[own] @ corners[first[m] :][: count[m]].T.astype(float)
        out[own] = np.where((height > height.max(1, keepdims=True) - 1e-5).sum(1) > 1, 2, 1)
    return out


def confirmed(model: mujoco.MjModel, poses: Poses, normal: np.ndarray) -> np.ndarray:
    """Depth [m] along a direction from A to B, in float64: how far A must move against it to be free of B. The true
    depth is the least over all directions, so that this never is too small."""
    kinds = [
        "hull" if t == mujoco.mjtGeom.mjGEOM_MESH else next(k for k, g in GEOM.items() if int(g) == t)
        for t in model.geom_type
    ]
    reach = sum(
        _reach(model, kinds[k], poses.mesh[:, k], poses.size[:, k], poses.rot[:, k], s * normal)
        for k, s in ((0, 1.0), (1, -1.0))
    )
    return reach - ((poses.pos[:, 1] - poses.pos[:, 0]) * normal).sum(1)


def truth(model: mujoco.MjModel, poses: Poses, answers: list) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """(what is compared with, where C MuJoCo itself was wrong [n]).

    EPA of C MuJoCo ends at a facet that is not the nearest in one of some thousand overlapping poses. Any direction's
    depth can be confirmed in float64, so there the least of all the answers' confirmed depths counts.
    """
    dist, normal, pos = (x.copy() for x in answers[0])
    least = -dist
    for _, n, _ in answers[1:]:
        depth = np.where(np.linalg.norm(n, axis=1) > 0.5, confirmed(model, poses, n), np.inf)
        least = np.minimum(least, np.where(dist < 0, depth, np.inf))
    wrong = (dist < 0) & (-dist - least > 1e-7)
    dist[wrong] = -least[wrong]
    return (dist, normal, pos), wrong


def kind_of_pair(kind: str, n: int, device: str, worlds: int, seed: int = 1) -> dict:
    """Errors and times of one pair of types under both settings, over n random poses, `worlds` at a time."""
    model, a, b = scene(kind)
    rng = np.random.default_rng(seed)
    both = {s: Worlds(model, worlds, device, s) for s in SETTINGS}
    errors: dict[str, list] = {s: [] for s in SETTINGS}
    times: dict[str, list[float]] = {s: [] for s in SETTINGS}
    wrong = 0
    for _ in range(-(-n // worlds)):
        poses = draw(model, kind, a, b, worlds, rng)
        answers = [reference(model, poses)]
        for setting, w in both.items():
            w.put(poses)
            w.collide()  # compiled
            w.forget()
            tools.wait(device)
            begin = time.perf_counter()
            w.collide()
            tools.wait(device)
            times[setting].append(1e6 * (time.perf_counter() - begin) / worlds)
            answers.append(w.found())
        want, mistaken = truth(model, poses, answers)
        wrong += int(mistaken.sum())
        for setting, got in zip(SETTINGS, answers[1:], strict=True):
            r = compare(model, poses, want, got)
            r["angle"][mistaken] = r["pos"][mistaken] = np.nan
            errors[setting].append(r)
    out: dict = {"poses": worlds * len(errors["hand"]), "reference_wrong": wrong}
    for setting, parts in errors.items():
        r = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
        out[setting] = {"contacts": int(np.isfinite(r["dist"]).sum()), "missed": int(r["missed"].sum()),
                        "extra": int(r["extra"].sum()),
                        "dist_m": spread(r["dist"]), "normal_rad": spread(r["angle"]), "point_m": spread(r["pos"]),
                        "us_a_pair": round(float(np.median(times[setting])), 4)}  # fmt: skip
    return out


def spread(x: np.ndarray) -> dict[str, float]:
    """Median, 99th and 99.99th percentile, and worst, of the finite magnitudes; how many there are."""
    x = np.abs(x[np.isfinite(x)])
    if not len(x):
        return {"number": 0}
    return {"number": len(x)} | {
        k: float(f"{np.percentile(x, q):.3g}")
        for k, q in (("median", 50), ("p99", 99), ("p99_99", 99.99), ("worst", 100))
    }


def main(argv: list[str]) -> dict:
    own, rest = tools.split(argv, {"poses": "100000", "out": "", "kinds": ",".join(KINDS)})
    cfg = tools.config(rest)
    n = tools.numbers(own["poses"], "poses")[0]
    kinds = own["kinds"].split(",")
    if set(kinds) - set(KINDS):
        raise UserError(f"kinds={own['kinds']}: must be of {', '.join(KINDS)}")
    out: dict = {"benchmark": "narrow_phase", **tools.about(cfg["device"])}
    for kind in kinds:
        r = out[kind] = kind_of_pair(kind, n, cfg["device"], min(n, cfg["worlds"]))
        print(
            f"{kind} against hull: {r['poses']} poses, in {r['reference_wrong']} of them C MuJoCo's depth is not the"
            " least"
        )
        for setting in SETTINGS:
            s = r[setting]
            print(
                f"  {setting:8s}{s['contacts']} contacts, {s['missed']} missed, {s['extra']} too many,"
                f" {s['us_a_pair']:.3f} us a pair"
            )
            for name in ("dist_m", "normal_rad", "point_m"):
                print(f"    {name:12s}" + "  ".join(f"{k} {v:g}" for k, v in s[name].items()))
        sys.stdout.flush()
    if own["out"]:
        Path(own["out"]).write_text(json.dumps(out, indent=1) + "\n")
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
