"""A one-joint rig for the concealed benchmark: written apart from the simulator it tests, and sharing none of its code.

Motor and link are two inertias joined by a stiff damped spring with optional play; friction is the LuGre bristle model
(Canudas de Wit et al. 1995) on the motor side; the firmware runs its own loop at 1 kHz on its own encoder; the whole is
integrated at 10 kHz, semi-implicit Euler. All rows of a batch run at once: [B] values for every parameter.
SI units: rad, rad/s, N.m, s, kg.
"""

from __future__ import annotations

import numpy as np

DT = 1e-4  # s, integration
LOOP = 10  # integration steps in one firmware period (1 kHz)
HISTORY = 0.25  # s of commands that the firmware can look back

# Every parameter of a row and its value where the effect is absent.
DEFAULTS: dict[str, float] = {
    "mass": 0.15, "length": 0.1, "link_inertia": 0.0,  # bob [kg], its distance [m], inertia about its own centre [kg.m2]
    "gravity": 9.81, "rotor": 4e-4,  # m/s2; reflected rotor inertia [kg.m2]
    "spring": 600.0, "spring_loss": 0.0, "play": 0.0,  # N.m/rad; 0: chosen from the inertias; total play [rad]
    "kp": 2.0, "kd": 0.04, "torque_limit": 1.0, "no_load_speed": 15.0,
    "delay": 0.0, "lag": 0.0, "deadband": 0.0, "offset": 0.0,  # s, s, rad (half width), rad
    "motor_side": 0.0,  # 1: the loop reads the motor, 0: the link
    "coulomb": 0.015, "viscous": 0.003, "peak": 0.0, "peak_speed": 0.1, "load": 0.0, "load_back": 0.0,
    "dwell": 0.0, "dwell_time": 1.0,  # stiction that grows with time at rest [N.m], its time constant [s]
    "ripple": 0.0, "per_turn": 12.0, "phase": 0.0, "scale": 1.0,  # N.m, per turn of the motor, rad; of both encoders
    "cable": 0.0, "cable_rest": 0.0,  # spring to the world [N.m/rad], the angle where it is slack [rad]
    "bristle": 1.0,  # 1: LuGre; 0: a plain tanh(v) law, to see what the law itself changes
}  # fmt: skip


def rows(count: int, **values) -> dict[str, np.ndarray]:
    """Parameters of `count` rows [B]: the defaults, with the given scalars or [B] arrays in place."""
    unknown = set(values) - set(DEFAULTS)
    if unknown:
        raise KeyError(f"the plant has no parameter {sorted(unknown)}")
    return {k: np.broadcast_to(np.asarray(values.get(k, v), float), (count,)).copy() for k, v in DEFAULTS.items()}


