"""Where taxels are: a layout is data, read from files; any count of pads, any count of taxels on each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexsim import files
from dexsim.errors import UserError
from dexsim.hand import Hand

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class TaxelLayout:
    """Taxels of F pads, padded to the largest pad's count T (padding has area 0).

    names: pad names [F]. bodies: names of the bodies that carry them [F]. kinds: pad type [F], the key of per-type
    constants such as the foundation stiffness. count: taxels of each pad [F].
    point [F, T, 3]: positions [m]; normal, tx, ty [F, T, 3]: unit directions (z, x and y of a taxel's frame; tx and ty
    lie in the tangent plane). Both in the frame of the carrying body.
    area [F, T]: area that a taxel stands for [m^2]. rows: of the lattice that each pad's taxels form, index k = column
    * rows + row; 0: none is known.
    """

    names: tuple[str, ...]
    bodies: tuple[str, ...]
    kinds: tuple[str, ...]
    count: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    tx: np.ndarray
    ty: np.ndarray
    area: np.ndarray
    rows: tuple[int, ...] = ()

    @property
    def pads(self) -> int:
        return len(self.names)

    @property
    def taxels(self) -> int:
        """Taxels of the largest pad, T."""
        return self.point.shape[1]

    def centre(self) -> np.ndarray:
        """Return area-weighted centre of each pad [F, 3] [m], body frame: the centre reported while the force is
        zero."""
        w = self.area / self.area.sum(1, keepdims=True)
        return np.einsum("ft,ftk->fk", w, self.point)

    def beside(self, pad: int) -> np.ndarray:
        """Return taxels beside each taxel of a pad in its lattice, [count, 4], -1 where there is none. UserError
        without a lattice."""
        n, rows = int(self.count[pad]), self.rows[pad]
        if not rows or n % rows:
            raise UserError(
                f"tactile.pads.{self.names[pad]}.crosstalk: which taxels lie beside one another is not known of this"
                " layout; use 0"
            )
        return lattice(n // rows, rows)

    def lifted(self, tips: Sequence[np.ndarray], limit: float = 1e-3) -> TaxelLayout:
        """Return the taxels moved along their normals onto the convex hulls of `tips` ([V, 3] m each, body frames), the
        surfaces that the physics presses, so that a taxel is in an object where that surface is. Fails if one would
        move farther than `limit` [m]: the tip then does not follow the pad. Pads beyond the tips stay."""
        point = self.point.copy()
        for f, tip in enumerate(tips):
            n = self.count[f]
            move = gap_to_hull(point[f, :n], self.normal[f, :n], tip)
            if not np.abs(move).max() <= limit:
                k = int(np.argmax(np.where(np.isfinite(move), np.abs(move), np.inf)))
                raise UserError(
                    f"pad '{self.names[f]}': taxel {k} lies {move[k] * 1e3:.2f} mm under the tip's surface, allowed"
                    f" {limit * 1e3:g}; mend the tip or set tactile.lift=false"
                )
            point[f, :n] += self.normal[f, :n] * move[:, None]
        return replace(self, point=point)

    @staticmethod
    def build(pads: Sequence[dict]) -> TaxelLayout:
        """Pads as dicts with name, body, kind (default: name), point, normal and optionally tx, ty (default:
        normal x tx), area (default 1 mm^2 each), rows (default 0); lists of any length. Fails with UserError on shapes
        that do not agree or vectors not of unit length.
        """
        if not pads:
            raise UserError("taxel layout: no pads given; at least one is needed")
        counts = np.array([len(p["point"]) for p in pads], dtype=np.int32)
        f, t = len(pads), int(counts.max()) if len(counts) else 0
        out = {k: np.zeros((f, t, 3)) for k in ("point", "normal", "tx", "ty")}
        out["normal"][..., 2], out["tx"][..., 0], out["ty"][..., 1] = 1.0, 1.0, 1.0
        area = np.zeros((f, t))
        for i, pad in enumerate(pads):
            n = counts[i]
            where = f"taxel pad '{pad['name']}'"
            if n == 0:
                raise UserError(f"{where}: has no taxels; give at least one or leave the pad out")
            point, normal = _vectors(pad["point"], n, f"{where}: point"), _vectors(pad["normal"], n, f"{where}: normal")
            _check_unit(normal, f"{where}: normal")
            tx, ty = tangents(normal) if pad.get("tx") is None else (pad["tx"], pad.get("ty"))
            tx = _vectors(tx, n, f"{where}: tx")
            ty = np.cross(normal, tx) if ty is None else ty
            tx, ty = _vectors(tx, n, f"{where}: tx"), _vectors(ty, n, f"{where}: ty")
            for name, v in (("tx", tx), ("ty", ty)):
                _check_unit(v, f"{where}: {name}")
                off = np.abs((v * normal).sum(1)).max()
                if off > 1e-2:
                    raise UserError(
                        f"{where}: {name} must lie in the tangent plane; its largest component along the normal is"
                        f" {off:.3g}, allowed 0.01"
                    )
            a = np.full(n, 1e-6) if pad.get("area") is None else np.asarray(pad["area"], dtype=float)
            if a.shape != (n,) or not np.all(np.isfinite(a)) or a.min() <= 0.0:
                raise UserError(f"{where}: area must be {n} positive numbers [m^2]")
            for k, v in (("point", point), ("normal", normal), ("tx", tx), ("ty", ty)):
                out[k][i, :n] = v
            area[i, :n] = a
        return TaxelLayout(
            names=tuple(p["name"] for p in pads),
            bodies=tuple(p["body"] for p in pads),
            kinds=tuple(p.get("kind", p["name"]) for p in pads),
            count=counts,
            area=area,
            point=out["point"],
            normal=out["normal"],
            tx=out["tx"],
            ty=out["ty"],
            rows=tuple(p.get("rows", 0) for p in pads),
        )


def gap_to_hull(point: np.ndarray, normal: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return distance [n] along each normal from points [n, 3] to the convex hull of corners [V, 3]: negative from
    outside."""
    return _gap(*(np.ascontiguousarray(x, dtype=float).tobytes() for x in (point, normal, corners))).copy()


