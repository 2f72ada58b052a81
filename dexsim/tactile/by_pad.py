"""What is known of single pads (`tactile.pads`), between what a skin feels and what its sensor reports.

Order, that of `dexsim.gap.touch.plant`: spread by rubber -> hysteresis -> neighbours -> exchanged wires -> gain ->
(noise, threshold, counts: `dexsim.tactile.measure`) -> stuck -> delay by pad. Nothing here is compiled or launched
without `tactile.pads`. Plain kernels, a thread for each pad or taxel, the same on every device; launches only, on
memory that never moves, so that they can be recorded.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from dexsim.tactile.config import TactileConfig
from dexsim.tactile.kernel import (
    LAWS,
    MAX_STRAIN,
    Law,
    Pads,
    Surroundings,
    pose_in,
    spread_level,
    spread_weight,
    taxel_force,
    turn_in,
    xyz,
)
from dexsim.tactile.layout import TaxelLayout
from dexsim.tactile.measure import NEVER, Effects, Measured, counts, relax, rubber_force
from dexsim.tactile.pads import PAD_COLUMNS, THICKNESS, check
from dexsim.tactile.sdf import Shapes, distance

if TYPE_CHECKING:
    from dexsim.tactile.tactile import Tactile

COLUMNS = tuple(PAD_COLUMNS)
OF_WORLD = ("hysteresis", "hysteresis_time", "delay")
"""What a pad has from the world's settings where its own do not say it."""
BESIDE = 4
"""Taxels beside one, at most."""
THE_PADS = -1.0
"""Gain of a taxel that has none of its own."""
LEFT = 1.0e-4
"""N: what other fingers press on a taxel counts from here; under it is rounding."""


@wp.struct
class Own:
    """What F pads of T taxels have of their own in N worlds, and the readings between which their delays lie."""

    gain: wp.array2d(dtype=float)  # [N, F]
    hysteresis: wp.array2d(dtype=float)
    hysteresis_time: wp.array2d(dtype=float)  # s
    crosstalk: wp.array2d(dtype=float)
    delay: wp.array2d(dtype=float)  # s
    ends: wp.array2d(dtype=wp.vec2)  # [F, T] range of a taxel's gain; THE_PADS: its pad's
    order: wp.array2d(dtype=int)  # [F, T] the taxel that a wire carries
    beside: wp.array3d(dtype=int)  # [F, T, BESIDE] -1: none
    stuck: wp.array2d(dtype=int)  # [S, 2] pad, taxel
    stuck_at: wp.array(dtype=float)  # [S] N
    older: wp.array2d(dtype=int)  # [N, F] slot of the ring; -1: none is as old yet
    newer: wp.array2d(dtype=int)
    part: wp.array2d(dtype=float)  # how far along from the older one


