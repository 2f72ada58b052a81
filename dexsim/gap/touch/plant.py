"""What the taxels of a pad should read: contact law, spread over the taxels, rubber, neighbours, gain, delay.

    depth -> force        stiffness * depth (what simulation believes), or a Mooney-Rivlin foundation under every taxel
    force -> taxels       by area and depth, as `dexsim.tactile` spreads the solver's force
    taxels -> readings    rubber (standard linear solid) -> neighbours -> gain -> delay, the order of
    `dexsim.tactile.measure` sliding -> shear      a bristle that slips where it exceeds friction times the normal force

Where a load cell was recorded, the sensor is simulated from its force (a stage with its recorded input), and the
contact law is judged by the cell alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from dexsim.gap.touch.read import SHIFT, PadRun
from dexsim.tactile import reference as ref

REACH, THICKNESS = 1e-3, 2e-3  # m: configs/tactile/default.yaml
SHEAR_STIFFNESS = 1.0e8  # N/m^3 of the skin along its surface (configs/tactile/default.yaml), where the fit starts


@dataclass(frozen=True)
class TouchParam:
    """One number that is fitted: neutral is where it is not there; scale: a change that matters."""

    key: str
    neutral: float
    low: float
    high: float
    unit: str
    scale: float
    nuisance: bool = False


PARAMS: dict[str, TouchParam] = {
    p.key: p
    for p in (
        TouchParam("stiffness", 1.0, 0.1, 10.0, "N/m", 0.1),  # factor on what is believed
        TouchParam("c10", 0.0, 0.0, 4e5, "Pa", 2e4),
        TouchParam("c01", 0.0, 0.0, 4e5, "Pa", 2e4),
        TouchParam("gain", 1.0, 0.05, 10.0, "1", 0.1),
        TouchParam("fraction", 0.0, 0.0, 3.0, "1", 0.1),
        TouchParam("time_constant", 0.3, 0.01, 30.0, "s", 0.2),
        TouchParam("neighbours", 0.0, 0.0, 0.8, "1", 0.1),
        TouchParam("delay", 0.0, 0.0, 0.25, "s", 0.01),
        TouchParam("drift", 0.0, -0.05, 0.05, "1/degC", 0.005),
        TouchParam("mu", 1.0, 0.1, 5.0, "1", 0.1),  # factor on what is believed
        # refitted with every hypothesis
        TouchParam("scale", 1.0, 0.95, 1.05, "1", 0.03, True),
        TouchParam("zero", 0.0, -1.5e-4, 1.5e-4, "m", 5e-5, True),
        TouchParam("along", 0.0, -6e-4, 6e-4, "m", 2e-4, True),
        TouchParam("across", 0.0, -6e-4, 6e-4, "m", 2e-4, True),
        TouchParam(
            "spread", 1.0, 0.6, 1.6, "1", 0.1, True
        ),  # factor on REACH: how a force spreads over the taxels is a model's guess
        TouchParam("clock", 0.0, -0.006, 0.006, "s", 0.004, True),
        TouchParam("skin", 1.0, 0.01, 100.0, "1", 0.5, True),  # factor on SHEAR_STIFFNESS
    )
}


def neutral() -> dict[str, float]:
    """Return what is believed: every effect absent."""
    return {k: p.neutral for k, p in PARAMS.items()}


CONTACT_KEYS = ("zero", "along", "across", "stiffness", "c10", "c01", "spread")
REMEMBERED = 16  # contacts a recording: most numbers of a fit do not change it


def contact(run: PadRun, v: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return (normal force [G] N by the contact law, share of each taxel [G, K]); shares are 0 where nothing
    touches."""
    key = tuple(v[k] for k in CONTACT_KEYS) + (run.load is None,)
    if key not in run.memory:
        if len(run.memory) >= REMEMBERED:
            run.memory.pop(next(iter(run.memory)))
        near = run.near
        force, share = np.zeros(len(run.grid)), np.zeros(run.dist.shape)
        force[near], share[near] = _contact(run, v, near)
        run.memory[key] = force, share
    return run.memory[key]


