"""What the grasp task does to each world in a control step beside rewards: commands, pushes, falls, noisy signals."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache

import warp as wp


@wp.struct
class Draws:
    """A command and a push as drawn, by world."""

    value: wp.array(dtype=float)  # of the command: in [0, 1) of its range, or as it is where fixed
    hold: wp.array(dtype=float)  # in [0, 1) of its range
    thumb: wp.array(dtype=float)  # in [0, 1] of the range of the thumb's own command
    weights: wp.array(dtype=float)  # size of the push, of the object's weight
    direction: wp.array2d(dtype=float)  # [N, 3] of any length
    duration: wp.array(dtype=float)  # s
    wait: wp.array(dtype=float)  # s


@wp.struct
class Orders:
    """What each world is told and pushed by."""

    command: wp.array(dtype=float)
    thumb_command: wp.array(dtype=float)  # below 0: none of its own
    command_left: wp.array(dtype=float)  # s
    push: wp.array2d(dtype=float)  # [N, 3] N
    push_left: wp.array(dtype=float)  # s
    push_wait: wp.array(dtype=float)  # s


@wp.struct
class CommandRange:
    fixed: bool
    zero: float  # share of commands that are 0
    low: float
    span: float
    hold_low: float  # s
    hold_span: float  # s
    thumb_low: float
    thumb_span: float


@wp.func
def new_command(w: int, r: CommandRange, d: Draws, o: Orders):
    value = d.value[w]
    if not r.fixed:
        if value < r.zero:
            value = float(0.0)
        else:
            value = r.low + r.span * (value - r.zero) / (1.0 - r.zero)
    o.command[w] = value
    o.thumb_command[w] = r.thumb_low + r.thumb_span * d.thumb[w]
    o.command_left[w] = r.hold_low + r.hold_span * d.hold[w]


@wp.func
def new_push(w: int, mass: float, d: Draws, o: Orders):
    """Draw a push in any direction, of a multiple of the object's weight, after a wait."""
    v = wp.vec3(d.direction[w, 0], d.direction[w, 1], d.direction[w, 2])
    v = v / wp.max(wp.length(v), 1.0e-9) * (d.weights[w] * mass * 9.81)
    for c in range(3):
        o.push[w, c] = v[c]
    o.push_left[w] = d.duration[w]
    o.push_wait[w] = d.wait[w]


@cache
def orders_kernel(real: type) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def orders(
        period: float,  # s since the last step
        pushes: bool,
        body: int,  # the object's
        r: CommandRange,
        d: Draws,
        mass: wp.array(dtype=float),
        outside: wp.array2d(dtype=float),  # [N, 3] N, on top of the push
        o: Orders,
        # out
        xfrc_applied: wp.array3d(dtype=real),
    ):
        """Commands and pushes move on by a control step; the force of a push that is under way is applied."""
        w = wp.tid()
        o.command_left[w] = o.command_left[w] - period
        if o.command_left[w] <= 0.0:
            new_command(w, r, d, o)
        o.push_wait[w] = o.push_wait[w] - period
        under_way = pushes and o.push_wait[w] <= 0.0
        if under_way:
            o.push_left[w] = o.push_left[w] - period
        over = o.push_left[w] <= 0.0
        for c in range(3):
            force = outside[w, c]
            if under_way and not over:
                force = o.push[w, c] + force
            xfrc_applied[w, body, c] = real(force)
        if over:
            new_push(w, mass[w], d, o)

    return orders


@wp.struct
class Fall:
    """How an episode begins, as drawn: [N] or [N, numbers], shapes in [], units SI."""

    joint: wp.array2d(dtype=float)  # [N, J] off the open hand
    object_xy: wp.array2d(dtype=float)
    drop: wp.array(dtype=float)  # lowest point over the palm
    roll: wp.array(dtype=float)  # in [0, 1) of a turn about the object's longest axis
    tilt_axis: wp.array2d(dtype=float)  # [N, 3] of any length
    tilt: wp.array(dtype=float)
    velocity_xy: wp.array2d(dtype=float)
    velocity_z: wp.array(dtype=float)
    spin: wp.array2d(dtype=float)
    vision_xy: wp.array2d(dtype=float)
    delay: wp.array(dtype=float)  # in [0, 1) of the camera's
    torque_bias: wp.array2d(dtype=float)  # [N, J] of tau_max


@wp.struct
class Place:
    """Where objects fall, the same for all worlds."""

    unit: float  # the hand's size
    rise: float  # m
    xy: wp.vec2
    pose: wp.array(dtype=float)  # [J] the open hand
    low: wp.array(dtype=float)
    high: wp.array(dtype=float)
    lay: wp.array(dtype=wp.vec4)  # [V] turn that brings the longest axis of a row of objects to palm y
    delay_low: int  # control steps
    delay_high: int


@wp.struct
class Begun:
    """Where a world begins (out, for `HandEnv.place`), and what its sensors remember of that."""

    hand: wp.array2d(dtype=float)
    pose: wp.array2d(dtype=float)
    velocity: wp.array2d(dtype=float)
    first_xy: wp.array2d(dtype=float)
    z_history: wp.array2d(dtype=float)
    z_delay: wp.array(dtype=wp.int64)
    z_seen: wp.array(dtype=float)
    torque_bias: wp.array2d(dtype=float)