class ByPad:
    """Memory and launches of `tactile.pads` on N worlds, F pads, T taxels.

    layout: its names are the keys of cfg.pads. world: the per-world parameters by name, [N] each, of which pads without
    their own have theirs. values [C, N, F]: the parameters by `COLUMNS`, drawn by `randomize`. Raises UserError for a
    pad or taxel that the layout lacks.
    """

    def __init__(
        self, cfg: TactileConfig, layout: TaxelLayout, n: int, device: str, seed: int, world: dict[str, torch.Tensor]
    ):
        f, t = layout.pads, layout.taxels
        self.cfg, self.shape, self.device, self.seed, self._world = cfg, (n, f, t), device, int(seed) + 15485863, world
        low, high = (np.repeat(np.array([PAD_COLUMNS[c][3] for c in COLUMNS])[:, None], f, 1) for _ in range(2))
        own = np.zeros((len(COLUMNS), f), dtype=bool)
        gain = np.full((f, t, 2), THE_PADS)
        order, beside = np.tile(np.arange(t), (f, 1)), np.full((f, t, BESIDE), -1)
        stuck: list[tuple[int, int, float]] = []
        thickness, rubber = np.full(f, THICKNESS), np.zeros(f, dtype=bool)
        check(cfg.pads, layout.names, layout.count)
        for name, pad in cfg.pads.items():
            i = layout.names.index(name)
            for c, (a, b) in pad.params.items():
                j = COLUMNS.index(c)
                low[j, i], high[j, i], own[j, i] = a, b, True
            for k, ends in pad.taxels.items():
                gain[i, k] = ends
            for a, b in pad.swapped:
                order[i, [a, b]] = b, a
            stuck += [(i, k, v) for k, v in pad.stuck.items()]
            thickness[i], rubber[i] = pad.thickness, pad.rubber
        self.crosstalk = bool(high[COLUMNS.index("crosstalk")].any())
        self.rubber = bool(rubber.any())
        self.hysteresis = cfg.used("hysteresis") or bool(high[COLUMNS.index("hysteresis")].any())
        self.mixes = self.crosstalk or bool((order != np.arange(t)).any())
        self.delayed = bool(own[COLUMNS.index("delay")].any())
        if self.crosstalk:
            for row in np.flatnonzero(high[COLUMNS.index("crosstalk")]):
                beside[row, : layout.count[row]] = layout.beside(int(row))
        tensor = lambda x, kind=torch.float32: torch.as_tensor(x, dtype=kind, device=device)  # noqa: E731
        self._low, self._wide = tensor(low)[:, None], tensor(high - low)[:, None]
        self._own = tensor(own, torch.bool)[:, None]
        with wp.ScopedDevice(device):
            self._skins = skins = Skins()
            skins.known = wp.array(rubber.astype(np.int32), dtype=int)
            skins.thickness = wp.array(thickness.astype(np.float32), dtype=float)
            skins.distance = wp.zeros((n, f, t) if self.rubber else (1, 1, 1), dtype=float)
            values = wp.zeros((len(COLUMNS), n, f), dtype=float)
            self._m = m = Own()
            m.ends, m.order = wp.array(gain.astype(np.float32), dtype=wp.vec2), wp.array(order.astype(np.int32))
            m.beside = wp.array(beside.astype(np.int32))
            m.stuck = wp.array(np.array([s[:2] for s in stuck], dtype=np.int32).reshape(-1, 2))
            m.stuck_at = wp.array(np.array([s[2] for s in stuck], dtype=np.float32))
            m.older, m.newer = wp.zeros((n, f), dtype=int), wp.zeros((n, f), dtype=int)
            m.part = wp.zeros((n, f), dtype=float)
            spread, skin, mixed = (
                wp.zeros((n, f, t) if used else (1, 1, 1), dtype=float)
                for used in (self.rubber, self.hysteresis, self.mixes)
            )
            self._between = SimpleNamespace(spread=spread, skin=skin, mixed=mixed)
            self._ring = wp.zeros((1, n, f, t) if self.delayed else (1, 1, 1, 1), dtype=float)
            sheared = self.delayed and cfg.shear
            self._ring_shear = wp.zeros((1, n, f, t) if sheared else (1, 1, 1, 1), dtype=wp.vec2)
            self._chosen = wp.zeros(n, dtype=int)
        self.values: torch.Tensor = wp.to_torch(values)
        self._row = {name: values[i] for i, name in enumerate(COLUMNS)}
        for name in ("gain", "hysteresis", "hysteresis_time", "crosstalk", "delay"):
            setattr(m, name, self._row[name])
        skins.c10, skins.c01 = self._row["c10"], self._row["c01"]

    def column(self, name: str) -> torch.Tensor:
        """View [N, F] of one parameter; see `dexsim.tactile.pads.PAD_COLUMNS`."""
        return self.values[COLUMNS.index(name)]

    @property
    def longest(self) -> float:
        """Return the longest delay of a pad [s]."""
        j = COLUMNS.index("delay")
        return float((self._low + self._wide)[j].max())

    def randomize(
        self, mask: torch.Tensor, generator: torch.Generator | None, episode: wp.array, gain: wp.array
    ) -> None:
        """Draw the pads' parameters anew where mask [N] (bool) holds, and lay the gains over `gain` [N, F, T], which
        was drawn before."""
        n, f, _ = self.shape
        u = torch.rand((len(COLUMNS), n, f), generator=generator, device=self.values.device)
        drawn = self._low + self._wide * u
        for name in OF_WORLD:
            j = COLUMNS.index(name)
            drawn[j] = torch.where(self._own[j], drawn[j], self._world[name][:, None])
        self.values.copy_(torch.where(mask[None, :, None], drawn, self.values))
        args = [wp.from_torch(mask), self._m, episode, self.seed, gain]
        wp.launch(lay_gains, dim=self.shape, inputs=args, device=self.device)

    def launch_skin(self, touch: Tactile, forces: wp.array) -> wp.array:
        """Return felt forces [N, F, T] N as they reach each taxel's wire; `forces` itself where nothing lies between.
        touch: `Tactile`."""
        between = self._between
        if self.rubber:
            kernel = spread_kernel(self.cfg.sum == "solver", LAWS[self.cfg.law], self.cfg.feel_others)
            args = [touch._around, touch._pads, touch._law, touch.shapes.wp, self._skins, forces, between.spread]
            wp.launch(kernel, dim=self.shape[:2], inputs=args, device=self.device)
            forces = between.spread
        if self.hysteresis:
            args = [forces, self._m, touch.imperfect.measured, between.skin]
            wp.launch(relax_pads, dim=self.shape, inputs=args, device=self.device)
            forces = between.skin
        if self.mixes:
            wp.launch(mix, dim=self.shape, inputs=[forces, self._m, between.mixed], device=self.device)
            forces = between.mixed
        return forces

    def launch_stuck(self, touch: Tactile) -> None:
        """Write readings that never change over those that were just written into the ring."""
        if many := self._m.stuck_at.shape[0]:
            args = [self._m, touch.imperfect.effects, touch.imperfect.measured]
            wp.launch(stick, dim=(self.shape[0], many), inputs=args, device=self.device)

    def launch_choice(self, touch: Tactile) -> tuple[wp.array, wp.array, wp.array]:
        """Return (ring, ring_shear, chosen) to report: the sensor's own, or one slot with each pad's reading where pads
        have delays."""
        m = touch.imperfect
        if not self.delayed:
            return m.ring, m.ring_shear, m.chosen
        args = [self._m, m.measured, m.stamps, m.late]
        wp.launch(choose, dim=self.shape[:2], inputs=args, device=self.device)
        args = [self._m, m.effects, m.measured, self.cfg.shear, self._ring, self._ring_shear]
        wp.launch(pick, dim=self.shape, inputs=args, device=self.device)
        return self._ring, self._ring_shear, self._chosen


