"""Touch of N worlds: what pads feel of the object and of each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import torch
import warp as wp

from dexsim.assets.objects.shape import Grid
from dexsim.errors import UserError
from dexsim.tactile.by_pad import OF_WORLD, ByPad
from dexsim.tactile.config import COLUMNS, TactileConfig, stiffness_of, tactile_config
from dexsim.tactile.kernel import (
    CHUNK,
    WIDTH,
    Felt,
    FlatFelt,
    Groups,
    Law,
    Pads,
    Surroundings,
    Unit,
    spans,
    touch_kernel,
)
from dexsim.tactile.lanes import LANES
from dexsim.tactile.layout import TaxelLayout
from dexsim.tactile.measure import Effects, Measured, clock, draw_gains, forget, report_kernel, stamp, taxel_kernel
from dexsim.tactile.shapes import ShapeSet, TouchShape, bake_convex

BLOCK_DIM = 128
"""Threads a block of the touch kernels on CUDA: 4 warps."""


class Posed(Protocol):
    """What touch asks of an engine (`dexsim.sim.engine.Engine`): worlds, device, poses and contact forces."""

    n: int
    device: str
    wp: SimpleNamespace

    def body(self, name: str) -> int: ...

    def pair(self, name: str) -> int: ...


class Tactile:
    """Forces of all taxels, reduced to a force and a centre per pad.

    engine: N worlds; `engine.wp.xpos`, `xmat` are read, and `pair_normal` for sum=solver; `launch` runs in `after` of
    `engine.step`. layout: F pads of up to T taxels. shapes: what objects can be. object_body: name of the object's body
    (its frame is the shape's frame), or several names. cfg: see dexsim/configs/tactile/default.yaml.
    pairs: for sum=solver, name of the engine's contact pair (pad, object) of each pad, [F] (or [F][O] for O objects).
    tips: points [V, 3] (body frame) of each pad's tip, whose convex hull carries the taxels (lift=true) and is what
    other pads feel (others=true); pads beyond them lie where they are.
    Pads of one body whose pairs have one name share its force, whole.
    links: in place of the tips, (body, points [V, 3] m of its surface) of all that pads may feel of the hand itself;
    selves: with sum=solver, name of the contact pair of each pad's body and the rest of the hand [F]: what pads on one
    body feel of the hand is then this force, spread by the distance to the nearest link.
    lanes: a warp for each pad, or pads that share a force (default: on CUDA), else a thread.

    Set per world: shape_id [N] int32 (-1: no object), shape_size [N, 3] (`dexsim.tactile.sdf`: half sizes; uniform
    scale first for grids); with O objects [N, O], [N, O, 3].
    Out: force [N, F] (N) and centre [N, F, 3] (m, world frame; the pad's centre where the force is 0) as the sensor
    reports them; force_clean and centre_clean of the object alone without imperfections; force_other [N, F] of other
    fingers; raw [N, F, T] and raw_clean if raw=true; raw3 [N, F, T, 3] with shear=true. The tensors never move.
    """

    def __init__(
        self, engine: Posed, layout: TaxelLayout, shapes: ShapeSet, object_body: str | Sequence[str],
        cfg: Mapping | TactileConfig | None = None, *, pairs: Sequence | None = None,
        tips: Sequence[np.ndarray] | None = None, links: Sequence[tuple[str, np.ndarray]] | None = None,
        selves: Sequence[str] | None = None, seed: int = 0, lanes: bool | None = None,
    ):  # fmt: skip
        self.cfg = cfg = tactile_config(cfg)
        self.engine, self.layout, self.shapes = engine, layout, shapes
        self.device, n, f, t = engine.device, engine.n, layout.pads, layout.taxels
        bodies = [object_body] if isinstance(object_body, str) else list(object_body)
        o = len(bodies)
        self.block_dim = BLOCK_DIM if self.device != "cpu" else LANES
        if links is None and tips is not None:
            links = list(zip(layout.bodies, tips, strict=True))
        near = links if cfg.others and links is not None and f > 1 else []
        others = bool(near)
        if cfg.feel_others and not others:
            raise UserError("tactile.feel_others=true: this hand gives no tip surfaces to feel")
        solver = cfg.sum == "solver"
        columns = np.full((f, o), -1, dtype=np.int32)
        if solver:
            if pairs is None or len(pairs) != f:
                raise UserError(f"tactile.sum=solver needs a contact pair for each of {f} pads (or sum=spring)")
            for i, names in enumerate(pairs):
                names = [names] if isinstance(names, str) else list(names)
                if len(names) != o:
                    raise UserError(f"contact pairs of pad '{layout.names[i]}': {len(names)} given for {o} objects")
                columns[i] = [engine.pair(name) for name in names]
        selves = selves if solver and others else None
        self_columns = np.array([engine.pair(name) for name in selves] if selves else [-1] * f, dtype=np.int32)
        pressed = zip(layout.bodies, columns.tolist(), self_columns.tolist(), strict=True)
        alike = [str(x) for x in pressed]
        members = [[i for i in range(f) if alike[i] == x] for x in dict.fromkeys(alike)]
        if selves is not None and len(members) > len(set(layout.bodies)):
            raise UserError("touch of a hand on itself: pads of one body must name the same contact pairs")
        firsts = [m[0] for m in members]
        rounds = max(int((-(-layout.count[m] // LANES)).sum()) for m in members)
        rounds = rounds if rounds < CHUNK else CHUNK * -(-rounds // CHUNK)
        self.lanes = self.device != "cpu" if lanes is None else lanes
        measured = cfg.measured
        store = cfg.raw or measured
        self.columns = tuple(COLUMNS)

        with wp.ScopedDevice(self.device):
            raised = layout.lifted(tips) if cfg.lift and tips is not None else layout
            self._pads = _pads(engine, layout, raised)
            self._groups = _groups(engine, layout, raised, members, rounds)
            units = _units(layout, members)
            self._groups.unit = wp.array(units, dtype=Unit)
            self._law = _law(cfg, layout, needed=not solver or (others and selves is None))
            self.tips = ShapeSet(_link_shapes(near), self.device)
            a = SimpleNamespace(
                object_body=wp.array([engine.body(b) for b in bodies], dtype=int),
                shape_id=wp.full((n, o), -1, dtype=int),
                shape_size=wp.zeros((n, o), dtype=wp.vec3),
                pair_column=wp.array(columns[firsts], dtype=int),
                link_body=wp.array([engine.body(body) for body, _ in near], dtype=int),
                self_column=wp.array(self_columns[firsts], dtype=int),
                params=wp.zeros((len(COLUMNS), n), dtype=float),
                force=wp.zeros((n, f), dtype=float),
                centre=wp.zeros((n, f), dtype=wp.vec3),
                force_other=wp.zeros((n, f), dtype=float),
                readings=wp.zeros((n, f, t) if store else (1, 1, 1), dtype=float),
                distance=wp.zeros((n, f, t) if solver and not self.lanes else (1, 1, 1), dtype=float),
            )
        self._a = a
        self.shape_id, self.shape_size = wp.to_torch(a.shape_id), wp.to_torch(a.shape_size)
        if isinstance(object_body, str):
            self.shape_id, self.shape_size = self.shape_id[:, 0], self.shape_size[:, 0]
        self.force_clean, self.centre_clean = wp.to_torch(a.force), wp.to_torch(a.centre)
        self.force_other = wp.to_torch(a.force_other)
        self.force, self.centre = self.force_clean, self.centre_clean
        self.raw_clean = self.raw = wp.to_torch(a.readings) if store else None
        self.raw3 = None
        self._m: SimpleNamespace | None = None
        self.by_pad: ByPad | None = None
        self.params = wp.to_torch(a.params).T  # [N, C]; stored by column, so that the kernels read neighbours
        low = [[cfg.range(name)[0]] for name in COLUMNS]
        self._fixed = torch.tensor(low, dtype=torch.float32, device=self.device)  # [C, 1], what is not drawn
        self._row = {name: a.params[i] for i, name in enumerate(COLUMNS)}
        options = {"law": cfg.law, "pads": f, "taxels": t, "objects": o, "feel_others": cfg.feel_others}
        options |= {"links": len(near), "selves": selves is not None, "groups": len(members), "rounds": rounds}
        options |= {"most": max(map(len, members)), "units": len(units), "unit_rounds": max(x.rounds for x in units)}
        self._kernel = touch_kernel(self.lanes, solver, store, others, **options)
        self._hand, self._spans = spans(n, len(members), len(units), others, store and cfg.feel_others)
        kind: Any = FlatFelt if self.lanes else Felt
        self._out = kind()
        for name in kind.vars:
            setattr(self._out, name, getattr(a, name).flatten() if self.lanes else getattr(a, name))
        self._law.scale, self._law.threshold = self._row["stiffness_scale"], self._row["threshold"]
        self._around = here = Surroundings()
        here.xpos, here.xmat = engine.wp.xpos, engine.wp.xmat
        here.pair_normal = engine.wp.pair_normal if solver else wp.zeros((1, 1), dtype=float, device=self.device)
        for name in ("object_body", "shape_id", "shape_size", "pair_column", "link_body", "self_column"):
            setattr(here, name, getattr(a, name))
        assert all(x.is_contiguous for x in (here.xpos, here.xmat, here.pair_normal))  # kernels count on it
        if measured:
            if cfg.shear and o != 1:
                raise UserError(f"tactile.shear=true: works with one object, {o} were given")
            self.by_pad = (
                ByPad(cfg, layout, n, self.device, seed, {k: self.column(k) for k in OF_WORLD}) if cfg.pads else None
            )
            if self.by_pad is not None and self.by_pad.rubber and (o != 1 or (solver and len(members) < f)):
                raise UserError(
                    f"tactile.pads: rubber works with one object and one pad a link; {o} objects, {f} pads on"
                    f" {len(set(layout.bodies))} links were given"
                )
            self._measure(seed)
        everyone = torch.ones(n, dtype=torch.bool, device=self.device)
        self.randomize(everyone)
        self.reset(everyone)

    @property
    def imperfect(self) -> SimpleNamespace:
        """Arrays and kernels of the imperfect sensor; only with `cfg.measured`."""
        assert self._m is not None
        return self._m

    def _measure(self, seed: int) -> None:
        """Make the arrays and kernels of the imperfect sensor."""
        cfg, (n, f, t) = self.cfg, (self.engine.n, self.layout.pads, self.layout.taxels)
        pad = self.by_pad
        longest = max(cfg.range("delay")[1], 0.0 if pad is None else pad.longest)
        slots = 1 if longest == 0.0 else int(np.ceil(longest / cfg.period)) + 2
        hysteresis, noise = cfg.used("hysteresis") if pad is None else pad.hysteresis, cfg.used("noise")
        with wp.ScopedDevice(self.device):
            e = Effects()
            for name in Effects.vars:  # type: ignore[attr-defined]  # wp.struct adds it
                setattr(e, name, self._row[name])
            axes = np.stack([self.layout.tx, self.layout.ty], axis=2).astype(np.float32)
            self._m = m = SimpleNamespace(
                effects=e,
                axes=wp.array(axes, dtype=wp.vec3),
                gain=wp.ones((n, f, t), dtype=float),
                episode=wp.zeros(n, dtype=int),
                now=wp.zeros(n, dtype=float),
                last=wp.zeros(n, dtype=float),
                tick=wp.zeros(1, dtype=int),
                state=wp.zeros((n, f, t) if hysteresis else (1, 1, 1), dtype=float),
                anchor=wp.zeros((n, f, t) if cfg.shear else (1, 1, 1), dtype=wp.vec3),
                ring=wp.zeros((slots, n, f, t), dtype=float),
                ring_shear=wp.zeros((slots, n, f, t) if cfg.shear else (1, 1, 1, 1), dtype=wp.vec2),
                stamps=wp.zeros((n, slots), dtype=float),
                chosen=wp.zeros(n, dtype=int),
                late=wp.zeros(1, dtype=int),
                force=wp.zeros((n, f), dtype=float),
                centre=wp.zeros((n, f), dtype=wp.vec3),
                raw=wp.zeros((n, f, t) if cfg.raw else (1, 1, 1), dtype=float),
                raw3=wp.zeros((n, f, t) if cfg.raw and cfg.shear else (1, 1, 1), dtype=wp.vec3),
                seed=int(seed),
                # by pad, rubber has relaxed before the taxels are measured
                taxel=taxel_kernel(cfg.shear, hysteresis and pad is None, noise),
                report=report_kernel(self.lanes, cfg.shear, cfg.raw),
            )
        m.measured = Measured()
        m.measured.full_scale = float(cfg.full_scale)
        for name in ("seed", "gain", "axes", "tick", "now", "last", "state", "anchor", "ring", "ring_shear"):
            setattr(m.measured, name, getattr(m, name))
        self.force, self.centre = wp.to_torch(m.force), wp.to_torch(m.centre)
        self.gain = wp.to_torch(m.gain)
        self.raw = wp.to_torch(m.raw) if cfg.raw else None
        self.raw3 = wp.to_torch(m.raw3) if cfg.raw and cfg.shear else None

    def column(self, name: str) -> torch.Tensor:
        """View [N] of one per-world parameter; see `dexsim.tactile.config.COLUMNS`."""
        if name not in COLUMNS:
            raise UserError(f"touch has no parameter '{name}'; it has: {', '.join(COLUMNS)}")
        return self.params[:, self.columns.index(name)]

    def randomize(self, mask: torch.Tensor, generator: torch.Generator | None = None) -> None:
        """Draw the per-world parameters anew from their configured ranges where mask [N] (bool) holds."""
        stored = self.params.T  # as the kernels have it
        torch.where(mask, self._fixed, stored, out=stored)
        for name in self.columns:
            low, high = self.cfg.range(name)
            if low != high:
                col = self.column(name)
                draw = low + (high - low) * torch.rand(col.shape, generator=generator, device=col.device)
                col.copy_(torch.where(mask, draw, col))

        m = self._m
        if m is not None:
            wp.to_torch(m.episode).add_(mask.to(torch.int32))
            if self.cfg.used("gain_spread") or self.cfg.used("dead") or self.by_pad is not None:
                args = [wp.from_torch(mask), self._row["gain_spread"], self._row["dead"], m.episode, m.seed, m.gain]
                wp.launch(draw_gains, dim=m.gain.shape, inputs=args, device=self.device)
            if self.by_pad is not None:
                self.by_pad.randomize(mask, generator, m.episode, m.gain)

    def reset(self, mask: torch.Tensor) -> None:
        """Forget the past (hysteresis, shear anchors, delayed readings) where mask [N] (bool) holds."""
        m = self._m
        if m is not None:
            args = [wp.from_torch(mask), m.state, m.anchor, m.stamps, m.last]
            wp.launch(forget, dim=self.engine.n, inputs=args, device=self.device)

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """Return what a reading leaves to the next and what randomization draws, live. Whole numbers with their lowest
        and highest."""
        out: dict = {"params": self.params, "shape_size": self.shape_size}
        out["shape_id"] = self.shape_id, -1, len(self.shapes.names) - 1
        m, most = self._m, 2**31 - 1
        if m is not None:
            names = ("gain", "last", "state", "anchor", "ring", "ring_shear", "stamps")
            out |= {name: wp.to_torch(getattr(m, name)) for name in names}
            out |= {name: (wp.to_torch(getattr(m, name)), 0, most) for name in ("episode", "tick")}
        if self.by_pad is not None:
            out["pads"] = self.by_pad.values
        return out

    def check(self) -> None:
        """Fail if a delay was longer than the readings kept. Reads from the device: call it rarely."""
        if self._m is not None and int(self._m.late.numpy()[0]):
            raise UserError(
                "touch delay needs more readings than are kept: touch is read more often than every"
                f" tactile.period={self.cfg.period} s; set it to the time between control steps"
            )

    def launch(self) -> None:
        """Measure what all pads feel: only launches, so it can be recorded in a graph."""
        a, n = self._a, self.engine.n
        args = [self._around, self._pads, self._groups, self._law, self.shapes.wp, self.tips.wp, self._out]
        if self.lanes:
            for begin, count in self._spans:
                more = [*args, begin, self._hand]
                wp.launch(self._kernel, dim=count, inputs=more, block_dim=self.block_dim, device=self.device)
        else:
            wp.launch(self._kernel, dim=(n, self._groups.body.shape[0]), inputs=args, device=self.device)
        m = self._m
        if m is None:
            return
        wp.launch(clock, dim=n, inputs=[self.engine.wp.time, m.now, m.tick], device=self.device)
        pad = self.by_pad
        readings = a.readings if pad is None else pad.launch_skin(self, a.readings)
        args = [readings, self._around, self._pads, m.effects, m.measured]
        wp.launch(m.taxel, dim=m.gain.shape, inputs=args, device=self.device)
        if pad is not None:
            pad.launch_stuck(self)
        args = [m.now, m.effects.delay, m.tick, m.stamps, m.last, m.chosen, m.late]
        wp.launch(stamp, dim=n, inputs=args, device=self.device)
        ring, ring_shear, chosen = (m.ring, m.ring_shear, m.chosen) if pad is None else pad.launch_choice(self)
        args = [ring, ring_shear, chosen, self._pads, self._around, m.force, m.centre, m.raw, m.raw3]
        grid = (n, self.layout.pads)
        if self.lanes:  # a block of one thread per taxel for each world and pad
            width = self._pads.taxel.shape[1]
            wp.launch_tiled(m.report, dim=grid, inputs=args, block_dim=width, device=self.device)
        else:
            wp.launch(m.report, dim=grid, inputs=args, device=self.device)


@lru_cache(maxsize=64)
def _baked(corners: bytes) -> Grid:
    points = np.frombuffer(corners).reshape(-1, 3)
    grid = bake_convex(points, spacing=max(0.5e-3, float(np.ptp(points, 0).max()) / 128))
    grid.data.flags.writeable = False  # whoever asks has this one
    return grid


def _link_shapes(links: Sequence[tuple[str, np.ndarray]]) -> list[TouchShape]:
    """Return distance grids of links; equal ones share one, whoever asks."""
    return [TouchShape(body, "grid", _baked(np.ascontiguousarray(x, dtype=float).tobytes())) for body, x in links]


def _rows(layout: TaxelLayout, raised: TaxelLayout, f: int, rounds: int) -> np.ndarray:
    """Return pad f's taxels, where `raised` has them, in rounds of 32 [32 rounds, 4]; see `Pads.taxel`."""
    n = int(layout.count[f])
    out = np.zeros((LANES * rounds, 4), dtype=np.float32)
    out[:, :3] = raised.point[f, 0]
    out[:n, :3], out[:n, 3] = raised.point[f, :n], layout.area[f, :n]
    return out


def _pads(engine: Posed, layout: TaxelLayout, raised: TaxelLayout) -> Pads:
    """Return the layout on the device, with its taxels where `raised` has them."""
    out = Pads()
    out.body = wp.array([engine.body(b) for b in layout.bodies], dtype=int)
    out.count = wp.array(layout.count, dtype=int)
    width = -(-layout.taxels // LANES)
    out.taxel = wp.array(np.stack([_rows(layout, raised, f, width) for f in range(layout.pads)]), dtype=wp.vec4)
    out.centre = wp.array(layout.centre().astype(np.float32), dtype=wp.vec3)
    return out


def _groups(engine: Posed, layout: TaxelLayout, raised: TaxelLayout, members: list[list[int]], most: int) -> Groups:
    """Return groups of pads on the device, up to `most` rounds each."""
    taxel = np.zeros((len(members) + 1, LANES * most, 4), dtype=np.float32)
    round_ = np.zeros((len(members), most, 3), dtype=np.int32)
    box, bound, rounds = np.zeros((len(members), 2, 3)), np.zeros((len(members), 4)), []
    for g, pads in enumerate(members):
        parts = [_rows(layout, raised, f, -(-int(layout.count[f]) // LANES)) for f in pads]
        rows = np.concatenate(parts)
        taxel[g, :, :3], taxel[g, : len(rows)] = rows[0, :3], rows
        each = zip(pads, parts, strict=True)
        of = [(f, t, int(t + LANES == len(x))) for f, x in each for t in range(0, len(x), LANES)]
        round_[g], round_[g, : len(of)] = of[0], of
        rounds.append(len(of))
        box[g] = rows[:, :3].min(0), rows[:, :3].max(0)
        bound[g, :3] = box[g].mean(0)
        bound[g, 3] = np.linalg.norm(rows[:, :3] - bound[g, :3], axis=1).max()
    out = Groups()
    out.body = wp.array([engine.body(layout.bodies[pads[0]]) for pads in members], dtype=int)
    out.pads = wp.array(sum(members, []), dtype=int)
    out.first = wp.array(np.cumsum([0, *map(len, members)]), dtype=int)
    out.rounds, out.round = wp.array(rounds, dtype=int), wp.array(round_, dtype=wp.vec3i)
    out.taxel = wp.array(taxel, dtype=wp.vec4)
    # a micrometre for rounding
    out.middle = wp.array(box.mean(1).astype(np.float32), dtype=wp.vec3)
    out.half = wp.array((0.5 * (box[:, 1] - box[:, 0]) + 1e-6).astype(np.float32), dtype=wp.vec3)
    out.bound = wp.array(bound.astype(np.float32), dtype=wp.vec4)
    return out


def _units(layout: TaxelLayout, members: list[list[int]]) -> list[Unit]:
    """Return the units that share a world's lanes: those of a long group of several pads measure half of it each."""
    out: list[tuple[int, int, int, int, int, int]] = []
    ends = [(-(-layout.count[m] // LANES)).cumsum() for m in members]
    halved = [WIDTH < LANES and len(m) > 1 and e[-1] > CHUNK for m, e in zip(members, ends, strict=True)]
    for g in sorted(range(len(members)), key=lambda g: not halved[g]):  # halves stand side by side
        pads, first, end = len(members[g]), sum(map(len, members[:g])), int(ends[g][-1])
        if halved[g]:
            middle = 1 + int(np.abs(ends[g][:-1] - end / 2).argmin())
            rounds = int(ends[g][middle - 1])
            out.append((g, 0, rounds, first, middle, 1))
            out.append((g, rounds, end - rounds, first + middle, pads - middle, 1))
        else:
            out.append((g, 0, end, first, pads, 0))
    if len(out) % 2 and any(halved):
        out.append((0, 0, 0, 0, 0, 0))
    units = []
    for values in out:
        units.append(Unit())
        g, first, n = values[:3]
        last = sum(1 << int(e - first - 1) for e in ends[g] if first < e <= first + min(n, 31))
        for name, x in zip(Unit.vars, (*values, last), strict=True):  # type: ignore[attr-defined]  # wp.struct adds it
            setattr(units[-1], name, x)
    return units


def _law(cfg: TactileConfig, layout: TaxelLayout, needed: bool) -> Law:
    """Return the law of contact. needed: whether any force comes from springs; else no stiffness is asked for."""
    out = Law()
    stiffness = stiffness_of(cfg, layout.kinds) if needed else [1.0] * layout.pads
    out.stiffness = wp.array(np.array(stiffness, dtype=np.float32), dtype=float)
    out.thickness, out.c10, out.c01 = (float(cfg.rubber[k]) for k in ("thickness", "c10", "c01"))
    out.reach = float(cfg.reach)
    return out
