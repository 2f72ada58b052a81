"""From what a skin feels to what its sensor reports: rubber, gains, noise, counts and delay, in two launches.

Order: rubber hysteresis -> gain (0 for a dead taxel) -> noise -> threshold -> quantisation and saturation -> delay. The
centre is computed from the delayed forces and the present pose, as a driver on the hand does.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from dexsim.tactile.kernel import Pads, Surroundings, centre_of, pose_in, turn_in, xyz

NO_ANCHOR = 1.0e9  # m, x of an anchor that is not there
NEVER = 1.0e30  # s, stamp of a slot that holds no reading


@wp.struct
class Effects:
    """Per-world parameters [N]; see `dexsim.tactile.config.COLUMNS`."""

    threshold: wp.array(dtype=float)
    noise: wp.array(dtype=float)
    lsb: wp.array(dtype=float)
    delay: wp.array(dtype=float)
    hysteresis: wp.array(dtype=float)
    hysteresis_time: wp.array(dtype=float)
    shear_stiffness: wp.array(dtype=float)
    friction: wp.array(dtype=float)


@wp.struct
class Measured:
    """What sensors keep from one reading to the next, and their last S readings: N worlds, F pads, T taxels."""

    seed: int
    full_scale: float  # counts
    gain: wp.array3d(dtype=float)  # [N, F, T] 0: dead
    axes: wp.array3d(dtype=wp.vec3)  # [F, T, 2] tx, ty
    tick: wp.array(dtype=int)  # [1] number of this reading
    now: wp.array(dtype=float)  # [N] s, of this reading, and
    last: wp.array(dtype=float)  # [N] s, of the one before; -1: none since reset
    # in and out
    state: wp.array3d(dtype=float)  # [N, F, T] N, to which the rubber has relaxed
    anchor: wp.array3d(dtype=wp.vec3)  # [N, F, T] m, object frame: where the taxel sticks to it
    # out
    ring: wp.array4d(dtype=float)  # [S, N, F, T] N
    ring_shear: wp.array4d(dtype=wp.vec2)  # [S, N, F, T] N, along tx, ty


@wp.func
def relax(state: float, elastic: float, dt: float, time: float):
    """State of the Maxwell branch: d(state)/dt = (elastic - state) / time, exact for a constant elastic force."""
    return elastic + (state - elastic) * wp.exp(-dt / time)


@wp.func
def rubber_force(elastic: float, state: float, fraction: float):
    """Return the force of a standard linear solid: the elastic force plus a branch that has relaxed to `state`; rubber
    does not pull."""
    return wp.max(elastic + fraction * (elastic - state), 0.0)


@wp.func
def cap(f: wp.vec2, limit: float):
    """Return a friction force no longer than Coulomb's limit, in the same direction."""
    size = wp.length(f)
    if size > limit:
        f = f * (limit / size)
    return f


@wp.func
def counts(f: float, lsb: float, low: float, high: float):
    """Round to whole counts of `lsb` [N] between low and high; lsb 0: as it is."""
    if lsb > 0.0:
        f = lsb * wp.clamp(wp.round(f / lsb), low, high)
    return f


