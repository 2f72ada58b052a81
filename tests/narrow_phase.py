"""Contacts of two bodies: how exact and how fast, of dexsim's own narrow phase and of MuJoCo-Warp's, in one run.

    python -m tests.narrow_phase [poses=100000] [device=cuda:0] [worlds=8192] [kinds=box-hull,...]
                                      [out=narrow_phase.json]

Random poses of every kind of pair that a hand and an object have; surfaces from 2 mm deep to 1.5 mm (the margin) apart.
A sphere, a capsule, a box, a fingertip or another hull against hulls of the object library and against fingertips, and
all but the sphere against cylinders, are dexsim's own kernels; spheres, capsules and boxes among each other and spheres
against cylinders are left to MuJoCo-Warp's closed forms, and are measured too (`THEIRS`). The reference is C MuJoCo's
`mj_geomDistance` in float64 with a tolerance of 1e-14 m, and where anybody disagrees with it, or it with itself, the
exact answer in float64: of overlapping bodies the nearest facet of the hull of all differences of corners (Qhull), of
others the nearest point of that hull (Lawson and Hanson's least distance programming), of cylinders the best of all
features (`cylinder_exact.py`). How often C MuJoCo was wrong is printed. Printed for each pair of types and both
settings: percentiles of the error of the distance, of the angle of the normal and of the contact's place, and
microseconds a pair of the narrow phase alone (of all worlds at once, cold: no pair has been there before).
 No pose is left out of the distances, and none out of the count of places that are off: each that is more than 1e-6 m
from C MuJoCo's is held to all exact nearest points in float64 (`places.py`), of dexsim's kernels where they serve;
each that is off is printed with its pose, which begins from nowhere: nothing was kept of a step before.
 Percentiles of normals and places are of poses where they are well-posed: not where overlapping bodies have two ways
out of equal length (to 1 um), nor at gaps below 10 um, where a normal is a quotient of two roundings; of places also
only where a corner of one body is nearest, since parallel edges and faces (`degenerate`, within 1e-3 rad or 10 um) have
no single nearest point. The number compared is printed, and the worst distance among the degenerate ones by itself.
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
from benchmarks.options import options
from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.sim.collision import NarrowPhase
from dexsim.sim.collision.shapes import hull_corners
from tests.places import exact, judge
from tools.assets import xhand

MARGIN = 0.0015
REFERENCE, MUJOCO_WARP = (1e-14, 200), (1e-6, 35)
"""Tolerance [m] and most iterations of convex collision, of C MuJoCo and (its defaults) of MuJoCo-Warp. With 1e-10 C
MuJoCo's normals of a cylinder are 1e-4 rad off."""
OURS = (
    *(f"{a}-hull" for a in ("sphere", "capsule", "box", "fingertip", "hull")),
    *(f"{a}-fingertip" for a in ("sphere", "capsule", "box", "fingertip")),
    *(f"{a}-cylinder" for a in ("capsule", "box", "fingertip", "hull")),
)
"""Pairs of types that dexsim's kernels serve, with a hull of an object, a fingertip or a cylinder."""
THEIRS = ("sphere-sphere", "sphere-capsule", "capsule-capsule", "sphere-box", "capsule-box",
          "sphere-cylinder")  # fmt: skip
"""Pairs that are MuJoCo-Warp's under both settings."""
KINDS = (*OURS, *THEIRS)
SETTINGS = ("hand", "mujoco")
GEOM = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
ROUND = tuple(int(GEOM[k]) for k in ("sphere", "capsule"))
"""Types whose surface lies a radius from their core."""


def scene(kind: str) -> tuple[mujoco.MjModel, list[int], list[int]]:
    """Return a model of two bodies with a geom each, of the types that `kind` names; meshes that A and B may be."""
    spec = mujoco.MjSpec()
    spec.option.ccd_tolerance, spec.option.ccd_iterations = REFERENCE
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    names: dict[str, list[str]] = {"fingertip": [], "hull": []}
    for name in ("tip_thumb", "tip_finger"):
        spec.add_mesh(name=name, uservert=tip_vertices(name).ravel())
        names["fingertip"].append(name)
    for shape in library().values():
        for k, vertices in enumerate(shape.hulls if shape.kind == "grid" else ()):
            name = f"{shape.name}_{k}"
            spec.add_mesh(name=name, uservert=(np.asarray(vertices) * 1.25).ravel())
            names["hull"].append(name)
    types = kind.split("-")
    for body, geom in zip(("a", "b"), types, strict=True):
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
    return model, ids.get(types[0], [-1]), ids.get(types[1], [-1])


