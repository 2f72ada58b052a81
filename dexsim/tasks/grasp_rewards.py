"""The grasp task's rewards and what its log shows, one Warp kernel over all worlds: a function a term, weights apart.

Each function is the term of one world without its weight (`rewards` in configs/task/grasp.yaml). R_force, R_torque,
R_diff, R_outter, R_action and R_vel are the paper's ("Force-Adaptive Grasping", the equations of these names). A term
can as well be written in torch: `GraspEnv.rewards` returns them all by name.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

import warp as wp

TERMS = {
    "force": "R_force",
    "torque": "R_torque",
    "diff": "R_diff",
    "outer": "R_outter",
    "termination": "terminal penalty",
    "action": "R_action",
    "velocity": "R_vel",
    "grip": "ours: thumb and fingers touch",
    "force_near": "ours: 1 - |F_i - F_cmd F_max| / F_max, mean of the fingers",
    "reach": "ours: pads near the object",
    "self": "ours: tips pressing on the hand",
    "still": "ours: object speed",
    "worst": "ours: force_near of the finger that is furthest off",
    "centre": "ours: object beside the fingers' middle",
    "torque_near": "ours: 1 - |tau_i / tau_max - F_cmd|, mean of the fingers",
    "torque_worst": "ours: torque_near of the finger that is furthest off",
    "thumb_near": "ours: the thumb's force near a command of its own (task.command.thumb)",
    "thumb_reach": "ours: the thumb's pad near the object",
}
"""Name of each reward and its words for the first screen."""
AT = {name: k for k, name in enumerate(TERMS)}
"""Row of each in what the kernel `rewards` gives."""
METRICS = ("held", "force_error", "fingers_touching", "force_other")
"""What follows the terms: what the log shows of worlds that are `LATE`, 0 in others; then whether they are."""
LATE = 2.0
"""s of an episode after which a grasp should hold."""
Weights = wp.types.vector(length=len(TERMS), dtype=float)


@wp.struct
class Shape:
    """Forms of the terms (`reward` in the task's settings), and what of the hand they need."""

    f_max: float  # N, F_max
    contact: float  # N, from which a finger touches
    lift: float  # command below which the others may as well lift off
    force_sigma: float  # these as fractions of F_max or of the largest torque
    force_low: float
    force_high: float
    torque_sigma: float
    torque_low: float
    torque_high: float
    reach_length: float  # m
    beside: float  # m, palm y of the fingers' middle
    centre_length: float  # m
    middle: wp.vec3  # m, of the grasp
    distance: float  # m from it, from where the object is dropped
    below: float  # m, palm z
    opposing: wp.array(dtype=int)  # fingers that press against the others
    others: wp.array(dtype=int)
    roots: wp.array(dtype=int)  # [F] joint whose torque closes each finger
    root_closes: wp.array(dtype=float)  # [F] its way
    tau_max: wp.array(dtype=float)  # [F] N.m
    inner: wp.array(dtype=int)  # first joints of `others`
    inner_closes: wp.array(dtype=float)
    outer: wp.array(dtype=int)  # second joints of `others`
    q_mid: wp.array(dtype=float)  # [J] rad


@wp.struct
class State:
    """N worlds after a control step: the environment's own memory, see `HandEnv`."""

    q: wp.array2d(dtype=float)
    qd: wp.array2d(dtype=float)
    torque: wp.array2d(dtype=float)
    action: wp.array2d(dtype=float)
    last_action: wp.array2d(dtype=float)
    tip_force: wp.array2d(dtype=float)
    self_force: wp.array2d(dtype=float)
    clearance: wp.array2d(dtype=float)  # m from each pad to the object
    object_pose: wp.array2d(dtype=float)
    object_velocity: wp.array2d(dtype=float)
    command: wp.array(dtype=float)
    thumb_command: wp.array(dtype=float)  # below 0: none of its own
    episode_length: wp.array(dtype=wp.int64)


# wp.min and wp.max would hide a number that is not finite, and a world with one must begin anew
@wp.func
def at_least(x: float, low: float):
    return wp.where(x < low, low, x)


@wp.func
def at_most(x: float, high: float):
    return wp.where(x > high, high, x)


@wp.func
def touches(f: int, w: int, s: State, shape: Shape):
    return s.tip_force[w, f] > shape.contact


@wp.func
def lifts(w: int, s: State, shape: Shape):
    """Return whether the fingers beside the opposing ones are told to press with next to nothing."""
    return s.command[w] < shape.lift


@wp.func
def opposes(f: int, shape: Shape):
    """Return whether a finger presses against the others, wherever it stands in the hand's order."""
    found = bool(False)
    for i in range(shape.opposing.shape[0]):
        if shape.opposing[i] == f:
            found = True
    return found


@wp.func
def tracking(x: float, command: float, x_max: float, sigma: float, low: float, high: float):
    """Return R_i of a finger that touches (R_force, R_torque): exp(-(x - command x_max)^2 / (2 (sigma x_max)^2)) within
    [low x_max, high x_max]; for a command below 0, as the thumb's is unless it has its own, the band alone. The paper
    prints tau_thumb in the fingers' torque band; we take it for tau_i."""
    if not (x >= low * x_max and x <= high * x_max):
        return float(0.0)
    if command < 0.0:
        return float(1.0)
    error = (x - command * x_max) / (sigma * x_max)
    return wp.exp(-0.5 * error * error)


@wp.func
def force(w: int, s: State, shape: Shape):
    """Return R_force: sum over the fingers that touch, or need not, of R_i at their force."""
    total = float(0.0)
    for f in range(s.tip_force.shape[1]):
        thumb = opposes(f, shape)
        free = lifts(w, s, shape) and not thumb
        if touches(f, w, s, shape) or free:
            command = wp.where(thumb, s.thumb_command[w], s.command[w])
            low = wp.where(free, float(0.0), shape.force_low)
            total += tracking(s.tip_force[w, f], command, shape.f_max, shape.force_sigma, low, shape.force_high)
    return total


@wp.func
def torque(w: int, s: State, shape: Shape):
    """Return R_torque: the same at the torque of their first joints, over its maximum."""
    total = float(0.0)
    for f in range(s.tip_force.shape[1]):
        if touches(f, w, s, shape):
            x = s.torque[w, shape.roots[f]] * shape.root_closes[f] / shape.tau_max[f]
            command = wp.where(opposes(f, shape), float(-1.0), s.command[w])
            total += tracking(x, command, 1.0, shape.torque_sigma, shape.torque_low, shape.torque_high)
    return total


@wp.func
def diff(w: int, s: State, shape: Shape):
    """Return R_diff: variance of the first joints [rad^2] of the fingers beside the opposing one."""
    n = shape.inner.shape[0]
    mean = float(0.0)
    for i in range(n):
        mean += s.q[w, shape.inner[i]] * shape.inner_closes[i]
    mean = mean / float(n)
    total = float(0.0)
    for i in range(n):
        off = s.q[w, shape.inner[i]] * shape.inner_closes[i] - mean
        total += off * off
    return total / float(n)


@wp.func
def outer(w: int, s: State, shape: Shape):
    """Return R_outter: distance of the second joints [rad] from their mid-range, not squared."""
    total = float(0.0)
    for i in range(shape.outer.shape[0]):
        j = shape.outer[i]
        off = s.q[w, j] - shape.q_mid[j]
        total += off * off
    return wp.sqrt(total)


@wp.func
def is_dropped(w: int, s: State, shape: Shape):
    """Return whether the object's centre is below the palm or far from it. While a world's gravity is turned, "below"
    means away from the palm."""
    p = wp.vec3(s.object_pose[w, 0], s.object_pose[w, 1], s.object_pose[w, 2])
    return wp.length(p - shape.middle) > shape.distance or p[2] < shape.below


@wp.func
def action(w: int, s: State):
    """Return R_action: squared change of the action."""
    total = float(0.0)
    for j in range(s.action.shape[1]):
        off = s.action[w, j] - s.last_action[w, j]
        total += off * off
    return total


@wp.func
def velocity(w: int, s: State):
    """Return R_vel: squared joint speeds [rad^2/s^2]."""
    total = float(0.0)
    for j in range(s.qd.shape[1]):
        total += s.qd[w, j] * s.qd[w, j]
    return total


@wp.func
def opposed(w: int, s: State, shape: Shape):
    """Return whether an opposing finger touches."""
    found = bool(False)
    for i in range(shape.opposing.shape[0]):
        if touches(shape.opposing[i], w, s, shape):
            found = True
    return found


@wp.func
def pressed(w: int, s: State, shape: Shape):
    """Return how many of the others touch."""
    count = float(0.0)
    for i in range(shape.others.shape[0]):
        if touches(shape.others[i], w, s, shape):
            count += 1.0
    return count


@wp.func
def aside(i: int, by_torque: bool, w: int, s: State, shape: Shape):
    """Return how far the force of the i-th of the others is from the command, as a fraction of F_max; or, by_torque,
    the torque of its first joint, as a fraction of that one's maximum."""
    f = shape.others[i]
    x = s.tip_force[w, f] / shape.f_max
    if by_torque:
        x = s.torque[w, shape.roots[f]] * shape.root_closes[f] / shape.tau_max[f]
    return wp.abs(x - s.command[w])


@wp.func
def near(by_torque: bool, w: int, s: State, shape: Shape):
    """Return 1 - `aside`, not below 0, mean of the others. Ours, dense where R_force (or R_torque) is flat."""
    total = float(0.0)
    for i in range(shape.others.shape[0]):
        total += at_least(1.0 - aside(i, by_torque, w, s, shape), 0.0)
    return total / float(shape.others.shape[0])


@wp.func
def worst(by_torque: bool, w: int, s: State, shape: Shape):
    """Return `near` of the finger that is furthest off. Ours; the mean hides one that presses on nothing."""
    furthest = float(0.0)
    for i in range(shape.others.shape[0]):
        off = aside(i, by_torque, w, s, shape)
        if off > furthest or wp.isnan(off):
            furthest = off
    return at_least(1.0 - furthest, 0.0)


@wp.func
def thumb_near(w: int, s: State, shape: Shape):
    """Return 1 - |F_thumb / F_max - its own command|, not below 0, mean of the opposing fingers; 0 where they have
    none. Ours."""
    if s.thumb_command[w] < 0.0:
        return float(0.0)
    total = float(0.0)
    for i in range(shape.opposing.shape[0]):
        off = wp.abs(s.tip_force[w, shape.opposing[i]] / shape.f_max - s.thumb_command[w])
        total += at_least(1.0 - off, 0.0)
    return total / float(shape.opposing.shape[0])


@wp.func
def reach(fingers: wp.array(dtype=int), w: int, s: State, shape: Shape):
    """Return how near the pads of these fingers are to the object, their mean. Ours: a finger that does not touch has
    nothing else that says which way the object lies."""
    total = float(0.0)
    for i in range(fingers.shape[0]):
        total += wp.exp(-at_least(s.clearance[w, fingers[i]], 0.0) / shape.reach_length)
    return total / float(fingers.shape[0])


@wp.func
def on_itself(w: int, s: State):
    """Return the sum of what the fingers press on the hand with, N."""
    total = float(0.0)
    for f in range(s.self_force.shape[1]):
        total += s.self_force[w, f]
    return total


@wp.func
def still(w: int, s: State):
    """Return the speed of the object [m/s], at most 1. Ours."""
    v = wp.vec3(s.object_velocity[w, 0], s.object_velocity[w, 1], s.object_velocity[w, 2])
    return at_most(wp.length(v), 1.0)


@wp.func
def centre(w: int, s: State, shape: Shape):
    """Return how far the object lies to one side, out of reach of the outer fingers; at most 2. Ours."""
    return at_most(wp.abs(s.object_pose[w, 1] - shape.beside) / shape.centre_length, 2.0)


@wp.func
def force_error(w: int, s: State, shape: Shape):
    """Return the mean distance of the others' force from the command, N."""
    total = float(0.0)
    for i in range(shape.others.shape[0]):
        total += wp.abs(s.tip_force[w, shape.others[i]] - s.command[w] * shape.f_max)
    return total / float(shape.others.shape[0])


@wp.func
def any_of(fingers: wp.array(dtype=int), force: wp.array2d(dtype=float), w: int):
    """Return whether one of these fingers touches, with whatever link."""
    found = bool(False)
    for i in range(fingers.shape[0]):
        if force[w, fingers[i]] > 0.0:
            found = True
    return found


@wp.kernel(enable_backward=False)
def dropped(
    finger_force: wp.array2d(dtype=float), rate: float, drawn: wp.array(dtype=float), period: float, s: State,
    shape: Shape, out: wp.array(dtype=wp.bool),
):  # fmt: skip
    """Compute whether the object is out; or, in a share `rate` (drawn: in [0, 1)), late and let go of. period: s."""
    w = wp.tid()
    held = any_of(shape.opposing, finger_force, w) and any_of(shape.others, finger_force, w)
    late = float(s.episode_length[w]) * period > wp.static(LATE)
    out[w] = is_dropped(w, s, shape) or (rate > 0.0 and drawn[w] < rate and late and not held)


@wp.kernel(enable_backward=False)
def rewards(weight: Weights, period: float, s: State, shape: Shape, out: wp.array2d(dtype=float)):
    """Compute out [T + M, N]: TERMS, weighted, then METRICS and whether they count. period: s of a control step."""
    w = wp.tid()
    fingers = pressed(w, s, shape)
    thumb = opposed(w, s, shape)
    squeeze = on_itself(w, s)
    value = Weights()
    value[wp.static(AT["force"])] = force(w, s, shape)
    value[wp.static(AT["torque"])] = torque(w, s, shape)
    value[wp.static(AT["diff"])] = diff(w, s, shape)
    value[wp.static(AT["outer"])] = outer(w, s, shape)
    value[wp.static(AT["termination"])] = wp.where(is_dropped(w, s, shape), float(1.0), float(0.0))
    value[wp.static(AT["action"])] = action(w, s)
    value[wp.static(AT["velocity"])] = velocity(w, s)
    n = float(shape.others.shape[0])
    value[wp.static(AT["grip"])] = wp.where(thumb, wp.where(lifts(w, s, shape), n, fingers) / n, float(0.0))
    value[wp.static(AT["force_near"])] = near(False, w, s, shape)
    value[wp.static(AT["reach"])] = reach(shape.others, w, s, shape)
    value[wp.static(AT["self"])] = at_most(squeeze / shape.f_max, 5.0)
    value[wp.static(AT["still"])] = still(w, s)
    value[wp.static(AT["worst"])] = worst(False, w, s, shape)
    value[wp.static(AT["centre"])] = centre(w, s, shape)
    value[wp.static(AT["torque_near"])] = near(True, w, s, shape)
    value[wp.static(AT["torque_worst"])] = worst(True, w, s, shape)
    value[wp.static(AT["thumb_near"])] = thumb_near(w, s, shape)
    value[wp.static(AT["thumb_reach"])] = reach(shape.opposing, w, s, shape)
    for k in range(wp.static(len(TERMS))):
        out[k, w] = weight[k] * value[k]

    late = float(0.0)
    if float(s.episode_length[w]) * period > wp.static(LATE):
        late = 1.0
    at = wp.static(len(TERMS))
    out[at, w] = wp.where(thumb and fingers > 0.0, late, float(0.0))
    out[at + 1, w] = late * force_error(w, s, shape)
    out[at + 2, w] = late * fingers
    out[at + 3, w] = late * squeeze
    out[at + 4, w] = late