@cache
def taxel_kernel(shear: bool, hysteresis: bool, noise: bool) -> wp.Kernel:
    """Return one thread per (world, pad, taxel): felt force in, reading of this moment into slot `tick` of the ring."""

    def measure_taxels(
        forces: wp.array3d(dtype=float),
        here: Surroundings,
        pads: Pads,
        effects: Effects,
        # in and out
        m: Measured,
    ):
        w, f, t = wp.tid()
        slot = m.tick[0] % m.ring.shape[0]
        elastic = forces[w, f, t]
        z = elastic
        if wp.static(hysteresis):
            dt = float(0.0)
            if m.last[w] >= 0.0:
                dt = m.now[w] - m.last[w]
            s = relax(m.state[w, f, t], elastic, dt, effects.hysteresis_time[w])
            m.state[w, f, t] = s
            z = rubber_force(elastic, s, effects.hysteresis[w])
        g = m.gain[w, f, t]
        r = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(noise):
            if t < pads.count[f]:
                rng = wp.rand_init(m.seed + 7919 * m.tick[0], (w * forces.shape[1] + f) * forces.shape[2] + t)
                sigma = effects.noise[w]
                r = wp.vec3(sigma * wp.randn(rng), sigma * wp.randn(rng), sigma * wp.randn(rng))
                if g == 0.0:
                    r = wp.vec3(0.0, 0.0, 0.0)  # a dead taxel is silent
        lsb = effects.lsb[w]
        out = wp.max(g * z + r[2], 0.0)
        if out <= effects.threshold[w]:
            out = 0.0
        m.ring[slot, w, f, t] = counts(out, lsb, 0.0, m.full_scale)
        if wp.static(shear):
            tangential = wp.vec2(0.0, 0.0)
            if elastic > 0.0:
                body = pads.body[f]
                p = pads.taxel[f, t]
                a = turn_in(here.xmat, w, body, here.object_body[0])
                q = a * xyz(p) + pose_in(here.xpos, here.xmat, w, body, here.object_body[0])
                c = m.anchor[w, f, t]
                if c[0] == wp.static(NO_ANCHOR):
                    c = q
                u = wp.transpose(a) * (q - c)
                k = effects.shear_stiffness[w] * p[3]
                x = m.axes[f, t, 0]
                y = m.axes[f, t, 1]
                tangential = cap(wp.vec2(k * wp.dot(u, x), k * wp.dot(u, y)), effects.friction[w] * elastic)
                # where the cap holds, the anchor is dragged along: slip
                if k > 0.0:
                    m.anchor[w, f, t] = q - a * (x * tangential[0] + y * tangential[1]) / k
                else:
                    m.anchor[w, f, t] = q
            else:
                m.anchor[w, f, t] = wp.vec3(wp.static(NO_ANCHOR), 0.0, 0.0)
            half = wp.floor(0.5 * m.full_scale)
            m.ring_shear[slot, w, f, t] = wp.vec2(
                counts(g * tangential[0] + r[0], lsb, -half, half), counts(g * tangential[1] + r[1], lsb, -half, half)
            )

    return wp.kernel(measure_taxels, enable_backward=False, module="unique")


@wp.kernel(enable_backward=False)
def stamp(
    time: wp.array(dtype=float),
    delay: wp.array(dtype=float),
    tick: wp.array(dtype=int),
    # in and out
    stamps: wp.array2d(dtype=float),
    # out
    last: wp.array(dtype=float),
    chosen: wp.array(dtype=int),
    late: wp.array(dtype=int),
):
    """Note the time of this reading, and choose each world's newest one that is old enough (-1: none since reset)."""
    w = wp.tid()
    n = stamps.shape[1]
    now = time[w]
    stamps[w, tick[0] % n] = now
    last[w] = now
    # half a microsecond for sums of float32 steps
    wanted = now - delay[w] + 0.5e-6
    best = int(-1)
    oldest = int(0)
    filled = int(1)
    for i in range(n):
        s = stamps[w, i]
        if s == wp.static(NEVER):
            filled = 0
        elif s <= wanted:
            if best < 0 or s > stamps[w, best]:
                best = i
        if s < stamps[w, oldest]:
            oldest = i
    if best < 0 and filled != 0:
        # the ring is too short for this delay: reported by `Tactile.check`
        best = oldest
        late[0] = 1
    chosen[w] = best


@wp.kernel(enable_backward=False)
def clock(time: wp.array(dtype=Any), now: wp.array(dtype=float), tick: wp.array(dtype=int)):
    """Copy the engine's time [s] in float32, and count one more reading."""
    w = wp.tid()
    now[w] = float(time[w])
    if w == 0:
        tick[0] = tick[0] + 1


@wp.kernel(enable_backward=False)
def draw_gains(
    mask: wp.array(dtype=bool),
    spread: wp.array(dtype=float),
    dead: wp.array(dtype=float),
    episode: wp.array(dtype=int),
    seed: int,
    # out
    gain: wp.array3d(dtype=float),
):
    """Draw gains 1 + spread * normal, at least 0; a share `dead` of the taxels has gain 0."""
    w, f, t = wp.tid()
    if mask[w]:
        rng = wp.rand_init(seed + 104729 * episode[w], (w * gain.shape[1] + f) * gain.shape[2] + t)
        g = wp.max(1.0 + spread[w] * wp.randn(rng), 0.0)
        if wp.randf(rng) < dead[w]:
            g = 0.0
        gain[w, f, t] = g