def tip_vertices(name: str) -> np.ndarray:
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
    """Return the turned at random, moved along a random direction until the gap along it is -2 to 1.5 mm; a tenth with
    faces parallel."""
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
    for k, name in enumerate(kind.split("-")):
        size[:, k] = rng.uniform(0.006, 0.03, (n, 3)) if name in GEOM else 0.0
        if name in ("sphere", "capsule"):
            size[:, k, 0] = rng.uniform(0.006, 0.014, n)
    f = np.float32  # what both are given
    size = size.astype(f).astype(float)
    pos = rng.uniform(-0.05, 0.05, (n, 2, 3))
    reach = sum(_reach(model, k, mesh[:, k], size[:, k], rot[:, k], s * u) for k, s in ((0, 1.0), (1, -1.0)))
    pos[:, 1] = pos[:, 0] + u * (reach + rng.uniform(-0.002, MARGIN, n))[:, None]
    return Poses(pos.astype(f).astype(float), rot.astype(f).astype(float), mesh, size)


def _reach(
    model: mujoco.MjModel, k: int, mesh: np.ndarray, size: np.ndarray, rot: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Return how far geom k reaches along u from its place [n], in m."""
    d = np.einsum("nji,nj->ni", rot, u)
    kind = model.geom_type[k]
    if kind == GEOM["sphere"]:
        return size[:, 0]
    if kind == GEOM["capsule"]:
        return size[:, 0] + size[:, 1] * np.abs(d[:, 2])
    if kind == GEOM["cylinder"]:
        return size[:, 0] * np.hypot(d[:, 0], d[:, 1]) + size[:, 1] * np.abs(d[:, 2])
    if kind == GEOM["box"]:
        return (np.abs(d) * size).sum(1)
    first, count, corners = hull_corners(model)
    out = np.empty(len(mesh))
    for m in np.unique(mesh):
        own = mesh == m
        out[own] = (d[own] @ corners[first[m] :][: count[m]].T.astype(float)).max(1)
    return out


def reference(model: mujoco.MjModel, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (distance [n], normal from A to B [n, 3], point halfway [n, 3]) of C MuJoCo, in float64."""
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
        model.opt.ccd_tolerance, model.opt.ccd_iterations = MUJOCO_WARP
        with wp.ScopedDevice(device):
            self.m = mjw.put_model(model, batch_sizes={"geom_dataid": n, "geom_size": n})
            self.d = mjw.put_data(model, mujoco.MjData(model), nworld=n, nconmax=4, njmax=64)
            self.m.opt.warn_overflow = False
            self.m.opt.broadphase_filter = 0
            self.narrow = NarrowPhase(model, self.m, self.d) if setting == "hand" else None
        model.opt.ccd_tolerance, model.opt.ccd_iterations = REFERENCE

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
        """Return (distance [n], inf where there is no contact; normal from A to B [n, 3]; position [n, 3]) of each
        pair's
        deepest contact: MuJoCo-Warp's closed forms make two of some pairs."""
        c, number = self.d.contact, int(self.d.nacon.numpy()[0])
        found = c.dist.numpy()[:number]
        order = np.argsort(-found, kind="stable")  # the deepest is written last
        w = c.worldid.numpy()[:number][order]
        dist, normal, pos = np.full(self.n, np.inf), np.zeros((self.n, 3)), np.zeros((self.n, 3))
        turned = np.where(c.geom.numpy()[:number, :1] == 0, 1.0, -1.0)
        dist[w], pos[w] = found[order], c.pos.numpy()[:number][order]
        normal[w] = (c.frame.numpy()[:number, 0] * turned)[order]
        return dist, normal, pos


def compare(model: mujoco.MjModel, poses: Poses, want, got) -> dict[str, np.ndarray]:
    """Return the errors of all poses that either side calls a contact: m, rad, m; NaN where that is not well-posed."""
    dist, normal, pos = want
    near = dist < MARGIN - 1e-6
    missed = near & ~np.isfinite(got[0])
    extra = (dist > MARGIN + 1e-6) & np.isfinite(got[0])
    both = near & np.isfinite(got[0])
    error = np.where(both, got[0] - dist, np.nan)
    angle = np.arctan2(np.linalg.norm(np.cross(normal, got[1]), axis=1), (normal * got[1]).sum(1))
    sound, unique = well_posed(model, poses, want)
    # two ways out, equally long
    rival = (dist < 0) & (angle > 1e-3) & (np.abs(confirmed(model, poses, got[1]) + dist) < 1e-6)
    sound &= ~rival
    return {
        "missed": missed, "extra": extra, "dist": error, "degenerate": np.where(unique, np.nan, error),
        "angle": np.where(both & sound, angle, np.nan),
        "pos": np.where(both & sound & unique, np.linalg.norm(pos - got[2], axis=1), np.nan),
    }  # fmt: skip


def well_posed(model: mujoco.MjModel, poses: Poses, want) -> tuple[np.ndarray, np.ndarray]:
    """Return for each pose whether its normal and its nearest points are determined to the accuracy of float32."""
    dist, normal, _ = want
    rivals = np.ones(len(dist), int)
    for k, sign in ((0, 1.0), (1, -1.0)):
        rivals *= _rivals(model, k, poses, sign * normal)
    return np.abs(dist + _radius(model, poses)) > 1e-5, rivals <= 2  # a corner of one of them


def _radius(model: mujoco.MjModel, poses: Poses) -> np.ndarray:
    """Return what surfaces are nearer than cores [n], in m."""
    return (poses.size[:, :, 0] * np.isin(model.geom_type, ROUND)).sum(1)


def _rivals(model: mujoco.MjModel, k: int, poses: Poses, u: np.ndarray) -> np.ndarray:
    """Return 1 if the core's furthest feature along u is a point, 2 if it is an edge or face (within 1e-3 rad)."""
    d = np.einsum("nji,nj->ni", poses.rot[:, k], u)
    kind = model.geom_type[k]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.ones(len(d), int)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.where(np.abs(d[:, 2]) < 1e-3, 2, 1)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.where(np.abs(d).min(1) < 1e-3, 2, 1)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:  # its side, a cap
        return np.where(np.minimum(np.abs(d[:, 2]), np.hypot(d[:, 0], d[:, 1])) < 1e-3, 2, 1)
    first, count, corners = hull_corners(model)
    out = np.empty(len(d), int)
    for m in np.unique(poses.mesh[:, k]):
        own = poses.mesh[:, k] == m
        height = d[own] @ corners[first[m] :][: count[m]].T.astype(float)
        out[own] = np.where((height > height.max(1, keepdims=True) - 1e-5).sum(1) > 1, 2, 1)
    return out


def confirmed(model: mujoco.MjModel, poses: Poses, normal: np.ndarray) -> np.ndarray:
    """Return the depth [m] along a direction from A to B, in float64: how far A must move against it to be free of B.
    The true depth is the least over all directions, so that this never is too small; of bodies apart it is minus a
    gap that no other direction need have, so that their distance never is smaller."""
    reach = sum(
        _reach(model, k, poses.mesh[:, k], poses.size[:, k], poses.rot[:, k], s * normal)
        for k, s in ((0, 1.0), (1, -1.0))
    )
    return reach - ((poses.pos[:, 1] - poses.pos[:, 0]) * normal).sum(1)


def truth(model: mujoco.MjModel, poses: Poses, answers: list) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return (what is compared with, where C MuJoCo itself was wrong by more than 1e-7 m [n]). answers: its own first.

    Each answer of C MuJoCo is looked at by itself: along its normal the bodies must reach just as far as it says. Where
    that fails, or another answer differs by more than 1e-7 m (MuJoCo-Warp's own: 1e-6, its tolerance), the exact one
    counts.
    """
    dist, normal, pos = (x.copy() for x in answers[0])
    near = dist < MARGIN + 1e-4
    doubt = near & (np.abs(confirmed(model, poses, normal) + dist) > 1e-7)
    for (d, _, _), limit in zip(reversed(answers[1:]), (1e-6, 1e-7), strict=False):
        got = np.isfinite(d)
        doubt |= near & np.where(got, np.abs(np.where(got, d, 0.0) - dist) > limit, dist < MARGIN - 1e-6)
        doubt |= got & ~near
    wrong = np.zeros(len(dist), bool)
    # of two spheres or capsules the differences have no volume: closed forms
    solid = (int(mujoco.mjtGeom.mjGEOM_MESH), int(GEOM["box"]), int(GEOM["cylinder"]))
    if not np.isin(model.geom_type, solid).any():
        return (dist, normal, pos), wrong
    for i in np.flatnonzero(doubt):
        d, normal[i], pos[i] = exact(model, poses, i)
        wrong[i] = abs(d - dist[i]) > 1e-7
        dist[i] = d
    return (dist, normal, pos), wrong


def kind_of_pair(kind: str, n: int, device: str, worlds: int, seed: int = 1) -> dict:
    """Return the errors and times of one pair of types under both settings (under one where both are MuJoCo-Warp's),
    over n random poses, `worlds` at a time."""
    model, a, b = scene(kind)
    rng = np.random.default_rng(seed)
    both = {s: Worlds(model, worlds, device, s) for s in (SETTINGS if kind in OURS else SETTINGS[1:])}
    errors: dict[str, list] = {s: [] for s in both}
    times: dict[str, list[float]] = {s: [] for s in both}
    wrong, judged = 0, []
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
        judged.append(judge(model, poses, want, answers[1], confirmed(model, poses, answers[1][1])))
        for i, at in judged[-1]["exact"].items():
            want[2][i] = at
        for setting, got in zip(both, answers[1:], strict=True):
            errors[setting].append(compare(model, poses, want, got))
    out: dict = {"poses": worlds * len(errors["mujoco"]), "reference_wrong": wrong,
                 "whose": "dexsim's kernels" if kind in OURS else "MuJoCo-Warp's closed form or search"}  # fmt: skip
    count = {k: sum(j[k] for j in judged) for k in ("off", "ill", "equal", "reference_off")}
    out["places"] = count | {
        "worst_m": max(j["worst"] for j in judged),
        "poses_off": [pose for j in judged for pose in j["poses_off"]],
    }
    for setting, parts in errors.items():
        r = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
        out[setting] = {"contacts": int(np.isfinite(r["dist"]).sum()), "missed": int(r["missed"].sum()),
                        "extra": int(r["extra"].sum()),
                        "over_1e-6": int((np.abs(r["dist"]) > 1e-6).sum()),
                        "dist_m": spread(r["dist"]), "degenerate_m": spread(r["degenerate"]),
                        "normal_rad": spread(r["angle"]), "point_m": spread(r["pos"]),
                        "points_over_1e-6": int((r["pos"] > 1e-6).sum()),
                        "us_a_pair": round(float(np.median(times[setting])), 4)}  # fmt: skip
    return out


def spread(x: np.ndarray) -> dict[str, float]:
    """Return the median, 99th and 99.99th percentile, and worst, of the finite magnitudes; how many there are."""
    x = np.abs(x[np.isfinite(x)])
    if not len(x):
        return {"number": 0}
    return {"number": len(x)} | {
        k: float(f"{np.percentile(x, q):.3g}")
        for k, q in (("median", 50), ("p99", 99), ("p99_99", 99.99), ("worst", 100))
    }


def main(argv: list[str]) -> dict:
    rest: list[str] = []
    own = options(argv, {"poses": 100000, "out": "", "kinds": ",".join(KINDS)}, rest)
    cfg = tools.config(rest)
    n = own["poses"]
    kinds = own["kinds"].split(",")
    if set(kinds) - set(KINDS):
        raise UserError(f"kinds={own['kinds']}: must be of {', '.join(KINDS)}")
    out: dict = {"benchmark": "narrow_phase", **tools.about(cfg["device"])}
    for kind in kinds:
        r = out[kind] = kind_of_pair(kind, n, cfg["device"], min(n, cfg["worlds"]))
        print(
            f"{kind} ({r['whose']}): {r['poses']} poses, in {r['reference_wrong']} of them C MuJoCo is wrong by more"
            " than 1e-7 m"
        )
        held = r["places"]
        print(
            f"  places of all contacts, {SETTINGS[kind not in OURS]}: {held['off']} off by more than 1e-6 m,"
            f" {held['ill']} by less than the pose leaves open, at worst {held['worst_m']:.3g} m; {held['equal']} of"
            f" several nearest points another than C MuJoCo's; C MuJoCo's off: {held['reference_off']}"
        )
        for pose in held["poses_off"]:
            print(f"    off by {pose['off_m']:.3g} m: {json.dumps(pose)}")
        for setting in (s for s in SETTINGS if s in r):
            s = r[setting]
            print(
                f"  {setting:8s}{s['contacts']} contacts, {s['missed']} missed, {s['extra']} too many,"
                f" {s['over_1e-6']} wrong by more than 1e-6 m ({s['points_over_1e-6']} places),"
                f" {s['us_a_pair']:.3f} us a pair"
            )
            for name in ("dist_m", "degenerate_m", "normal_rad", "point_m"):
                print(f"    {name:13s}" + "  ".join(f"{k} {v:g}" for k, v in s[name].items()))
        sys.stdout.flush()
    if own["out"]:
        Path(own["out"]).write_text(json.dumps(out, indent=1) + "\n")
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
