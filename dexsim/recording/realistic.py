"""What the hand's bus and registers make of a simulated recording: rate, jitter, quantisation, dropped samples.

Figures of the xHand over RS485 (vendor's message layout; round trips measured by users): 83 to 104 readings a second,
12-bit position, current in whole milliamperes (positive opens the hand), taxels of int8, int8, uint8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dexsim.recording.schema import Recording, Series, States

CURRENT_PER_TORQUE = 2.7
"""A per N.m where the servo table does not know it: 170 mA read from a finger joint at a standing error of 15.6
mrad, which is 0.062 N.m with the table's kp of 4 N.m/rad. A stand-in until calibration measures it."""


@dataclass(frozen=True)
class Hardware:
    """The readings. rates [Hz]: range from which a recording's rate is drawn; jitter: standard deviation of a period
    over the period; late: share of readings delayed by `late_s` on average; drop: share that is lost; position_lsb
    [rad, or rad and m by joint]; current_lsb [A]; taxel_lsb [N]; axis_sign: the vendor's taxel axes over ours."""

    rates: tuple[float, float] = (83.0, 104.0)
    jitter: float = 0.01
    late: float = 0.005
    late_s: float = 0.002
    drop: float = 0.005
    position_lsb: float | np.ndarray = 2 * np.pi / 4096
    current_lsb: float = 1e-3
    current_sign: int = -1
    taxel_lsb: float = 0.1
    axis_sign: tuple[int, int, int] = (-1, -1, 1)


def sample_times(start: float, end: float, rng: np.random.Generator, hardware: Hardware = Hardware()) -> np.ndarray:
    """Times [T] s of the readings that arrive, between start and end."""
    period = 1.0 / rng.uniform(*hardware.rates)
    count = int((end - start) / period * 1.2) + 2
    steps = period * np.clip(1 + hardware.jitter * rng.standard_normal(count), 0.7, 1.3)
    steps += (rng.random(count) < hardware.late) * rng.exponential(hardware.late_s, count)
    t = start + rng.uniform(0, period) + np.cumsum(steps)
    return t[(t < end) & (rng.random(count) >= hardware.drop)]


def realistic(
    recording: Recording,
    seed: int = 0,
    current_per_torque: np.ndarray | float | None = None,
    hardware: Hardware = Hardware(),
) -> Recording:
    """Return the recording as the hardware would have delivered it; the given one (dense, in N.m and N) is not changed.

    current_per_torque: A per N.m, [J] or one value; NaN or None: `CURRENT_PER_TORQUE`, said in the notes. Commands
    stay: the host knows what it sent. Speeds are left out, as by the vendor's driver. No latency is added.
    """
    rng = np.random.default_rng(seed)
    q = recording.states.position
    t = sample_times(float(q.t[0]), float(q.t[-1]), rng, hardware)
    meta, notes = dict(recording.meta), [recording.meta.get("notes", "")]
    position = Series(t, q.at(t), q.topic, t.copy())
    position.value = np.round(position.value / hardware.position_lsb) * hardware.position_lsb
    effort = None
    if (dense := recording.states.effort) is not None:
        effort = Series(t, dense.at(t), dense.topic, t.copy())
        value = effort.value * recording.effort_sign
        if recording.effort_is == "torque_Nm":
            scale = np.asarray(np.nan if current_per_torque is None else current_per_torque, float)
            if scale.ndim:  # joints without a drive come last, and have no current
                scale = np.append(scale, np.ones(value.shape[1] - len(scale)))
            scale = np.broadcast_to(scale, value.shape[1:])
            if np.isnan(scale).any():
                notes.append(f"current_per_torque unknown: {CURRENT_PER_TORQUE} A per N.m assumed")
            value = value * np.where(np.isnan(scale), CURRENT_PER_TORQUE, scale)
        effort.value = np.round(hardware.current_sign * value / hardware.current_lsb) * hardware.current_lsb
        meta |= {"effort_is": "current_A", "effort_sign": f"{hardware.current_sign:+d}"}
    out = replace(recording, states=States(position, None, effort), meta=meta)
    newtons = recording.tactile_newtons()
    if newtons is not None:
        held = newtons.latest(t)
        counts = np.round(held.value * np.array(hardware.axis_sign) / hardware.taxel_lsb)
        held.value = np.clip(counts, [-128, -128, 0], [127, 127, 255])
        out.tactile = held
        meta |= {
            "tactile_unit": "count",
            "tactile_lsb": f"{hardware.taxel_lsb:g}",
            "tactile_axis_sign": ",".join(f"{s:+d}" for s in hardware.axis_sign),
        }
    notes.append(f"sampled like the hardware (seed {seed})")
    meta["notes"] = "; ".join(n for n in notes if n)
    for name in ("temperature", "duty", "enabled", "supply_voltage"):
        if (series := getattr(recording, name)) is not None:
            setattr(out, name, series.latest(t))
    return out