def _contact(run: PadRun, v: dict[str, float], near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = run.dist[near]
    d = d - v["zero"] + (run.along[near] - d) * (v["along"] / SHIFT) + (run.across[near] - d) * (v["across"] / SHIFT)
    rubber = v["c10"] + v["c01"] > 0
    if rubber:
        w = ref.mooney_rivlin_force(np.maximum(-d, 0.0), run.area, THICKNESS, v["c10"], v["c01"])
        total = w.sum(1)
        force = total * v["stiffness"]
    else:
        force = run.stiffness * v["stiffness"] * np.maximum(run.depth[near] + v["zero"], 0.0)
    if not rubber or run.load is not None:
        level = np.maximum(d.min(1) + v["spread"] * REACH, 0.0)
        soft = run.area * np.maximum(level[:, None] - d, 0.0) ** 2
        if rubber:  # where the cell says there is force but the foundation is not reached yet
            w = np.where(total[:, None] > 0, w, soft)
        else:
            w = soft
        total = w.sum(1)
    touching = (force > 0) if run.load is None else (run.load[near] > 0)
    share = np.where(touching[:, None] & (total[:, None] > 0), w / np.maximum(total, 1e-30)[:, None], 0.0)
    return force, share


def relaxed(x: np.ndarray, dt: float, fraction: float, time_constant: float) -> np.ndarray:
    """Return standard linear solid along the first axis: x + fraction (x - state), the state following x
    (`tactile.measure`)."""
    if fraction == 0.0:
        return x
    a = float(np.exp(-dt / max(time_constant, 1e-4)))
    state = lfilter([1 - a], [1, -a], x, axis=0)
    return np.maximum(x + fraction * (x - state), 0.0)


def readings(
    run: PadRun, v: dict[str, float], gains: np.ndarray | None = None, order: np.ndarray | None = None
) -> np.ndarray:
    """Return [S, K] N that the taxels read at the recording's touch times. gains [K]: of each taxel; order [K]: which
    taxel's place each reading comes from."""
    force, share = contact(run, v)
    x = share * (force if run.load is None else run.load)[:, None]
    dt = run.grid[1] - run.grid[0]
    x = relaxed(x, dt, v["fraction"], v["time_constant"])
    if v["neighbours"]:
        x = (1 - v["neighbours"]) * x + v["neighbours"] * (x @ run.mixing.T)
    if order is not None:
        x = x[:, order]
    x = x * (v["gain"] * v["scale"] * (1 + v["drift"] * run.warm))[:, None]
    if gains is not None:
        x = x * gains
    at = (run.t - v["delay"] - v["clock"] - run.grid[0]) / dt
    i = np.clip(np.floor(at).astype(int), 0, len(x) - 2)
    part = np.clip(at - i, 0.0, 1.0)[:, None]
    out = x[i] * (1 - part) + x[i + 1] * part
    return np.minimum(out, 255 * run.lsb) if run.lsb else out


def shear(run: PadRun, v: dict[str, float]) -> np.ndarray:
    """Return [S, 2] N of the skin's tangential force along the recorded sliding: a bristle at every taxel that slips
    where it exceeds friction times the normal force that the taxel read. Taxels with little to read slip first, so a
    pad does not slip at once."""
    live = run.pressed.any(0)
    force = np.where(run.pressed, run.z, 0.0)[:, live]
    k = (SHEAR_STIFFNESS * v["skin"] * run.area[live])[:, None]
    path = np.stack([np.interp(run.t, run.grid, run.slide[:, i]) for i in (0, 1)], 1)
    step = np.diff(path, axis=0, prepend=path[:1])
    cap = run.friction * v["mu"] * force
    out = np.zeros_like(path)
    now = np.zeros((int(live.sum()), 2))
    for i in np.flatnonzero(force.any(1)):
        if i == 0 or not force[i - 1].any():
            now[:] = 0.0
        now += k * step[i]
        size = np.sqrt(now[:, 0] ** 2 + now[:, 1] ** 2)
        now *= (np.minimum(cap[i], size) / np.maximum(size, 1e-12))[:, None]
        out[i] = now.sum(0)
    return out


def cell(run: PadRun, v: dict[str, float]) -> np.ndarray:
    """Return [G] N that the load cell should read."""
    return contact(run, v)[0]