@lru_cache(maxsize=32)  # asked for by every environment of a process, of the same hand's tips
def _gap(point: bytes, normal: bytes, corners: bytes) -> np.ndarray:
    from scipy.spatial import ConvexHull

    p, n, c = (np.frombuffer(x).reshape(-1, 3) for x in (point, normal, corners))
    planes = ConvexHull(c).equations
    along = n @ planes[:, :3].T
    gap = -(p @ planes[:, :3].T + planes[:, 3])
    return np.where(along > 0.05, gap / np.where(along > 0.05, along, 1.0), np.inf).min(1)


def lattice(columns: int, rows: int) -> np.ndarray:
    """Return the taxels [n, 4] beside each taxel of a lattice, k = column * rows + row, -1 where there is none."""
    at = np.pad(np.arange(columns * rows).reshape(columns, rows), 1, constant_values=-1)
    return np.stack([at[:-2, 1:-1], at[2:, 1:-1], at[1:-1, :-2], at[1:-1, 2:]], -1).reshape(-1, 4)


def neighbours(columns: int, rows: int) -> list[list[int]]:
    """Return the taxels beside each taxel of a `lattice`."""
    return [[int(k) for k in beside if k >= 0] for beside in lattice(columns, rows)]


def tangents(
    normal: np.ndarray, x: Sequence[float] = (1.0, 0.0, 0.0), y: Sequence[float] = (0.0, 1.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sensor's x and y directions projected on each taxel's tangent plane, unit length, [n, 3] each.

    Where a direction (nearly) is the normal, its projection is replaced by the one that is at right angles to the
    other's.
    """
    normal = np.asarray(normal, dtype=float)

    def project(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p = v - (normal @ v)[:, None] * normal
        size = np.linalg.norm(p, axis=1, keepdims=True)
        return p / np.maximum(size, 1e-12), size[:, 0]

    tx, sx = project(np.asarray(x, dtype=float))
    ty, sy = project(np.asarray(y, dtype=float))
    tx = np.where((sx < 1e-2)[:, None], np.cross(ty, normal), tx)
    ty = np.where((sy < 1e-2)[:, None], np.cross(normal, tx), ty)
    return tx, ty


def load_layout(path: str | Path, body: str, name: str | None = None, kind: str | None = None) -> dict:
    """Return one pad from a CSV file: a header naming the columns, one taxel a row in index order.

    Columns: x, y, z [m]; nx, ny, nz; optional tx, ty, tz (the direction `TaxelLayout.tx`) and area [m^2]; others are
    ignored. Lines that begin with # are comments. Returns a dict for `TaxelLayout.build`.
    """
    path = Path(path)
    files.check(path, "taxel file")
    point, normal, tx, area = (None if x is None else x.copy() for x in _columns(path, path.stat().st_mtime_ns))
    return {
        "name": name or path.stem,
        "body": body,
        "kind": kind or name or path.stem,
        "point": point,
        "normal": normal,
        "tx": tx,
        "area": area,
    }


@lru_cache(maxsize=32)  # fingers share a file, and environments of a process a hand
def _columns(path: Path, stamp: int) -> list[np.ndarray | None]:
    """Return points, normals and directions [n, 3] and areas [n] of a taxel file; None where it has none. Raises
    UserError."""
    needs, also = ("x", "y", "z", "nx", "ny", "nz"), ("tx", "ty", "tz", "area")
    found = files.table(path, "taxel file", needs, also)
    if not len(found["x"]):
        raise UserError(f"taxel file {path}: no taxels in it; expected a header line and one line a taxel")
    parts = needs[:3], needs[3:], also[:3]
    out = [np.stack([found[n] for n in names], 1) if set(names) <= found.keys() else None for names in parts]
    return [*out, found.get("area")]


def hand_layout(hand: Hand) -> TaxelLayout | None:
    """Return the taxels of a hand's pads, pad f on finger f, then its skin's; None where it has none. Mirrored and
    scaled as the hand is: a mirrored pad keeps its y axis, its x axis turns round, so that taxel frames stay
    right-handed. Raises UserError."""
    if not hand.touches:
        return None
    pads = []
    for own in hand.pads:
        pad = load_layout(hand.folder / own.taxels, own.body, own.name, own.kind)
        if own.rows and len(pad["point"]) % own.rows:
            raise UserError(
                f"hand {hand.folder}: fingers.{own.name}.pad.rows={own.rows}: its {len(pad['point'])} taxels are no"
                " multiple of it; 0 where they form no lattice"
            )
        pad["rows"] = own.rows
        if hand.mirror:
            flip = np.array([1.0, -1.0, 1.0])
            pad["point"], pad["normal"] = pad["point"] * flip, pad["normal"] * flip
            pad["tx"] = None if pad["tx"] is None else -pad["tx"] * flip
        if hand.scale != 1.0:
            pad["point"] = pad["point"] * hand.scale
            pad["area"] = None if pad["area"] is None else pad["area"] * hand.scale**2
        pads.append(pad)
    return TaxelLayout.build(pads)


def touch_shape(hand: Hand) -> tuple[int, int]:
    """Pads, and taxels of the largest: (0, 0) for a hand without touch."""
    layout = hand_layout(hand)
    return (0, 0) if layout is None else (layout.pads, layout.taxels)


def tip_layout(hand: Hand) -> TaxelLayout:
    """Return one point a fingertip, its end, as if it were a pad: for what a reward must know of a hand without
    touch."""
    return TaxelLayout.build([
        {"name": f.name, "body": f.body, "kind": "finger", "point": [f.position], "normal": [f.normal]}
        for f in hand.fingers
    ])  # fmt: skip


def tip_points(model: mujoco.MjModel, geoms: Sequence[str]) -> list[np.ndarray]:
    """Return corners [V, 3] (m, body frame) of the tips' collision meshes in a `mujoco.MjModel`: what other pads can
    feel."""
    import mujoco

    from dexsim.surface import geom_surface

    out = []
    for name in geoms:
        g = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        if g < 0 or model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH:
            why = "not in the model" if g < 0 else "not a mesh"
            raise UserError(f"tip geom '{name}': {why}; touch between fingers needs a convex mesh")
        out.append(geom_surface(model, g)[0])
    return out


def _vectors(v: object, n: int, what: str) -> np.ndarray:
    v = np.asarray(v, dtype=float)
    if v.shape != (n, 3) or not np.all(np.isfinite(v)):
        raise UserError(f"{what}: must be {n} finite vectors of 3 numbers; got shape {v.shape}")
    return v


def _check_unit(v: np.ndarray, what: str) -> None:
    worst = np.abs(np.linalg.norm(v, axis=1) - 1.0).max()
    if worst > 1e-3:
        raise UserError(f"{what}: vectors must have length 1; one is off by {worst:.3g} (allowed 0.001)")