@wp.func
def about(axis: wp.vec3, angle: float):
    """Return the quaternion (w, x, y, z) of a turn by angle [rad] about a unit axis."""
    s = wp.sin(0.5 * angle)
    return wp.vec4(wp.cos(0.5 * angle), axis[0] * s, axis[1] * s, axis[2] * s)


@wp.func
def times(a: wp.vec4, b: wp.vec4):
    """Return the Hamilton product: first b, then a."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.kernel(enable_backward=False)
def begin(
    mask: wp.array(dtype=wp.bool), p: Place, f: Fall, r: CommandRange, d: Draws, variant: wp.array(dtype=wp.int64),
    radius: wp.array(dtype=float), mass: wp.array(dtype=float), b: Begun, o: Orders,
):  # fmt: skip
    """Begin new episodes in the masked worlds. The object's longest axis lies across the fingers (palm y) up to the
    tilt; its lowest point is `drop` over the palm."""
    w = wp.tid()
    if not mask[w]:
        return
    for j in range(p.pose.shape[0]):
        b.hand[w, j] = wp.max(wp.min(p.pose[j] + f.joint[w, j], p.high[j]), p.low[j])
        b.torque_bias[w, j] = f.torque_bias[w, j]
    z = radius[w] + p.unit * f.drop[w] + p.rise
    b.pose[w, 2] = z
    for c in range(2):
        here = p.xy[c] + p.unit * f.object_xy[w, c]
        b.pose[w, c] = here
        b.first_xy[w, c] = here + f.vision_xy[w, c]
        b.velocity[w, c] = f.velocity_xy[w, c]
    axis = wp.vec3(f.tilt_axis[w, 0], f.tilt_axis[w, 1], f.tilt_axis[w, 2])
    axis = axis / wp.max(wp.length(axis), 1.0e-9)
    roll = about(wp.vec3(0.0, 1.0, 0.0), wp.static(2.0 * wp.PI) * f.roll[w])
    turn = times(about(axis, f.tilt[w]), times(roll, p.lay[int(variant[w])]))
    for c in range(4):
        b.pose[w, 3 + c] = turn[c]
    b.velocity[w, 2] = f.velocity_z[w]
    for c in range(3):
        b.velocity[w, 3 + c] = f.spin[w, c]
    for k in range(b.z_history.shape[1]):
        b.z_history[w, k] = z
    b.z_seen[w] = z
    delay = int(float(p.delay_low) + float(p.delay_high - p.delay_low + 1) * f.delay[w])
    b.z_delay[w] = wp.int64(wp.clamp(delay, p.delay_low, p.delay_high))
    new_command(w, r, d, o)
    new_push(w, mass[w], d, o)


@wp.struct
class Noise:
    """Of sensors: sizes (`sensors` in the task's settings), and standard normal numbers by world."""

    joint_size: float  # rad
    torque_size: float  # of tau_max
    tip_size: float  # m
    height_size: float  # m
    joint: wp.array2d(dtype=float)  # [N, J]
    torque: wp.array2d(dtype=float)  # [N, J]
    tip: wp.array2d(dtype=float)  # [N, 3 F]
    height: wp.array(dtype=float)


@wp.struct
class Truth:
    """What sensors are to show of each world."""

    q: wp.array2d(dtype=float)  # [N, J] rad
    torque: wp.array2d(dtype=float)  # [N, J] N.m
    torque_bias: wp.array2d(dtype=float)  # [N, J] of tau_max
    effort: wp.array(dtype=float)  # [J] N.m, tau_max
    tips: wp.array2d(dtype=wp.vec3)  # [N, F] m
    z: wp.array2d(dtype=float)  # [N, 1] m, of the object
    z_delay: wp.array(dtype=wp.int64)  # [N] control steps, the camera's


@wp.struct
class Sensed:
    """What they show of it."""

    z_history: wp.array2d(dtype=float)  # [N, H] m, true: the camera's pictures, newest first
    joint_position: wp.array2d(dtype=float)  # [N, J] rad
    joint_torque: wp.array2d(dtype=float)  # [N, J] of tau_max
    tip: wp.array2d(dtype=wp.vec3)  # [N, F] m
    seen: wp.array(dtype=float)  # [N] m, height of the object


@wp.kernel(enable_backward=False)
def sense(
    noise: Noise,
    t: Truth,
    # in and out
    s: Sensed,
):
    """Sense each world by encoders, currents and a camera, a control step later: noisy; the height late too."""
    w, k = wp.tid()
    joints = t.q.shape[1]
    if k < joints:
        s.joint_position[w, k] = t.q[w, k] + noise.joint_size * noise.joint[w, k]
        torque = t.torque[w, k] / t.effort[k] + t.torque_bias[w, k]
        s.joint_torque[w, k] = torque + noise.torque_size * noise.torque[w, k]
        return
    f = k - joints
    if f < t.tips.shape[1]:
        off = wp.vec3(noise.tip[w, 3 * f], noise.tip[w, 3 * f + 1], noise.tip[w, 3 * f + 2])
        s.tip[w, f] = t.tips[w, f] + noise.tip_size * off
        return
    for i in range(s.z_history.shape[1] - 1):
        at = s.z_history.shape[1] - 1 - i
        s.z_history[w, at] = s.z_history[w, at - 1]
    s.z_history[w, 0] = t.z[w, 0]
    s.seen[w] = s.z_history[w, int(t.z_delay[w])] + noise.height_size * noise.height[w]
