"""What an environment copies from its engine and touch, each as one Warp kernel."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache

import warp as wp

from dexsim.sim.engine import FLAG_NAN

OBJECT_NUMBERS = 13
"""Of a free body: position, quaternion, linear and angular velocity."""


@wp.struct
class Places:
    """Where in the engine's arrays an environment's joints, object and fingertips are."""

    joint_q: wp.array(dtype=int)  # [J] address in qpos
    joint_v: wp.array(dtype=int)  # [J] in qvel
    object_q: int  # first address in qpos
    object_v: int
    tip_body: wp.array(dtype=int)  # [F]
    tip_offset: wp.array(dtype=wp.vec3)  # [F] m, of the tip in its body


@wp.struct
class Seen:
    """What an environment knows of its engine's state, as float32."""

    nan: wp.array(dtype=wp.bool)  # [N]
    q: wp.array2d(dtype=float)  # [N, J] rad
    qd: wp.array2d(dtype=float)
    torque: wp.array2d(dtype=float)  # N.m, of the motors
    object_pose: wp.array2d(dtype=float)  # [N, 7]
    object_velocity: wp.array2d(dtype=float)  # [N, 6]
    tip_force: wp.array2d(dtype=float)  # [N, F] N
    finger_force: wp.array2d(dtype=float)
    self_force: wp.array2d(dtype=float)
    palm_force: wp.array(dtype=float)  # [N]
    tips: wp.array2d(dtype=wp.vec3)  # [N, F] m


@cache
def read_kernel(real: type) -> wp.Kernel:
    """Return joints, object, contact forces and fingertips of N worlds as float32; of a world that is not finite,
    zeros."""

    @wp.kernel(module="unique", enable_backward=False)
    def read(
        flags: wp.array(dtype=int), qpos: wp.array2d(dtype=real), qvel: wp.array2d(dtype=real),
        motor: wp.array2d(dtype=real), pair_normal: wp.array2d(dtype=float), xpos: wp.array2d(dtype=wp.vec3),
        xmat: wp.array2d(dtype=wp.mat33), at: Places, out: Seen,
    ):  # fmt: skip
        w, k = wp.tid()
        bad = (flags[w] & wp.static(FLAG_NAN)) != 0
        joints = at.joint_q.shape[0]
        if k < joints:  # a joint
            out.q[w, k] = wp.where(bad, float(0.0), float(qpos[w, at.joint_q[k]]))
            out.qd[w, k] = wp.where(bad, float(0.0), float(qvel[w, at.joint_v[k]]))
            out.torque[w, k] = wp.where(bad, float(0.0), float(motor[w, k]))
            return
        i = k - joints
        if i < 7:  # a number of the object
            out.object_pose[w, i] = wp.where(bad, float(0.0), float(qpos[w, at.object_q + i]))
            return
        if i < wp.static(OBJECT_NUMBERS):
            out.object_velocity[w, i - 7] = wp.where(bad, float(0.0), float(qvel[w, at.object_v + i - 7]))
            return
        f = i - wp.static(OBJECT_NUMBERS)
        fingers = at.tip_body.shape[0]
        if f < fingers:
            out.tip_force[w, f] = wp.where(bad, float(0.0), pair_normal[w, f])
            out.finger_force[w, f] = wp.where(bad, float(0.0), pair_normal[w, fingers + f])
            out.self_force[w, f] = wp.where(bad, float(0.0), pair_normal[w, 2 * fingers + 1 + f])
            b = at.tip_body[f]
            out.tips[w, f] = wp.where(bad, wp.vec3(0.0, 0.0, 0.0), xpos[w, b] + xmat[w, b] * at.tip_offset[f])
            return
        out.palm_force[w] = wp.where(bad, float(0.0), pair_normal[w, 2 * fingers])
        out.nan[w] = bad

    return read


@wp.kernel(enable_backward=False)
def clear_touch(
    mask: wp.array(dtype=wp.bool),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    pad_body: wp.array(dtype=int),
    pad_centre: wp.array(dtype=wp.vec3),
    # out
    force: wp.array2d(dtype=float),
    force_clean: wp.array2d(dtype=float),
    force_other: wp.array2d(dtype=float),
    centre: wp.array2d(dtype=wp.vec3),
    centre_clean: wp.array2d(dtype=wp.vec3),
):
    """Clear touch in the masked worlds: no force, and the pads' own centres."""
    w, f = wp.tid()
    if mask[w]:
        force[w, f] = float(0.0)
        force_clean[w, f] = float(0.0)
        force_other[w, f] = float(0.0)
        b = pad_body[f]
        here = xpos[w, b] + xmat[w, b] * pad_centre[f]
        centre[w, f] = here
        centre_clean[w, f] = here


