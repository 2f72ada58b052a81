"""Recorded against simulated: errors joint by joint, and plots side by side."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402  (pyplot would keep every figure alive)

from dexsim import files  # noqa: E402
from dexsim.recording.mechanism import Mechanism, Run  # noqa: E402
from dexsim.recording.schema import Recording, Series  # noqa: E402

COLOURS = {"recorded": "#1f5fa8", "simulated": "#d1641b", "command": "#9a9a9a"}


@dataclass
class Comparison:
    """A recording beside its simulation at the recording's own times. Arrays [T, J], NaN where not recorded.

    effort is in N.m: a recorded current is divided by the A per N.m that is known (`effort_scale` [J]) or, where
    none is (`fitted` [J] bool), by the one that fits best here. finger_force, finger_force_simulated: (t, [T, F]) or
    None; force_unit: N or count; fingers: their names, none where the model is no hand. own [T, J] bool:
    positions that count, which do not repeat an old reading (None: all).
    """

    joints: tuple[str, ...]
    t: np.ndarray
    target: np.ndarray
    position: np.ndarray
    position_simulated: np.ndarray
    effort: np.ndarray | None
    effort_simulated: np.ndarray
    effort_scale: np.ndarray
    fitted: np.ndarray
    finger_force: tuple[np.ndarray, np.ndarray] | None = None
    finger_force_simulated: tuple[np.ndarray, np.ndarray] | None = None
    force_unit: str = "N"
    fingers: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)
    own: np.ndarray | None = None

    @property
    def missed(self) -> np.ndarray:
        """Position less its simulation [T, J] rad; NaN where nothing counts."""
        off = self.position - self.position_simulated
        return off if self.own is None else np.where(self.own, off, np.nan)

    def position_rmse(self) -> np.ndarray:
        """Return [J] rad."""
        return (
            np.sqrt(np.nanmean(self.missed**2, axis=0))
            if len(self.t)
            else np.full(len(self.joints), np.nan)
        )

    def effort_rmse(self) -> np.ndarray:
        """Return [J] N.m; NaN where no effort was recorded."""
        if self.effort is None:
            return np.full(len(self.joints), np.nan)
        d = self.effort - self.effort_simulated
        count = np.isfinite(d).sum(0)
        return np.where(count > 0, np.sqrt(np.nansum(d**2, axis=0) / np.maximum(count, 1)), np.nan)


def compare(recording: Recording, run: Run, m: Mechanism, forces: bool = False) -> Comparison:
    """Lay the run beside the recording; what was recorded outside its time is left out. forces: run.pair_normal holds
    one fingertip a column."""
    columns = [m.joints.index(j) for j in recording.joints]
    state, J = recording.states.position, len(recording.joints)
    inside = (state.t >= run.t[0] - 1e-9) & (state.t <= run.t[-1] + 1e-9) if len(state) else slice(None)
    state = Series(state.t[inside], state.value[inside]) if len(state) else state
    t = state.t if len(state) else run.t

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, run.t, values[:, c]) for c in columns], 1)

    held = np.clip(np.searchsorted(run.t, t, side="right") - 1, 0, None)
    position = state.value if len(state) else np.full((len(t), J), np.nan)
    simulated = at(run.torque)
    signed = recording.signed_effort()
    effort, scale, fitted = None, np.ones(J), np.zeros(J, bool)
    if signed is not None and recording.effort_is != "none":
        effort = signed.value[inside]
        if recording.effort_is == "current_A":
            scale = m.table.current(recording.joints)
            fitted = np.isnan(scale)
            for j in np.flatnonzero(fitted):
                ok = np.isfinite(effort[:, j])
                power = float((simulated[ok, j] ** 2).sum())
                scale[j] = float((effort[ok, j] * simulated[ok, j]).sum()) / power if power > 0 else np.nan
            effort = effort / np.where(scale == 0, np.nan, scale)
    out = Comparison(
        recording.joints, t, run.target[held][:, columns], position, at(run.position), effort, simulated, scale, fitted
    )
    out.fingers = m.hand.finger_names if m.hand is not None else ()
    if recording.tactile is not None:
        known = recording.tactile_lsb is not None
        newtons = recording.tactile_newtons() if known else None
        touch = recording.tactile if newtons is None else newtons
        out.finger_force = (touch.t, touch.value[..., 2].sum(2))
        out.force_unit = "N" if known else "count"
    if forces:
        frames = run.t[0] + run.frame_s * np.arange(1, len(run.pair_normal) + 1)
        out.finger_force_simulated = (frames, run.pair_normal)
    return out


def plots(c: Comparison, folder: Path, title: str) -> list[Path]:
    """Return position.png, effort.png and, where touch was recorded or simulated, force.png: one panel a joint or
    finger."""
    unit = [
        f"{s:.2f} A per N.m{' (fitted)' if f else ''}" if s != 1 else ""
        for s, f in zip(c.effort_scale, c.fitted, strict=True)
    ]
    lines = [("command", c.t, c.target), ("recorded", c.t, c.position), ("simulated", c.t, c.position_simulated)]
    off = [f"RMSE {1e3 * x:.2f} mrad" for x in c.position_rmse()]
    paths = [_panels(folder / "position.png", f"{title}: position [rad]", c.joints, lines, off)]
    lines = [("recorded", c.t, c.effort)] if c.effort is not None else []
    lines += [("simulated", c.t, c.effort_simulated)]
    paths.append(_panels(folder / "effort.png", f"{title}: motor torque [N.m]", c.joints, lines, unit))
    forces = {"recorded": c.finger_force, "simulated": c.finger_force_simulated}
    if lines := [(name, *x) for name, x in forces.items() if x is not None]:
        count = max(value.shape[1] for _, _, value in lines)
        names = c.fingers if count == len(c.fingers) else tuple(f"pad {k}" for k in range(count))
        of = f"{title}: normal force of each finger [{c.force_unit}]"
        paths.append(_panels(folder / "force.png", of, names, lines, [""] * count))
    return paths


def _panels(path: Path, title: str, names: tuple[str, ...], lines: list, notes: list[str]) -> Path:
    """Draw a panel a name; lines: (label, t [T] s, value [T, len(names)])."""
    figure, axes = _grid(len(names))
    for j, (ax, name) in enumerate(zip(axes, names, strict=False)):
        for label, t, value in lines:
            ax.plot(t, value[:, j], color=COLOURS[label], linewidth=0.9, label=label)
        ax.set_title(f"{name}  {notes[j]}", fontsize=8)
    _finish(figure, axes, len(names), title, path)
    return path


def _grid(count: int) -> tuple[Figure, list]:
    across = min(3, count)
    down = -(-count // across)
    width, height = 4.6 * across, 2.3 * down + 0.6  # inches; margins by hand: a layout engine doubles the time
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(0.5 / width, 0.5 / height, 1 - 0.12 / width, 1 - 0.6 / height, wspace=0.16, hspace=0.3)
    return figure, list(figure.subplots(down, across, squeeze=False).flat)


def _finish(figure: Figure, axes: list, count: int, title: str, path: Path) -> None:
    for ax in axes[:count]:
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.25)
    for ax in axes[count:]:
        ax.set_axis_off()
    for ax in axes[max(0, count - 3) : count]:
        ax.set_xlabel("time [s]", fontsize=8)
    axes[0].legend(fontsize=7)
    figure.suptitle(title, fontsize=10, y=1 - 0.1 / figure.get_figheight(), va="top")
    files.picture(figure, path, dpi=110)