@wp.func
def rubber_pressure(depth: float, thickness: float, c10: float, c01: float):
    """Return the pressure [Pa] of a Mooney-Rivlin layer pressed in by `depth` [m]; see
    `dexsim.tactile.kernel.taxel_force`."""
    l = 1.0 - wp.min(depth / thickness, wp.static(MAX_STRAIN))
    return 2.0 * (1.0 / (l * l) - l) * (c10 + c01 / l)


@wp.struct
class Skins:
    """Rubber of pads whose own is known."""

    known: wp.array(dtype=int)  # [F] 0: it is the law's
    thickness: wp.array(dtype=float)  # [F] m
    c10: wp.array2d(dtype=float)  # [N, F] Pa
    c01: wp.array2d(dtype=float)  # [N, F] Pa
    distance: wp.array3d(dtype=float)  # [N, F, T] m, of the object's surface: scratch


@cache
def spread_kernel(solver: bool, kind: int, feel_others: bool) -> wp.Kernel:
    """Return one thread per (world, pad). Where the pad's rubber is known its force spreads as the rubber presses under
    each taxel, in place of the law in `dexsim.tactile.kernel`; the sum stays the solver's. A contact that reaches no
    taxel stays as it is. With sum=spring the taxels' forces are the rubber's own. One object."""

    def spread(
        here: Surroundings,
        pads: Pads,
        law: Law,
        shapes: Shapes,
        skins: Skins,
        forces: wp.array3d(dtype=float),
        # out
        out: wp.array3d(dtype=float),
    ):
        w, f = wp.tid()
        n = pads.count[f]
        for t in range(forces.shape[2]):
            out[w, f, t] = forces[w, f, t]
        shape = here.shape_id[w, 0]
        pressed = float(1.0)
        if wp.static(solver):
            pressed = here.pair_normal[w, here.pair_column[f, 0]]
        if skins.known[f] == 0 or shape < 0 or pressed <= 0.0:
            return
        body = pads.body[f]
        size = here.shape_size[w, 0]
        a = turn_in(here.xmat, w, body, here.object_body[0])
        b = pose_in(here.xpos, here.xmat, w, body, here.object_body[0])
        nearest = float(1.0e9)
        total = float(0.0)
        for t in range(n):
            p = pads.taxel[f, t]
            d = distance(shapes, shape, size, a * xyz(p) + b)
            skins.distance[w, f, t] = d
            nearest = wp.min(nearest, d)
            if d < 0.0:
                total += p[3] * rubber_pressure(-d, skins.thickness[f], skins.c10[w, f], skins.c01[w, f])
        if total <= 0.0:
            return
        share = float(1.0)
        before = float(0.0)
        level = spread_level(nearest, law.reach)
        k = law.scale[w] * law.stiffness[f]
        if wp.static(solver):
            share = pressed / total
            for t in range(n):
                before += spread_weight(skins.distance[w, f, t], pads.taxel[f, t][3], level)
        for t in range(n):
            d = skins.distance[w, f, t]
            area = pads.taxel[f, t][3]
            z = float(0.0)
            if d < 0.0:
                z = share * area * rubber_pressure(-d, skins.thickness[f], skins.c10[w, f], skins.c01[w, f])
            if wp.static(feel_others):
                was = float(0.0)
                if wp.static(solver):
                    was = pressed / before * spread_weight(d, area, level)
                else:
                    if d < 0.0:
                        was = taxel_force(wp.static(kind), law, k, -d, area, law.threshold[w])
                other = forces[w, f, t] - was
                if other > wp.static(LEFT):
                    z += other
            out[w, f, t] = z

    return wp.kernel(spread, enable_backward=False, module="unique")