def simulate(p: dict[str, np.ndarray], command: np.ndarray, q0: np.ndarray | float = 0.0, driven: bool = True) -> dict[str, np.ndarray]:
    """Runs all rows. command [B, M]: the target in every millisecond; q0: the link's first angle [rad].

    Returns position (link) and motor torque, each [B, M], at the start of every millisecond.
    """
    B, M = command.shape
    q = np.broadcast_to(np.asarray(q0, float), (B,)).copy()
    motor, v, vm = q.copy(), np.zeros(B), np.zeros(B)
    z, rest = np.zeros(B), np.zeros(B)
    tau = np.zeros(B)
    link = p["mass"] * p["length"] ** 2 + p["link_inertia"]
    weight = p["mass"] * p["gravity"] * p["length"]
    reduced = link * p["rotor"] / (link + p["rotor"])
    spring = np.minimum(p["spring"], reduced / (16 * DT * DT))  # the mode stays slow beside the step
    loss = np.where(p["spring_loss"] > 0, p["spring_loss"], 0.6 * np.sqrt(spring * reduced))
    half = 0.5 * p["play"]
    strongest = p["coulomb"] + p["peak"] + p["dwell"] + 1e-6
    sigma0 = np.clip(strongest / 4e-4, 5.0, 0.05 * p["rotor"] / (DT * DT))
    sigma1 = 0.5 * np.sqrt(sigma0 * p["rotor"])
    delay = np.clip(np.round(p["delay"] / 1e-3).astype(int), 0, int(HISTORY / 1e-3))
    fraction = p["delay"] / 1e-3 - delay  # -0.5..0.5 of a millisecond, by mixing two targets
    rate = np.where(p["lag"] > 0, 1 - np.exp(-1e-3 / np.maximum(p["lag"], 1e-6)), 1.0)
    filtered, last, carried = np.zeros(B), q.copy(), np.zeros(B)
    has_dwell, tanh_law = bool(p["dwell"].any()), p["bristle"] < 0.5
    has_ripple = bool(p["ripple"].any())
    index = np.arange(B)
    out_q, out_tau = np.empty((B, M)), np.empty((B, M))
    unit = 2 * np.pi / 2**18  # the loop's own encoder
    for k in range(M):
        # firmware: reads its encoder, filters the speed, and asks for a torque that holds one millisecond
        seen = np.floor((p["scale"] * np.where(p["motor_side"] > 0.5, motor, q) + p["offset"]) / unit) * unit
        filtered += 0.8 * ((seen - last) / 1e-3 - filtered) if k else 0.0  # a slower filter would be a lag that nobody drew
        last = seen
        i = np.maximum(k - delay, 0)
        j = np.maximum(k - delay - np.sign(fraction).astype(int), 0)
        target = command[index, i] * (1 - np.abs(fraction)) + command[index, np.minimum(j, k)] * np.abs(fraction)
        error = target - seen
        ask = np.where(np.abs(error) < p["deadband"], 0.0, p["kp"] * error) - p["kd"] * filtered
        most = p["torque_limit"] * np.maximum(1 - np.abs(filtered) / p["no_load_speed"], 0.0)  # its own speed, not the true one
        ask = np.clip(ask, -most, most)
        tau = tau + rate * (ask - tau) if driven else np.zeros(B)
        out_q[:, k], out_tau[:, k] = q, tau
        if has_dwell:
            rest = np.where(np.abs(v) < 0.02, rest + 1e-3, np.maximum(rest - 0.02 * rest - 1e-3, 0.0))
            grown = p["dwell"] * (1 - np.exp(-rest / p["dwell_time"]))
        else:
            grown = 0.0
        for _ in range(LOOP):
            twist = motor - q
            deep = twist - np.clip(twist, -half, half)
            push = np.where(deep != 0, spring * deep + loss * (vm - v), 0.0)
            push = np.where(deep * push < 0, 0.0, push)  # a tooth cannot pull
            carried += 0.02 * (push - carried)
            speed = np.abs(vm)
            level = p["coulomb"] + p["peak"] * np.exp(-((speed / p["peak_speed"]) ** 2)) + grown
            level = level + np.where(carried * vm >= 0, p["load"], p["load_back"]) * np.abs(carried) + 1e-7
            # the bristle's own equation, taken implicitly: stable however fast it settles
            z_next = (z + vm * DT) / (1 + sigma0 * speed * DT / level)
            friction = sigma0 * z_next + sigma1 * np.exp(-((speed / 0.05) ** 2)) * (z_next - z) / DT
            z = z_next
            friction = np.where(tanh_law, level * np.tanh(vm / 0.01), friction)
            if has_ripple:
                friction = friction - p["ripple"] * np.sin(p["per_turn"] * motor + p["phase"])
            vm = (vm + DT * (tau - push - friction) / p["rotor"]) / (1 + DT * p["viscous"] / p["rotor"])
            pull = -weight * np.sin(q) - p["cable"] * (q - p["cable_rest"])
            v = v + DT * (push + pull) / link
            motor = motor + DT * vm
            q = q + DT * v
    return {"position": out_q, "torque": out_tau}


def log(signal: np.ndarray, rng: np.random.Generator, rate: float, jitter: float, loss: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Times [S] s and values [S] of one millisecond-sampled signal [M] as a host reads it: jittered, some samples lost."""
    period = 1.0 / rate
    n = int(len(signal) * 1e-3 / period) - 2
    t = (np.arange(n) + 0.5) * period + np.clip(rng.normal(0, jitter, n), -0.4 * period, 0.4 * period)
    t = t[rng.uniform(size=n) > loss]
    return t, np.interp(t, np.arange(len(signal)) * 1e-3, signal)
