"""Inertias that no body can have: found all at once, and mended."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.import_hand.geometry import solid_geoms

ROUNDING = 1e-5  # of the largest moment: what printing a flat body's figures may add to it
SPECK = 1e-5  # kg of a link that has neither mass nor shape, between two joints
Moments = tuple[float, float, float]
"""Principal moments of inertia [kg m2], the smallest first."""


def balanced(spec: mujoco.MjSpec) -> dict[str, Moments]:
    """Give every body of `spec` whose stated inertia is none the mean of its moments about every axis, in place.

    Returns the moments that the file states, by body. An inertia is none where a moment is not above 0, or is above
    the sum of the other two.
    """
    out: dict[str, Moments] = {}
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return out
    for body in spec.bodies:
        if not body.explicitinertial or not body.mass > 0:
            continue
        moments = _moments(body)
        if not np.isfinite(moments).all():
            continue  # named elsewhere, with all that is no number
        low, middle, high = np.maximum(moments, spec.compiler.boundinertia) if moments[0] >= 0 else moments
        if high == 0 and not body.joints:  # a point of mass on the link that carries it
            continue
        if low > 0 and high <= low + middle:
            continue
        if not (low > 0 and high <= (low + middle) * (1 + ROUNDING)):
            out[body.name] = (float(low), float(middle), float(high))
        mean = float(np.abs(moments).mean()) or body.mass * 1e-6
        body.fullinertia = np.full(6, np.nan)
        body.inertia = np.full(3, mean)
    return out


def speck(body: Any) -> None:
    """Give a body next to no mass, about where it stands."""
    body.explicitinertial, body.mass, body.ipos = True, SPECK, np.zeros(3)
    body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, 1e-4 * SPECK)


def from_shapes(spec: mujoco.MjSpec, names: Iterable[str], path: object) -> None:
    """Give bodies the inertia and the centre of their shapes, filled evenly with the mass that the file states.

    Raises UserError for a body without a shape that has a volume.
    """
    bodies = [b for b in spec.bodies if b.name in set(names)]
    masses = {b.name: b.mass for b in bodies}
    for body in bodies:
        body.explicitinertial = False
        body.ipos, body.inertia = np.full(3, np.nan), np.zeros(3)
        fill(body, 1000.0)
    try:
        probe = spec.copy().compile()
    except (ValueError, RuntimeError) as error:
        raise UserError(f"model {path}: inertia=shapes: {' '.join(str(error).split())}; use inertia=balance") from None
    for body in bodies:
        of_water = float(probe.body(body.name).mass[0])
        if not of_water > 0:
            raise UserError(
                f"model {path}: link '{body.name}' has no shape to take an inertia from; use inertia=balance"
            )
        fill(body, 1000.0 * masses[body.name] / of_water)


def fill(body: Any, density: float) -> None:
    """Give a body's shapes this density [kg/m3]: those that collide, or all where none does (what is drawn and what
    collides is one body, not two)."""
    solid = solid_geoms(body)
    for geom in body.geoms:
        geom.density = density if geom in solid else 0.0
        geom.mass = np.nan


def refused(moments: dict[str, Moments], path: object) -> UserError:
    """Return the error that lists all of them."""
    figures = "; ".join(f"'{name}' {' '.join(f'{x:.3g}' for x in m)}" for name, m in moments.items())
    return UserError(
        f"model {path}: {len(moments)} moving link{'s' if len(moments) > 1 else ''} with moments of inertia that no"
        f" body has (kg m2, each must be above 0 and at most the sum of the other two): {figures}; correct them, or"
        " inertia=shapes takes those of the links' shapes at the stated masses, inertia=balance the mean of the three"
    )


def _moments(body: Any) -> np.ndarray:
    full = np.array(body.fullinertia, float)
    if np.isnan(full[0]):
        return np.sort(np.array(body.inertia, float))
    xx, yy, zz, xy, xz, yz = full
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.linalg.eigvalsh(tensor) if np.isfinite(tensor).all() else np.full(3, np.nan)