@wp.struct
class Reach:
    """What targets a joint may be given. Relative: an action moves the target, else it spans the range."""

    relative: bool
    scale: wp.array(dtype=float)  # [J] rad a control step; relative only
    lead: wp.array(dtype=float)  # [J] rad that a target may be ahead of the measured angle; relative only
    low: wp.array(dtype=float)  # [J] rad
    high: wp.array(dtype=float)
    middle: wp.array(dtype=float)
    half: wp.array(dtype=float)


@wp.kernel(enable_backward=False)
def act(
    given: wp.array2d(dtype=float),
    reach: Reach,
    q: wp.array2d(dtype=float),
    # in and out
    action: wp.array2d(dtype=float),
    last_action: wp.array2d(dtype=float),
    target: wp.array2d(dtype=float),
):
    """Make targets of actions, see `HandEnv.act`; what is not a number is 0."""
    w, j = wp.tid()
    a = given[w, j]
    if wp.isnan(a):
        a = float(0.0)
    a = wp.clamp(a, -1.0, 1.0)
    last_action[w, j] = action[w, j]
    action[w, j] = a
    t = reach.middle[j] + a * reach.half[j]
    if reach.relative:
        t = target[w, j] + a * reach.scale[j]
        t = wp.max(wp.min(t, q[w, j] + reach.lead[j]), q[w, j] - reach.lead[j])
    target[w, j] = wp.max(wp.min(t, reach.high[j]), reach.low[j])


@wp.struct
class Ends:
    """What ends the episodes of N worlds."""

    episode_length: wp.array(dtype=wp.int64)  # [N] control steps
    limit: wp.array(dtype=wp.int64)  # [1]
    blind: wp.array(dtype=wp.bool)  # [N] an observation is not finite
    ends: wp.array2d(dtype=wp.bool)  # [E, N]


@wp.struct
class Ended:
    """Which worlds end, and what they earned."""

    total: wp.array(dtype=float)  # [N]
    done: wp.array(dtype=wp.bool)
    time_out: wp.array(dtype=wp.bool)
    rates: wp.array2d(dtype=float)  # [E + 2, N] of each end, of nan and of time_out: 1 or 0


@wp.kernel(enable_backward=False)
def judge(
    given: Ends,
    # in and out
    reward: wp.array2d(dtype=float),  # [T, N]
    nan: wp.array(dtype=wp.bool),
    wrong: wp.array(dtype=wp.int64),  # [1 + T + 1] world-steps: of states, of each reward, of observations
    nan_count: wp.array(dtype=wp.int64),
    out: Ended,
):
    """Decide which worlds end, and what they earned. One whose state, a reward or the last observation is not finite
    ends as `nan` and earns nothing."""
    w = wp.tid()
    terms = reward.shape[0]
    bad = nan[w]
    if bad:
        wp.atomic_add(wrong, 0, wp.int64(1))
    found = bad
    total_here = float(0.0)
    for k in range(terms):
        r = reward[k, w]
        total_here += r
        if not wp.isfinite(r):
            if not bad:
                wp.atomic_add(wrong, 1 + k, wp.int64(1))
            found = True
    if given.blind[w]:
        wp.atomic_add(wrong, 1 + terms, wp.int64(1))
        found = True
    if found:
        wp.atomic_add(nan_count, 0, wp.int64(1))
        total_here = float(0.0)
        for k in range(terms):
            reward[k, w] = float(0.0)
    nan[w] = found
    dead = found
    count = given.ends.shape[0]
    for k in range(count):
        out.rates[k, w] = wp.where(given.ends[k, w], float(1.0), float(0.0))
        dead = dead or given.ends[k, w]
    late = given.episode_length[w] >= given.limit[0] and not dead
    out.rates[count, w] = wp.where(found, float(1.0), float(0.0))
    out.rates[count + 1, w] = wp.where(late, float(1.0), float(0.0))
    out.total[w] = total_here
    out.time_out[w] = late
    out.done[w] = dead or late


@wp.kernel(enable_backward=False)
def note_not_finite(value: wp.array2d(dtype=float), row: int, blind: wp.array2d(dtype=wp.bool)):
    """Note in blind [1 + groups, N] the worlds of which any group, or this one (row), holds a number that is not
    finite."""
    w, k = wp.tid()
    if not wp.isfinite(value[w, k]):
        blind[0, w] = True
        blind[row, w] = True


@wp.kernel(enable_backward=False)
def keep_finite(
    value: wp.array2d(dtype=float), row: int, blind: wp.array2d(dtype=wp.bool), out: wp.array2d(dtype=float)
):
    """Copies a group's observations; zeros where they are not finite."""
    w, k = wp.tid()
    out[w, k] = wp.where(blind[row, w], float(0.0), value[w, k])
