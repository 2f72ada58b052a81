"""Errors on what was kept out of the fit, the floor, the regime and the samples of an effect, the verdict."""

from __future__ import annotations

import numpy as np

from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import REFERENCE, Case
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read.runs import Run, same_commands
from dexsim.gap.search.fit import Param, expand

FAR = 5.0  # x the floor: an error before that large is not nothing, though only a few moments show it
UNDERWAY = 0.1  # of a joint's speed: a recording that begins with as much begins in motion, and its
FIRST = 0.1  # s tell where and how fast: within
START_NOISE, START_SPEED = 10.0, 0.2  # x the noise, and of a joint's speed, of what the samples about its first say
SURE_ENOUGH = 0.75  # confidence of at least one name, or a set, without which nothing counts as explained


def floor(runs: list[Run], cases: list[Case]) -> tuple[float, str]:
    """(noise floor of the position error, how): from repeats of the same commands, else from split samples, else from
    the encoder's quantum. Root mean square over joints."""
    sums, count = 0.0, 0
    for i, a in enumerate(runs):
        for b in runs[i + 1 :]:
            if a.name == b.name or not same_commands(a, b):  # pieces of one recording are aligned only by where they were cut
                continue
            t = np.arange(0.2, min(a.duration, b.duration) - 0.05, 0.01)
            # repeats are aligned by their commands, which were sent at the same times from the start
            for j, joint in enumerate(a.joints):
                if joint in a.left_out | b.left_out:
                    continue
                d = np.interp(a.t[0] + t, a.t, a.q[:, j]) - np.interp(b.t[0] + t, b.t, b.q[:, j])
                sums, count = sums + float((d**2).sum()) / 2.0, count + len(t)
    split = float(np.sqrt(np.mean([c.sigma**2 for c in cases])))
    quantum = float(np.sqrt(np.mean([c.quantum**2 for c in cases]))) / np.sqrt(12)
    if count:
        return max(float(np.sqrt(sums / count)), split), "repeats"
    return split, "quantum" if split <= 1.02 * quantum else "split"


