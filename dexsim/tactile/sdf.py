"""Signed distance to shapes on the device: negative inside, exact for primitives, trilinear on baked grids.

Points are in the shape's frame. Sizes are MuJoCo's: box (half extents), sphere (radius, -, -), capsule and cylinder
(radius, half length along z, -), grid (uniform scale, -, -).
"""

from __future__ import annotations

import warp as wp

BOX = 0
SPHERE = 1
CAPSULE = 2
CYLINDER = 3
GRID = 4
KINDS = {"box": BOX, "sphere": SPHERE, "capsule": CAPSULE, "cylinder": CYLINDER, "grid": GRID}


@wp.struct
class Shapes:
    """Shapes as flat arrays (S shapes, G grid samples); see `dexsim.tactile.shapes.ShapeSet`."""

    kind: wp.array(dtype=int)  # [S]
    dims: wp.array(dtype=wp.vec3i)  # [S] samples along x, y, z
    origin: wp.array(dtype=wp.vec3)  # [S] position of sample (0, 0, 0) [m] at scale 1
    spacing: wp.array(dtype=float)  # [S] [m] at scale 1
    offset: wp.array(dtype=int)  # [S] first sample in `data`
    radius: wp.array(dtype=float)  # [S] grid only: no point of the surface is farther from the frame's origin
    # [G] sample and its neighbour along z: one 8-byte load instead of two, and 32-bit flat indices (64-bit strides of
    # an N-d array cost more than the interpolation itself)
    data: wp.array(dtype=wp.vec2)


@wp.func
def sd_box(q: wp.vec3, half: wp.vec3):
    x = wp.abs(q[0]) - half[0]
    y = wp.abs(q[1]) - half[1]
    z = wp.abs(q[2]) - half[2]
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    return outside + wp.min(wp.max(x, wp.max(y, z)), 0.0)


@wp.func
def sd_sphere(q: wp.vec3, radius: float):
    return wp.length(q) - radius


@wp.func
def sd_capsule(q: wp.vec3, radius: float, half: float):
    z = q[2] - wp.clamp(q[2], -half, half)
    return wp.sqrt(q[0] * q[0] + q[1] * q[1] + z * z) - radius


@wp.func
def sd_cylinder(q: wp.vec3, radius: float, half: float):
    r = wp.sqrt(q[0] * q[0] + q[1] * q[1]) - radius
    z = wp.abs(q[2]) - half
    ro = wp.max(r, 0.0)
    zo = wp.max(z, 0.0)
    return wp.sqrt(ro * ro + zo * zo) + wp.min(wp.max(r, z), 0.0)


@wp.func
def sd_grid(s: Shapes, i: int, q: wp.vec3):
    """Trilinear inside the grid. Outside: sqrt(gap^2 + v^2), gap the distance to the grid's box and v the value at the
    nearest point c of it. That is a lower bound of the true distance for any shape inside the box (for k in the box,
    |q - k|^2 >= |q - c|^2 + |c - k|^2), positive and continuous."""
    n = s.dims[i]
    h = s.spacing[i]
    g = (q - s.origin[i]) / h
    x = wp.clamp(g[0], 0.0, float(n[0] - 1))
    y = wp.clamp(g[1], 0.0, float(n[1] - 1))
    z = wp.clamp(g[2], 0.0, float(n[2] - 1))
    ix = wp.min(int(x), n[0] - 2)
    iy = wp.min(int(y), n[1] - 2)
    iz = wp.min(int(z), n[2] - 2)
    fx = x - float(ix)
    fy = y - float(iy)
    fz = z - float(iz)
    sx = n[1] * n[2]
    k = s.offset[i] + ix * sx + iy * n[2] + iz
    a = s.data[k]
    b = s.data[k + n[2]]
    c = s.data[k + sx]
    d = s.data[k + sx + n[2]]
    v = wp.lerp(
        wp.lerp(wp.lerp(a[0], a[1], fz), wp.lerp(b[0], b[1], fz), fy),
        wp.lerp(wp.lerp(c[0], c[1], fz), wp.lerp(d[0], d[1], fz), fy),
        fx,
    )
    gx = (g[0] - x) * h
    gy = (g[1] - y) * h
    gz = (g[2] - z) * h
    gap = gx * gx + gy * gy + gz * gz
    if gap > 0.0:
        v = wp.max(v, 0.0)
        v = wp.sqrt(gap + v * v)
    return v


