"""Plots of every fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dexsim import files
from dexsim.calibration.current import Half
from dexsim.calibration.rubber import Rubber, Stiffness, stress
from dexsim.calibration.taxels import Pad
from dexsim.view import plots


def lines(half: Half, path: Path, title: str) -> Path:
    """Force over effort of every joint: loading, unloading, the line and the paper's line through zero."""
    margins = 0.65, 0.5, 0.2, 0.65
    figure, axes = plots.grid(len(half.joints), 4, (3.5, 3.0), margins, title, 0.12, wspace=0.28, hspace=0.36)
    for ax, joint in zip(axes, half.joints, strict=True):
        ax.set_title(joint, fontsize=9)
        levels, f = half.levels.get(joint), half.fits.get(joint)
        if levels is None or f is None:  # what is fitted has levels
            ax.text(
                0.5, 0.5, half.left_out.get(joint, ""), ha="center", va="center", fontsize=7, wrap=True,
                transform=ax.transAxes,
            )  # fmt: skip
            continue
        for way, name, mark in ((True, "loading", "o"), (False, "unloading", "s")):
            m = levels.up == way
            ax.plot(levels.effort[m], levels.force[m], mark, ms=4, label=name, fillstyle="full" if way else "none")
        x = np.array([min(0, levels.effort.min()), levels.effort.max()])
        ax.plot(x, f.slope * x + f.offset, lw=1, label=f"{f.slope:.3g} x {f.offset:+.2f}")
        ax.plot(x, f.ratio * x, "--", lw=0.8, label=f"{f.ratio:.3g} x")
        text = f"R2 {f.r2:.4f}\nheld out {f.held_out:.2f} N\nhysteresis {100 * f.hysteresis:.0f} %" + (
            "" if f.linear else "\nnot linear"
        )
        color = "black" if f.linear else "tab:red"
        ax.text(0.97, 0.04, text, ha="right", va="bottom", fontsize=7, transform=ax.transAxes, color=color)
        ax.legend(fontsize=6, loc="upper left")
        ax.set_xlabel(half.unit, fontsize=8)
        ax.set_ylabel("N", fontsize=8)
        ax.grid(alpha=0.25)
    files.picture(figure, path, dpi=110)
    return path


def rubber(stretch: np.ndarray, nominal: np.ndarray, fit: Rubber, path: Path) -> Path:
    """Return the stress over stretch with the Mooney-Rivlin fit."""
    x = np.linspace(*fit.stretch, 200)
    label = f"c10 {fit.c10 / 1e3:.1f} kPa, c01 {fit.c01 / 1e3:.1f} kPa, held out {fit.held_out / 1e3:.1f} kPa"
    line = x, 1e-6 * stress(x, fit.c10, fit.c01), label
    return _fitted((stretch, 1e-6 * nominal), line, "o", "stretch", "nominal stress, MPa", path)


def press(depth: np.ndarray, force: np.ndarray, fit: Stiffness, path: Path) -> Path:
    """Force over depth with the linear stiffness."""
    label, most = f"{fit.value:.0f} N/m, held out {fit.held_out:.2f} N", depth.max()
    line = [0, 1e3 * most], [0, fit.value * most], label
    return _fitted((1e3 * depth, force), line, ".-", "depth, mm", "force, N", path)


def _fitted(measured: tuple, line: tuple, mark: str, across: str, up: str, path: Path) -> Path:
    """Draw points (x, y) and what was fitted to them (x, y, label)."""
    figure = Figure(figsize=(7, 4.6), layout="constrained")
    ax = figure.subplots()
    ax.plot(*measured, mark, ms=4, lw=0.6, label="measured")
    ax.plot(*line[:2], label=line[2])
    ax.set(xlabel=across, ylabel=up)
    ax.legend()
    ax.grid(alpha=0.25)
    files.picture(figure, path, dpi=120)
    return path


def pads(found: dict[str, Pad], path: Path) -> Path:
    """Return gain maps of the pads, dead and swapped taxels marked; columns across, rows from the joint to the tip."""
    figure = Figure(figsize=(3.2 * len(found), 4.2), layout="constrained")
    for ax, (finger, pad) in zip(np.atleast_1d(figure.subplots(1, len(found))), found.items(), strict=True):
        gain = np.ones(len(pad.bias)) if pad.gain is None else pad.gain.copy()
        gain[pad.unseen] = np.nan
        image = ax.imshow(gain.reshape(-1, pad.rows).T, origin="lower", vmin=0, vmax=2, cmap="coolwarm")
        for k in pad.dead:
            ax.text(*divmod(k, pad.rows), "x", ha="center", va="center", color="black")
        for n, pair in enumerate(pad.swapped):
            for k in pair:
                ax.text(*divmod(k, pad.rows), chr(ord("a") + n % 26), ha="center", va="center", color="black")
        ax.set_title(
            f"{finger}: held out {100 * pad.held_out:.1f} % ({100 * pad.held_out_equal:.1f} % equal gains)", fontsize=7
        )
        ax.set(xlabel="column", ylabel="row")
    figure.colorbar(image, ax=figure.axes, shrink=0.6, label="gain (x dead, letters swapped)")
    files.picture(figure, path, dpi=110)
    return path