def free_run(case: Case, params: list[Param], x: np.ndarray, windows: Windows, fixed=(), underway: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Simulated position and motor torque [n] at the windows' samples, from their first sample on without correction.

    underway: the position at which a window begins in motion, and its speed there, are fitted to its first `FIRST` seconds: what a few
    samples on one side say of a speed is off by far where a target has just jumped."""
    plants = expand(case.plant, params, x[None])
    for name, value in fixed:
        plants[:, :, INDEX[name]] = value
    q, tau = _begun(case, plants, windows) if underway else case.plant.simulate(plants, windows)
    return q[0], plants[0, 0, INDEX["effort_gain"]] * tau[0] + plants[0, 0, INDEX["effort_offset"]]


def _begun(case: Case, plants: np.ndarray, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Position and torque [1, n] of one guess [1, R, C], windows that begin in motion from where their first samples say they did."""
    sigma, window, t = case.sigma, windows.sample_window, case.plant.t[windows.sample_row]
    first = np.flatnonzero(np.r_[True, np.diff(window) != 0]) if len(window) else np.zeros(0, int)
    moving = np.abs(case.regimes["_speed"][windows.sample_row[first]]) > UNDERWAY * case.scales.speed
    if not moving.any():
        return case.plant.simulate(plants, windows)
    size = np.array([START_NOISE * sigma, START_SPEED * case.scales.speed])
    q, tau = case.plant.simulate(np.repeat(plants, 3, 0), windows, np.array([[0.0, 0.0], [size[0], 0.0], [0.0, size[1]]]))
    slope, measured, which = q[1:] - q[0], case.plant.q[windows.sample_row], np.flatnonzero(moving)
    starts = []
    for k in which:
        early = (window == window[first[k]]) & (t < t[first[k]] + FIRST)
        A = np.concatenate([slope[:, early].T / sigma, np.eye(2)])
        starts.append(size * np.linalg.lstsq(A, np.r_[(measured - q[0])[early] / sigma, 0.0, 0.0], rcond=None)[0])
    again = case.plant.simulate(np.repeat(plants, len(which), 0), windows, np.array(starts))
    for i, k in enumerate(which):
        mine = window == window[first[k]]
        q[0, mine], tau[0, mine] = again[0][i, mine], again[1][i, mine]
    return q[:1], tau[:1]


def rms_interval(squares: list[np.ndarray], times: list[np.ndarray], seed: int = 0, block: float = 0.5) -> tuple[float, float, float]:
    """(rms, low, high): 90 % by a bootstrap over half-second blocks of squared errors, drawn alike for all joints."""
    rng = np.random.default_rng(seed)
    sums, counts = [], []
    for s, t in zip(squares, times, strict=True):
        b = ((t - t[0]) / block).astype(int) if len(t) else np.zeros(0, int)
        if len(b):
            sums.append(np.bincount(b, s))
            counts.append(np.bincount(b))
    if not sums:
        return 0.0, 0.0, 0.0
    sums, counts = np.concatenate(sums), np.concatenate(counts)
    sums, counts = sums[counts > 0], counts[counts > 0]
    n = len(sums)
    pick = rng.integers(0, n, (400, n))
    values = np.sqrt(sums[pick].sum(1) / counts[pick].sum(1))
    return float(np.sqrt(sums.sum() / counts.sum())), float(np.quantile(values, 0.05)), float(np.quantile(values, 0.95))


def own_signal(effect: str, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
    """[n] how strongly the effect acts at each measured sample (its own torque, or the signal it changes)."""
    m = case.regimes
    v, a, load, e = m["speed"], m["acceleration"], m["load"], m["position error"]
    s = case.scales
    small = 0.02 * s.speed
    tau = np.abs(m["_torque"])
    if effect == "coulomb_friction":
        return (v > small).astype(float)
    if effect == "stribeck_friction":
        return np.exp(-((v / max(values.get("v_s", 0.1 * s.speed), 1e-6)) ** 2)) * ((v > 0.2 * small) | (tau > 0))
    moving = (v > small).astype(float)
    if effect == "viscous_friction":
        return v
    if effect == "command_delay":
        return np.abs(m["_command_rate"])
    if effect == "lag":
        return np.abs(m["_torque_rate"]) if note.get("of", "drive") == "drive" else a
    if effect == "load_friction":
        return np.abs(m["_load"]) * moving
    if effect == "backlash":
        return _near_sign_change(case, m["_load"] + m["_friction"], 0.04)
    if effect == "compliance":
        return load
    if effect == "torque_limit":
        return _lost(s, m, values.get("torque", s.demand), s.nominal["no_load_speed"])
    if effect == "torque_speed_limit":
        return _lost(s, m, s.nominal["torque_limit"], values.get("no_load_speed", s.peak_speed))
    if effect == "torque_ripple":
        return np.abs(np.sin(values.get("per_turn", 1) * m["position"] + values.get("phase", 0.0)))
    if effect == "thermal":
        warm = np.abs(m["temperature"] - REFERENCE) if "temperature" in m else m["time"]
        return warm * (moving if note.get("of") == "friction" else tau)
    if effect == "joint_coupling":
        k = list(s.others).index(note["from_joint"]) if note.get("from_joint") in s.others else 0
        return np.abs(m.get(f"_drag{k}", v))
    if effect == "supply_sag":
        return m.get("_others", v)
    if effect == "payload":
        return np.abs(m["_added_own" if note.get("own") else "_added"] if "mass" in values else m["_gravity"])
    if effect == "position_scale":
        if "scale" in values:
            return np.abs(m["position"])
        return np.abs(values.get("ecc_sin", 0.0) * np.sin(m["position"]) + values.get("ecc_cos", 0.0) * (np.cos(m["position"]) - 1))
    if effect == "inertia":
        return a
    if effect == "gain_mismatch":  # the torque that the other gains make more or less
        more = (values.get("kp_factor", 1.0) - 1) * s.nominal["kp"] * m["_error"] - (values.get("kd_factor", 1.0) - 1) * s.nominal["kd"] * m["_speed"]
        return np.abs(more)
    if effect == "deadband":
        return (e < values.get("width", 0.0)).astype(float)
    if effect == "current_sensor":
        return np.abs((values.get("gain", 1.0) - 1) * m["_torque"] + values.get("offset", 0.0))
    return np.ones_like(v)


def _lost(s, m: dict[str, np.ndarray], limit: float, no_load_speed: float) -> np.ndarray:
    """[n] torque that the drive would give by its believed limits and does not give by these."""
    asked, v = m["_asked"], m["_speed"]

    def give(most: float, fastest: float) -> np.ndarray:
        most = min(most, 1e9)
        if s.voltage:
            return most * (np.clip(asked, -1, 1) - v / fastest)
        edge = most * np.maximum(1 - np.abs(v) / fastest, 0)
        return np.clip(asked, -edge, edge)

    return np.abs(give(s.nominal["torque_limit"], s.nominal["no_load_speed"]) - give(limit, no_load_speed))


def _near_sign_change(case: Case, x: np.ndarray, seconds: float) -> np.ndarray:
    t, run = case.plant.t, case.plant.run_of
    out = np.zeros(len(t))
    change = np.flatnonzero((np.sign(x[1:]) != np.sign(x[:-1])) & (run[1:] == run[:-1]))
    for i in change:
        j = np.searchsorted(t[case.plant.rows(int(run[i]))], [t[i] - 0.25 * seconds, t[i] + 0.75 * seconds]) + case.plant.rows(int(run[i])).start
        out[j[0] : j[1] + 1] = 1.0
    return out


def intervals_of(active: np.ndarray, case: Case, runs: list[Run], use: list[int], join: float = 0.03) -> list[dict]:
    """Stretches of time in which `active` [n] bool holds, by recording, short gaps joined; the longest 400."""
    out = []
    for r in use:
        rows = case.plant.rows(r)
        t, on = case.plant.t[rows], active[rows]
        if not on.any():
            continue
        edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
        step = float(np.median(np.diff(t)))
        start, end = t[edge[::2]], t[edge[1::2] - 1] + step
        merged = [[start[0], end[0]]]
        for a, b in zip(start[1:], end[1:], strict=True):
            if a - merged[-1][1] < join:
                merged[-1][1] = b
            else:
                merged.append([a, b])
        out += [{"recording": runs[r].name, "start": round(float(a), 4), "end": round(float(b), 4)} for a, b in merged]
    out.sort(key=lambda w: w["start"] - w["end"])
    out = out[:400]
    return sorted(out, key=lambda w: (w["recording"], w["start"]))


def verdict(findings: list[dict], floor_: float, before: float, before_low: float, after: float, structured: bool, far: float = np.inf) -> str:
    """The one word. Where every name is doubtful and none stands for a set, an error that is gone is not yet explained; an error
    before beyond `far` x the floor is unknown even where it lies in too few moments to be sure of."""
    named = [f for f in findings if f["held_out"]]
    if not named:
        if before <= far * floor_ and (before_low <= 1.3 * floor_ or not structured):
            return "none"
        return "unknown"
    if after <= 1.3 * floor_ and any(f.get("confidence", 1.0) >= SURE_ENOUGH or f.get("indistinguishable") for f in named):
        return "explained"
    gap = max(before - floor_, 1e-12)
    if after <= 1.3 * floor_ or (before - after) / gap >= 0.3:
        return "partly_explained"
    return "unknown"