@wp.kernel(enable_backward=False)
def relax_pads(forces: wp.array3d(dtype=float), own: Own, m: Measured, out: wp.array3d(dtype=float)):
    """Apply the standard linear solid of `dexsim.tactile.measure`, its constants by pad."""
    w, f, t = wp.tid()
    dt = float(0.0)
    if m.last[w] >= 0.0:
        dt = m.now[w] - m.last[w]
    z = forces[w, f, t]
    s = relax(m.state[w, f, t], z, dt, own.hysteresis_time[w, f])
    m.state[w, f, t] = s
    out[w, f, t] = rubber_force(z, s, own.hysteresis[w, f])


@wp.kernel(enable_backward=False)
def mix(forces: wp.array3d(dtype=float), own: Own, out: wp.array3d(dtype=float)):
    """Mix forces: a taxel keeps 1 - c of its own and gives c in equal parts to those beside it: the pad's sum stays.
    Then each wire carries the taxel at order[t]."""
    w, f, t = wp.tid()
    k = own.order[f, t]
    c = own.crosstalk[w, f]
    z = forces[w, f, k]
    if c > 0.0:
        got = float(0.0)
        for i in range(own.beside.shape[2]):
            j = own.beside[f, k, i]
            if j >= 0:
                many = float(0.0)
                for h in range(own.beside.shape[2]):
                    if own.beside[f, j, h] >= 0:
                        many += 1.0
                got += forces[w, f, j] / many
        z = (1.0 - c) * z + c * got
    out[w, f, t] = z