@wp.func
def in_grid(s: Shapes, i: int, q: wp.vec3):
    """Whether q lies in the grid's box: outside it there is no contact, and no sample need be loaded."""
    g = q - s.origin[i]
    h = s.spacing[i]
    n = s.dims[i]
    return (
        g[0] >= 0.0
        and g[1] >= 0.0
        and g[2] >= 0.0
        and g[0] <= float(n[0] - 1) * h
        and g[1] <= float(n[1] - 1) * h
        and g[2] <= float(n[2] - 1) * h
    )


@wp.func
def near_grid(s: Shapes, i: int, middle: wp.vec3, radius: float):
    """Whether a sphere can reach the grid's box."""
    n = s.dims[i]
    g = middle - s.origin[i]
    e = wp.vec3(float(n[0] - 1), float(n[1] - 1), float(n[2] - 1)) * s.spacing[i]
    x = wp.max(wp.max(-g[0], g[0] - e[0]), 0.0)
    y = wp.max(wp.max(-g[1], g[1] - e[1]), 0.0)
    z = wp.max(wp.max(-g[2], g[2] - e[2]), 0.0)
    return x * x + y * y + z * z < radius * radius


@wp.func
def distance(s: Shapes, i: int, size: wp.vec3, q: wp.vec3):
    """Signed distance [m] of q to shape i of the set, at this world's size."""
    kind = s.kind[i]
    d = float(0.0)
    if kind == wp.static(BOX):
        d = sd_box(q, size)
    elif kind == wp.static(SPHERE):
        d = sd_sphere(q, size[0])
    elif kind == wp.static(CAPSULE):
        d = sd_capsule(q, size[0], size[1])
    elif kind == wp.static(CYLINDER):
        d = sd_cylinder(q, size[0], size[1])
    else:
        d = size[0] * sd_grid(s, i, q / size[0])
    return d


@wp.func
def bound_radius(s: Shapes, i: int, size: wp.vec3):
    """Radius [m] of a sphere about the frame's origin that holds the shape."""
    kind = s.kind[i]
    r = float(0.0)
    if kind == wp.static(BOX):
        r = wp.length(size)
    elif kind == wp.static(SPHERE):
        r = size[0]
    elif kind == wp.static(CAPSULE):
        r = size[0] + size[1]
    elif kind == wp.static(CYLINDER):
        r = wp.sqrt(size[0] * size[0] + size[1] * size[1])
    else:
        r = size[0] * s.radius[i]
    return r


@wp.func
def normal(s: Shapes, i: int, size: wp.vec3, q: wp.vec3):
    """Outward unit normal at the surface point nearest to q: the gradient of the distance, by central differences of
    1e-3 of the size or a grid's spacing. Exact but at edges, where the nearest point is not one. For inspection and
    tests: no force needs it, since each taxel presses along its own normal."""
    e = 1.0e-5
    if s.kind[i] == wp.static(GRID):
        e = 0.5 * s.spacing[i] * size[0]
    x = distance(s, i, size, q + wp.vec3(e, 0.0, 0.0)) - distance(s, i, size, q - wp.vec3(e, 0.0, 0.0))
    y = distance(s, i, size, q + wp.vec3(0.0, e, 0.0)) - distance(s, i, size, q - wp.vec3(0.0, e, 0.0))
    z = distance(s, i, size, q + wp.vec3(0.0, 0.0, e)) - distance(s, i, size, q - wp.vec3(0.0, 0.0, e))
    return wp.normalize(wp.vec3(x, y, z))
