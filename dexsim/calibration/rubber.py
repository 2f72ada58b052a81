"""Stiffness of the fingertips' rubber from a force-depth or stress-stretch curve.

Mooney-Rivlin, incompressible, uniaxial (Mooney 1940, Rivlin 1948): nominal stress P = 2 (l - l^-2) (c10 + c01 / l) at
stretch l; linear in c10 and c01. In compression (l < 1) it is the foundation law of `dexsim.tactile` (law:
mooney_rivlin).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexsim import files
from dexsim.errors import UserError

TRELOAR_1944 = np.array([
    [1.000, 0.00], [1.020, 0.26], [1.125, 1.37], [1.240, 2.30], [1.390, 3.23], [1.585, 4.16], [1.900, 5.10],
    [2.180, 6.00],
    [2.420, 6.90], [3.020, 8.80], [3.570, 10.7], [4.030, 12.5], [4.760, 16.2], [5.360, 19.9], [5.750, 23.6],
    [6.150, 27.4],
    [6.400, 31.0], [6.600, 34.8], [6.850, 38.5], [7.050, 42.1], [7.150, 45.8], [7.250, 49.6], [7.400, 53.3],
    [7.500, 57.0],
    [7.600, 64.4],
]) * [1.0, 98066.5]  # fmt: skip
"""Stretch and nominal stress [Pa] of 8 % sulphur rubber in simple elongation: L. R. G. Treloar, "Stress-strain data for
vulcanised rubber under various types of deformation", Trans. Faraday Soc. 40 (1944) 59-70, there in kg/cm2, as its
figure is commonly digitised."""


@dataclass
class Rubber:
    """c10, c01 [Pa] with 95 % intervals (low, high), R2, rms of the residuals [Pa], held-out rms [Pa], shear modulus
    2 (c10 + c01) [Pa]; range of stretch that was fitted."""

    c10: float
    c01: float
    c10_range: tuple[float, float]
    c01_range: tuple[float, float]
    r2: float
    rms: float
    held_out: float
    stretch: tuple[float, float]

    @property
    def shear_modulus(self) -> float:
        return 2 * (self.c10 + self.c01)


def stress(stretch: np.ndarray, c10: float, c01: float) -> np.ndarray:
    """Return the nominal stress [Pa], positive in tension."""
    return 2 * (stretch - stretch**-2.0) * (c10 + c01 / stretch)


def fit_mooney_rivlin(stretch: np.ndarray, nominal: np.ndarray) -> Rubber:
    """Return least squares over points of (stretch, nominal stress [Pa]); points at stretch 1 say nothing and are
    left out.

    Raises UserError for fewer than 4 points or a range too narrow to tell the two constants apart.
    """
    stretch, nominal = np.asarray(stretch, float), np.asarray(nominal, float)
    keep = np.isfinite(stretch) & np.isfinite(nominal) & (stretch > 0.05) & (np.abs(stretch - 1) > 1e-4)
    x, y = stretch[keep], nominal[keep]
    if len(x) < 4:
        raise UserError(f"rubber curve: {len(x)} usable points; at least 4 with stretch other than 1 are needed")
    a = _columns(x)
    if np.linalg.cond(a / np.linalg.norm(a, axis=0)) > 500:
        raise UserError(
            f"rubber curve: stretch {x.min():.3f} to {x.max():.3f} is too narrow to tell c10 from c01; press or pull"
            " further"
        )
    c = np.linalg.lstsq(a, y, rcond=None)[0]
    rest = y - a @ c
    from scipy import stats

    free = max(1, len(x) - 2)
    wide = stats.t.ppf(0.975, free) * np.sqrt(np.diag(np.linalg.inv(a.T @ a)) * (rest @ rest) / free)
    held = []
    for k in range(len(x)):  # each point predicted from the others
        others = np.arange(len(x)) != k
        held.append(y[k] - a[k] @ np.linalg.lstsq(a[others], y[others], rcond=None)[0])
    total = ((y - y.mean()) ** 2).sum()
    return Rubber(
        float(c[0]), float(c[1]), (float(c[0] - wide[0]), float(c[0] + wide[0])),
        (float(c[1] - wide[1]), float(c[1] + wide[1])),
        float(1 - rest @ rest / total), float(np.sqrt(np.mean(rest**2))), float(np.sqrt(np.mean(np.square(held)))),
        (float(x.min()), float(x.max())))  # fmt: skip


def _columns(stretch: np.ndarray) -> np.ndarray:
    s = 2 * (stretch - stretch**-2.0)
    return np.stack([s, s / stretch], 1)


def from_press(depth: np.ndarray, force: np.ndarray, area: float, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """Stretch and nominal stress [Pa] of a flat press: depth m into a skin of `thickness` m over `area` m2, force N
    (positive pressing). Depths under 0 or over 80 % of the thickness are left out."""
    depth, force = np.asarray(depth, float), np.asarray(force, float)
    keep = (depth > 0) & (depth < 0.8 * thickness)
    return 1 - depth[keep] / thickness, -force[keep] / area


@dataclass
class Stiffness:
    """Linear stiffness [N/m] with its 95 % interval, R2, held-out rms [N], and hysteresis: the loop's mean width over
    the largest force (NaN where the press does not go back)."""

    value: float
    low: float
    high: float
    r2: float
    held_out: float
    hysteresis: float


def fit_linear(depth: np.ndarray, force: np.ndarray) -> Stiffness:
    """force = k depth through zero, over points with depth > 0 in the order they were taken. Raises UserError."""
    from scipy import stats

    depth, force = np.asarray(depth, float), np.asarray(force, float)
    keep = np.isfinite(depth) & np.isfinite(force) & (depth > 0)
    d, f = depth[keep], force[keep]
    if len(d) < 4:
        raise UserError(f"press curve: {len(d)} points with depth over 0; at least 4 are needed")
    k = d @ f / (d @ d)
    rest = f - k * d
    wide = stats.t.ppf(0.975, len(d) - 1) * np.sqrt(rest @ rest / (len(d) - 1) / (d @ d))
    held = [f[i] - d[i] * (d @ f - d[i] * f[i]) / (d @ d - d[i] ** 2) for i in range(len(d)) if d @ d > d[i] ** 2]
    top = int(d.argmax())
    loop = float("nan")
    if 2 <= top <= len(d) - 3:
        up, down = np.argsort(d[: top + 1]), np.argsort(d[top:])
        at = np.linspace(max(d[:top].min(), d[top + 1 :].min()), d[top], 40)
        width = np.interp(at, d[: top + 1][up], f[: top + 1][up]) - np.interp(at, d[top:][down], f[top:][down])
        loop = float(np.mean(np.abs(width)) / f.max())
    total = ((f - f.mean()) ** 2).sum()
    return Stiffness(
        float(k), float(k - wide), float(k + wide), float(1 - rest @ rest / total),
        float(np.sqrt(np.mean(np.square(held)))), loop,
    )  # fmt: skip


def read_curve(path: str | Path) -> tuple[str, np.ndarray, np.ndarray]:
    """Return a CSV with columns depth_m, force_N or stretch, stress_Pa, or "treloar": ("press" | "stress", first,
    second). Raises UserError."""
    if str(path) == "treloar":
        return "stress", *TRELOAR_1944.T
    path = Path(path).expanduser()
    kinds = {"press": ("depth_m", "force_N"), "stress": ("stretch", "stress_Pa")}
    found = files.table(path, "curve", (), [name for names in kinds.values() for name in names])
    for kind, names in kinds.items():
        if set(names) <= found.keys():
            return kind, found[names[0]], found[names[1]]
    raise UserError(f"curve={path}: needs the columns depth_m, force_N or stretch, stress_Pa")