@wp.kernel(enable_backward=False)
def lay_gains(
    mask: wp.array(dtype=bool), own: Own, episode: wp.array(dtype=int), seed: int, gain: wp.array3d(dtype=float)
):
    """Set the gains: those that were drawn, times the taxel's own (uniform in its range), or the pad's."""
    w, f, t = wp.tid()
    if mask[w]:
        g = own.gain[w, f]
        ends = own.ends[f, t]
        if ends[0] >= 0.0:
            rng = wp.rand_init(seed + 104729 * episode[w], (w * gain.shape[1] + f) * gain.shape[2] + t)
            g = ends[0] + (ends[1] - ends[0]) * wp.randf(rng)
        gain[w, f, t] = gain[w, f, t] * g


@wp.kernel(enable_backward=False)
def stick(own: Own, effects: Effects, m: Measured):
    """Let taxels [S, 2] (pad, taxel) read what they always read, in whole counts where there are counts."""
    w, i = wp.tid()
    slot = m.tick[0] % m.ring.shape[0]
    m.ring[slot, w, own.stuck[i, 0], own.stuck[i, 1]] = counts(own.stuck_at[i], effects.lsb[w], 0.0, m.full_scale)


@wp.kernel(enable_backward=False)
def choose(own: Own, m: Measured, stamps: wp.array2d(dtype=float), late: wp.array(dtype=int)):
    """Find the two readings between which each pad's delayed moment lies, and how far along;
    `dexsim.tactile.measure.stamp` has noted the times."""
    w, f = wp.tid()
    n = stamps.shape[1]
    wanted = m.now[w] - own.delay[w, f]
    a = int(-1)
    b = int(-1)
    oldest = int(0)
    filled = int(1)
    for i in range(n):
        s = stamps[w, i]
        if s == wp.static(NEVER):
            filled = 0
        elif s <= wanted + 0.5e-6:
            if a < 0 or s > stamps[w, a]:
                a = i
        elif b < 0 or s < stamps[w, b]:
            b = i
        if s < stamps[w, oldest]:
            oldest = i
    x = float(0.0)
    if a < 0 and filled != 0:
        # the ring is too short for this delay: reported by `Tactile.check`
        a = oldest
        late[0] = 1
    elif a >= 0 and b >= 0:
        x = wp.clamp((wanted - stamps[w, a]) / (stamps[w, b] - stamps[w, a]), 0.0, 1.0)
        if x < 1.0e-3:  # rounding of the times
            x = 0.0
        if x > 0.999:
            x = 1.0
    if b < 0:
        b = a
    own.older[w, f] = a
    own.newer[w, f] = b
    own.part[w, f] = x


@wp.kernel(enable_backward=False)
def pick(
    own: Own, effects: Effects, m: Measured, shear: bool, out: wp.array4d(dtype=float),
    out_shear: wp.array4d(dtype=wp.vec2),
):  # fmt: skip
    """Write each pad's delayed reading into one slot, interpolated and again in whole counts; 0 where there is none
    yet."""
    w, f, t = wp.tid()
    a = own.older[w, f]
    b = own.newer[w, f]
    x = own.part[w, f]
    z = float(0.0)
    xy = wp.vec2(0.0, 0.0)
    if a >= 0:
        lsb = effects.lsb[w]
        z = (1.0 - x) * m.ring[a, w, f, t] + x * m.ring[b, w, f, t]
        if z <= effects.threshold[w]:
            z = 0.0
        z = counts(z, lsb, 0.0, m.full_scale)
        if shear:
            half = wp.floor(0.5 * m.full_scale)
            xy = (1.0 - x) * m.ring_shear[a, w, f, t] + x * m.ring_shear[b, w, f, t]
            xy = wp.vec2(counts(xy[0], lsb, -half, half), counts(xy[1], lsb, -half, half))
    out[0, w, f, t] = z
    if shear:
        out_shear[0, w, f, t] = xy