@cache
def report_kernel(block: bool, shear: bool, raw: bool) -> wp.Kernel:
    """Reduce each world's chosen reading to force and centre per pad; [N, F] threads (serial) or tiles (block)."""

    def serial(
        ring: wp.array4d(dtype=float), ring_shear: wp.array4d(dtype=wp.vec2), chosen: wp.array(dtype=int), pads: Pads,
        here: Surroundings, force: wp.array2d(dtype=float), centre: wp.array2d(dtype=wp.vec3),
        out: wp.array3d(dtype=float), out3: wp.array3d(dtype=wp.vec3),
    ):  # fmt: skip
        w, f = wp.tid()
        slot = chosen[w]
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for t in range(ring.shape[3]):
            z = float(0.0)
            xy = wp.vec2(0.0, 0.0)
            if slot >= 0:
                z = ring[slot, w, f, t]
                if wp.static(shear):
                    xy = ring_shear[slot, w, f, t]
            p = pads.taxel[f, t]
            total += wp.vec4(z * p[0], z * p[1], z * p[2], z)
            if wp.static(raw):
                out[w, f, t] = z
                if wp.static(shear):
                    out3[w, f, t] = wp.vec3(xy[0], xy[1], z)
        force[w, f] = total[3]
        centre[w, f] = here.xmat[w, pads.body[f]] * centre_of(pads, f, total) + here.xpos[w, pads.body[f]]

    def tiled(
        ring: wp.array4d(dtype=float), ring_shear: wp.array4d(dtype=wp.vec2), chosen: wp.array(dtype=int), pads: Pads,
        here: Surroundings, force: wp.array2d(dtype=float), centre: wp.array2d(dtype=wp.vec3),
        out: wp.array3d(dtype=float), out3: wp.array3d(dtype=wp.vec3),
    ):  # fmt: skip
        w, f, t = wp.tid()
        slot = chosen[w]
        z = float(0.0)
        mine = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if t < ring.shape[3]:
            xy = wp.vec2(0.0, 0.0)
            if slot >= 0:
                z = ring[slot, w, f, t]
                if wp.static(shear):
                    xy = ring_shear[slot, w, f, t]
            p = pads.taxel[f, t]
            mine = wp.vec4(z * p[0], z * p[1], z * p[2], z)
            if wp.static(raw):
                out[w, f, t] = z
                if wp.static(shear):
                    out3[w, f, t] = wp.vec3(xy[0], xy[1], z)
        sums = wp.tile_sum(wp.tile(mine, preserve_type=True))
        total = sums[0]
        if t == 0:
            force[w, f] = total[3]
            centre[w, f] = here.xmat[w, pads.body[f]] * centre_of(pads, f, total) + here.xpos[w, pads.body[f]]

    return wp.kernel(tiled if block else serial, enable_backward=False, module="unique")


@wp.kernel(enable_backward=False)
def forget(
    mask: wp.array(dtype=bool),
    # out
    state: wp.array3d(dtype=float),
    anchor: wp.array3d(dtype=wp.vec3),
    stamps: wp.array2d(dtype=float),
    last: wp.array(dtype=float),
):
    w = wp.tid()
    if not mask[w]:
        return
    last[w] = -1.0
    for i in range(stamps.shape[1]):
        stamps[w, i] = wp.static(NEVER)
    if state.shape[0] > 1 or stamps.shape[0] == 1:
        for f in range(state.shape[1]):
            for t in range(state.shape[2]):
                state[w, f, t] = 0.0
    if anchor.shape[0] > 1 or stamps.shape[0] == 1:
        for f in range(anchor.shape[1]):
            for t in range(anchor.shape[2]):
                anchor[w, f, t] = wp.vec3(wp.static(NO_ANCHOR), 0.0, 0.0)
